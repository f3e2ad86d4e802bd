"""Where many images show the cells of a grid on the ground, and their costs there (METHOD.md, section 20).

Disparities are steps of height: ``base + step * disparity`` metres above the ellipsoid. Costs are made block by block
of BLOCK x BLOCK cells, counted from the first cell: within a block the images move with the height as at its middle.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sat_intervals.config import Config, Sweep
from sat_intervals.kernels.plane_sweep import FINE, RADIUS, planes_of, sweep
from sat_intervals.kernels.resampling import resample
from sat_intervals.kernels.row_offsets import AFTER, BEFORE
from sat_intervals.tiling import View, Window

# Side of a block in cells: views of satellites turn by less than a hundredth of a pixel within it.
BLOCK = 64
# Images that must see a cell.
FEWEST = 2
# Cells between nodes of a fine grid.
_NODES = 16
# Cells around those of a block that the fine grid needs: the window, and a cubic.
_AROUND = RADIUS + 2


@dataclass(frozen=True)
class GroundViews:
    """Where images show the cells of a grid on the ground.

    places: ``(images, heights, rows, columns, 2)`` float64: row and column in each image, whose pixel centres are
        integers, of the first corners of blocks, and of the last ones, at heights.
    first: row and column of the first of these blocks in the grid; no image shows other blocks.
    lowest, spacing: metres of the first height, and between heights.
    reductions: pixels along a side of each image that are averaged.
    pairs: ``(pairs, 2)`` int64: images to compare.
    base, step: metres of disparity 0, and of a disparity.
    shape: rows and columns of cells.
    """

    places: np.ndarray
    lowest: float
    spacing: float
    reductions: tuple[int, ...]
    pairs: np.ndarray
    base: float
    step: float
    shape: tuple[int, int]
    first: tuple[int, int] = (0, 0)

    def shifted(self, shifts: np.ndarray) -> "GroundViews":
        """Return the views with rows and columns added to all positions, ``(images, 2)``."""
        return replace(self, places=self.places + shifts[:, None, None, None, :])

    def tilted(self, slopes: np.ndarray) -> "GroundViews":
        """Return the views with planes added to positions: ``slopes`` are pixels along the whole grid, see `Fits`."""
        known = zip(self.places.shape[2:4], self.first, self.shape, strict=True)
        row, column = (BLOCK * (np.arange(count) + first) / size - 0.5 for count, first, size in known)
        planes = row[:, None, None] * slopes[:, None, None, 0] + column[:, None] * slopes[:, None, None, 1]
        return replace(self, places=self.places + planes[:, None])

    def corners(self, block: tuple[int, int], disparities: np.ndarray) -> np.ndarray:
        """Return ``(images, n, 2, 2, 2)``: positions of a block's corners, reduced, at disparities ``(n,)``."""
        row, column = (one - first for one, first in zip(block, self.first, strict=True))
        at = (self.base + self.step * disparities - self.lowest) / self.spacing
        i = np.clip(np.floor(at).astype(int), 0, self.places.shape[1] - 2)
        of_levels = self.places[:, :, row : row + 2, column : column + 2]
        part, reduction = (at - i)[:, None, None, None], np.array(self.reductions)[:, None, None, None, None]
        found = (1 - part) * of_levels[:, i] + part * of_levels[:, i + 1]
        return np.asarray((found - (reduction - 1) / 2) / reduction)

    def positions(self, image: int, window: Window, disparity: np.ndarray) -> np.ndarray:
        """Return ``(rows, columns, 2)``: positions in an image, reduced, of the cells of a window at disparities."""
        at = (self.base + self.step * disparity - self.lowest) / self.spacing
        rows, columns = np.mgrid[window.row : window.row_stop, window.column : window.column_stop]
        axes = at, (rows + 0.5) / BLOCK - self.first[0], (columns + 0.5) / BLOCK - self.first[1]
        whole, parts = [], []
        for axis, count in zip(axes, self.places.shape[1:4], strict=True):
            whole.append(np.clip(np.floor(axis).astype(int), 0, count - 2))
            parts.append((axis - whole[-1])[..., None])
        found = np.zeros((*disparity.shape, 2))
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod([part if one else 1 - part for one, part in zip(corner, parts, strict=True)], axis=0)
            found += weight * self.places[(image, *(i + one for i, one in zip(whole, corner, strict=True)))]
        reduction = self.reductions[image]
        return (found - (reduction - 1) / 2) / reduction

    def _known(self, window: Window) -> Window:
        """Return the blocks that a window of cells meets, of those whose places are known."""
        ends = (window.row // BLOCK, window.column // BLOCK), (window.row_stop / BLOCK, window.column_stop / BLOCK)
        rows, columns = self.places.shape[2:4]
        return Window.around(*ends).clipped(Window(*self.first, rows - 1, columns - 1))

    def within(self, window: Window) -> "GroundViews":
        """Return the views of a window of cells only."""
        known = self._known(window)
        rows, columns = known.relative_to(Window(*self.first, 0, 0)).slices
        places = self.places[:, :, rows.start : rows.stop + 1, columns.start : columns.stop + 1]
        return replace(self, places=places, first=(known.row, known.column))

    def shown(self, sizes: Sequence[tuple[int, int]]) -> np.ndarray:
        """Return the blocks that two images, of ``sizes`` rows and columns, may show at some height: bool."""
        corners = sliding_window_view(self.places, (2, 2), (2, 3))
        low, high = (end((1, -2, -1)) for end in (corners.min, corners.max))
        meets = (high >= 0) & (low <= np.array(sizes)[:, None, None, :])
        found = np.zeros([-(-size // BLOCK) for size in self.shape], bool)
        row, column = self.first
        found[row : row + low.shape[1], column : column + low.shape[2]] = meets.all(axis=-1).sum(axis=0) >= FEWEST
        return found

    def blocks(self, window: Window) -> Iterator[tuple[tuple[int, int], Window]]:
        """Yield the blocks that a window of cells meets, and their common part, counted from the block's first cell."""
        known = self._known(window)
        for row in range(known.row, known.row_stop):
            for column in range(known.column, known.column_stop):
                block = Window(row * BLOCK, column * BLOCK, BLOCK, BLOCK)
                yield (row, column), block.clipped(window).relative_to(block)

    def windows(self, window: Window, minimum: int, maximum: int) -> tuple[Window, ...]:
        """Return the window of each image, reduced, that the costs of a window of cells over disparities need."""
        known, ends = self._known(window), np.array([minimum, maximum], float)
        if not (known.height and known.width):
            return (Window(0, 0, 0, 0),) * len(self.reductions)
        rows, columns = {known.row, known.row_stop - 1}, {known.column, known.column_stop - 1}
        found, corners = [], np.stack([self.corners(block, ends) for block in product(rows, columns)], axis=1)
        for places in corners.reshape(len(self.reductions), -1, 2):
            cell = np.abs(np.diff(places.reshape(-1, 2, 2, 2), axis=1)).max() / BLOCK
            margin = 1 + AFTER + int(np.ceil(cell * 2 * (_AROUND + _NODES)))
            found.append(Window.around(places.min(axis=0) - margin, places.max(axis=0) + margin))
        return tuple(found)

    def costs(
        self, images: Sequence[View], block: tuple[int, int], part: Window, disparities: np.ndarray, config: Config
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return costs of a part of a block at disparities, and which images see its cells, see `kernels.sweep`.

        ``images`` are reduced. ``disparities`` are those of the whole block.
        """
        # of all images at once: Python is a tenth of the time, in which threads wait for each other
        corners = self.corners(block, disparities)
        there = corners[:, disparities.size // 2]
        rows, columns = there.mean(axis=2), there.mean(axis=1)
        cell = np.stack([rows[:, 1] - rows[:, 0], columns[:, 1] - columns[:, 0]], axis=1) / BLOCK
        away = (corners.mean(axis=(2, 3)) - there.mean(axis=(1, 2))[:, None]) @ np.linalg.inv(cell)
        low = np.floor(away.min(axis=1)).astype(int) - _AROUND
        high = np.ceil(away.max(axis=1)).astype(int) + _AROUND
        begins, sizes = low // _NODES * _NODES, high - low + (part.height, part.width)
        planes, inner = [], np.array([part.row, part.column])
        for view, corner, first, begin, end, size in zip(images, there, low, begins, high, sizes, strict=True):
            nodes = _nodes(corner, begin, end + BLOCK)
            planes.append(planes_of(_fine(view, nodes, first + inner, begin, size)).ravel())
        moves = np.ascontiguousarray(np.swapaxes(FINE * (away - low[:, None] - RADIUS), 0, 1))
        starts = np.cumsum([0, *(plane.size for plane in planes[:-1])])
        costs = np.empty((part.height, part.width, disparities.size), np.uint8)
        seen = np.empty((len(images), part.height, part.width), np.uint8)
        assert isinstance(config.cost, Sweep)
        share, steps = float(config.cost.share), int(config.numbers.steps)
        sweep(np.concatenate(planes), starts, sizes, moves, self.pairs, share, steps, costs, seen)
        return costs, seen

    def count(self, seen: np.ndarray) -> np.ndarray:
        """Return how many images see each cell, 0 where no pair to compare does."""
        compared = (seen[self.pairs[:, 0]] & seen[self.pairs[:, 1]]).any(axis=0)
        return np.where(compared, seen.sum(axis=0), 0).astype(np.uint8)


def _nodes(there: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return positions at nodes of the fine grid, bilinear between (and beyond) the corners of a block.

    ``begin`` and ``end`` count cells from the block's first: rows and columns.
    """
    rows, columns = (
        (np.arange(first, last + 2 * _NODES, _NODES) + 0.5)[:, None] / BLOCK
        for first, last in zip(begin, end, strict=True)
    )
    sides = there[0] + rows[:, None] * (there[1] - there[0])
    return np.ascontiguousarray(sides[:, :1] + columns * (sides[:, 1:] - sides[:, :1]))


def _fine(view: View, nodes: np.ndarray, first: np.ndarray, begin: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return an image on the fine grid: ``size`` cells from ``first`` on; NaN where not usable."""
    start = FINE * (first - begin)
    ends = (start + FINE * size - 1) // (FINE * _NODES) + 2
    used = nodes[tuple(slice(s, e) for s, e in zip(start // (FINE * _NODES), ends, strict=True))].reshape(-1, 2)
    around = Window.around(used.min(axis=0) - BEFORE, used.max(axis=0) + AFTER + 1)
    pixels = np.full((around.height, around.width), np.float32(np.nan))
    inside = around.clipped(view.window)
    if not (inside.height and inside.width):
        return np.full(FINE * size, np.float32(np.nan))
    pixels[inside.relative_to(around).slices] = view.pixels[inside.relative_to(view.window).slices]
    return np.asarray(
        resample(
            pixels, (around.row, around.column), nodes, FINE * _NODES, tuple(map(int, start)), *map(int, FINE * size)
        )
    )


def ground_of(report: dict[str, Any], arrays: Sequence[np.ndarray]) -> GroundViews:
    """Return the views of a report and arrays, see `report_of_ground`."""
    return GroundViews(
        arrays[0], pairs=arrays[1], **report | {name: tuple(report[name]) for name in ("reductions", "shape", "first")}
    )


def report_of_ground(ground: GroundViews) -> tuple[dict[str, Any], tuple[np.ndarray, np.ndarray]]:
    """Return what identifies views: a mapping for JSON, and arrays."""
    names = "lowest", "spacing", "reductions", "base", "step", "shape", "first"
    return {name: getattr(ground, name) for name in names}, (ground.places, ground.pairs)
