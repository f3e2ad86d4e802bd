"""Measure seams: compare the pixel lines along tile borders, which both neighbours compute.

SGM's paths have unbounded support, so the products of a tile depend slightly on its overlap. The two lines along every
inner border show how much.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.kernels.matching import BOUNDS, Raw
from sat_intervals.products import NO_DISPARITY
from sat_intervals.tiling import Grid, Window

OWN, RING = 0, 1
TOP, BOTTOM, LEFT, RIGHT = range(4)


def seam_lines(raw: Raw, output: Window, core: Window, size: int) -> np.ndarray:
    """Return the outermost lines of the core, and those of the ring around it, which belong to the neighbours.

    ``raw`` are products of ``output``, which is ``core`` and, along inner borders, one pixel around it; ``size`` is the
    length of the longest line. Returns int16 ``(side, own or ring, winner or bound, size)``, bounds of all levels;
    NO_DISPARITY where there is no pixel.
    """
    bounds = (getattr(raw, name) for name in BOUNDS)
    products = [raw.winner, *(bound.view(np.int16) for bound in bounds if bound.size)]
    lines = np.full((4, 2, len(products), size), NO_DISPARITY, np.int16)
    inner = core.relative_to(output)
    rows, columns = inner.slices
    for i, product in enumerate(products):
        for side, own, ring in ((TOP, inner.row, -1), (BOTTOM, inner.row_stop - 1, 1)):
            lines[side, OWN, i, : core.width] = product[own, columns]
            if 0 <= own + ring < output.height:
                lines[side, RING, i, : core.width] = product[own + ring, columns]
        for side, own, ring in ((LEFT, inner.column, -1), (RIGHT, inner.column_stop - 1, 1)):
            lines[side, OWN, i, : core.height] = product[rows, own]
            if 0 <= own + ring < output.width:
                lines[side, RING, i, : core.height] = product[rows, own + ring]
    return lines


class _Difference(NamedTuple):
    """Number of matched pixels along a border, and of those that differ."""

    pixels: int
    winner: int
    bounds: int

    def shares(self) -> dict[str, Any]:
        pixels = max(self.pixels, 1)
        return {"pixels": self.pixels, "winner_share": self.winner / pixels, "bounds_share": self.bounds / pixels}


def seam_report(lines: np.ndarray, grid: Grid) -> dict[str, Any]:
    """Return the shares of pixels along inner borders whose raw winner or bounds differ between neighbours.

    ``lines`` are those of all tiles, ``(grid rows, grid columns, side, own or ring, product, size)``, see `seam_lines`.
    Returns ``borders``; ``pixels`` with a winner in either tile; ``winner_share`` and ``bounds_share`` over all
    borders; ``worst``, the same for the border with the largest ``bounds_share``, None without inner borders.
    """
    borders = dict(_borders(lines, grid))
    total = _Difference(*(sum(counts) for counts in zip((0, 0, 0), *borders.values(), strict=True)))
    report = {"borders": len(borders), **total.shares(), "worst": None}
    if borders:
        name = max(borders, key=lambda key: (borders[key].shares()["bounds_share"], borders[key].winner))
        report["worst"] = {"between": list(name), **borders[name].shares()}
    return report


def _borders(lines: np.ndarray, grid: Grid) -> Iterator[tuple[tuple[str, str], _Difference]]:
    for tile in grid:
        for row, column, side, other in ((0, 1, RIGHT, LEFT), (1, 0, BOTTOM, TOP)):
            if tile.grid_row + row < grid.rows and tile.grid_column + column < grid.columns:
                neighbour = grid.tile(tile.grid_row + row, tile.grid_column + column)
                here = lines[tile.grid_row, tile.grid_column, side]
                there = lines[neighbour.grid_row, neighbour.grid_column, other]
                own = np.concatenate([here[OWN], there[OWN]], axis=-1)
                seen_by_other = np.concatenate([there[RING], here[RING]], axis=-1)
                yield (tile.name, neighbour.name), _compare(own, seen_by_other)


def _compare(first: np.ndarray, second: np.ndarray) -> _Difference:
    differs = first != second
    pixels = (first[0] != NO_DISPARITY) | (second[0] != NO_DISPARITY)
    return _Difference(int(pixels.sum()), int(differs[0].sum()), int(differs[1:].any(axis=0).sum()))
