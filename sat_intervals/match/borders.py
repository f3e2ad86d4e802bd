"""Path states that tiles hand to their neighbours: with them, any tiling gives the result of the whole image.

A wavefront, see `WAVEFRONTS`, visits the tiles from one corner of the grid to the opposite one. Each tile takes over
the states of the pixels around it and hands on those of its own last pixels (METHOD.md, section 11).
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config
from sat_intervals.kernels.cost import padded_to_lanes
from sat_intervals.kernels.matching import trace
from sat_intervals.kernels.sgm import WALL, WAVEFRONTS, Borders, Edge
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.matching_cost import AreaCosts
from sat_intervals.match.patch import PatchFrame, frame_area, mirrored_settings, patch_settings, path_window
from sat_intervals.tiling import Tile, Window

Place = tuple[int, int]
"""Row and column of a tile in its grid, or what to add to them."""


class Border(NamedTuple):
    """What a tile hands on in one wavefront: the pixels whose paths it computed, and the states of the last ones."""

    inside: Window
    edge: Edge


def sources(wavefront: int) -> tuple[Place, Place, Place]:
    """Neighbours whose states a tile takes over in a wavefront: beside it, before it, and diagonally before it."""
    down, wave = WAVEFRONTS[wavefront]
    row = -1 if down else 1
    column = -1 if down == (wave == 0) else 1
    return (0, column), (row, 0), (row, column)


def in_order(wavefront: int, tiles: Iterable[Tile]) -> list[Tile]:
    """Sort tiles so that each comes after its `sources`."""
    (_, column), (row, _), _ = sources(wavefront)
    return sorted(tiles, key=lambda tile: (-row * tile.grid_row, -column * tile.grid_column))


def _around(wavefront: int, patch: Window, borders: Mapping[Place, Border], size: int) -> Edge:
    """The states around a patch, from the borders of the tile's `sources` that exist; ``size`` is in whole vectors."""
    beside, *before = sources(wavefront)
    nothing = np.zeros((0, 2, size), np.uint16)
    row = nothing
    if before[0] in borders:
        row = np.zeros((patch.width, 2, size), np.uint16)
        for place in before:
            if place in borders:
                inside, edge = borders[place]
                shared = inside.clipped(Window(inside.row, patch.column, inside.height, patch.width))
                row[shared.relative_to(patch).slices[1]] = edge.row[shared.relative_to(inside).slices[1]]
    return Edge(borders[beside].edge.column if beside in borders else nothing, row)


def rehulled(edge: Edge, minimum: int, config: Config) -> Edge:
    """States of a neighbour, whose first disparity is ``minimum``, over the search range of ``config``."""
    # A disparity that only one of the two searches is outside the cells of the pixels that they share: it is
    # impossible.
    size, shift = padded_to_lanes(config.disparity.count), config.disparity.minimum - minimum
    found = []
    for states in edge:
        both = np.full((*states.shape[:2], size), WALL, np.uint16)
        first, last = max(0, -shift), min(size, states.shape[2] - shift)
        both[..., first : max(first, last)] = states[..., first + shift : max(first, last) + shift]
        both[..., config.disparity.count :] = WALL
        found.append(both)
    return Edge(*found)


def borders_of(frame: PatchFrame, config: Config, found: Sequence[Mapping[Place, Border]]) -> Borders:
    """Borders of a tile for the kernels, from those of its neighbours by wavefront and place."""
    patch, size = frame_area(frame, config).base, padded_to_lanes(config.disparity.count)
    around = tuple(_around(wavefront, patch, borders, size) for wavefront, borders in enumerate(found))
    return Borders(path_window(frame, config).relative_to(patch), around)


def trace_area(
    cost: AreaCosts, frame: PatchFrame, borders: Borders, wavefront: int, config: Config, ranges: LocalRanges | None
) -> Edge:
    """Path states that a tile hands on in a wavefront, from the costs of its `frame_area` and its `borders_of`."""
    settings, cells = patch_settings(frame_area(frame, config).base, config, ranges)
    settings = mirrored_settings(settings) if frame.mirrored else settings
    return trace(cost.costs, settings, borders, wavefront, cost.gradients, cells)
