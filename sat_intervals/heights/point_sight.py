"""Disparities of points with heights: the visible one of each pixel, strip by strip."""

from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from sat_intervals.tiling import Window

_ROWS = 256  # rows of a strip
# Number of points needed around a pixel to decide whether a point is hidden, and the largest distance in pixels that is
# searched for them.
_AROUND, _FURTHEST = 8, 8
# The steepest slope that is not a wall, and pixels of disparity that no slope explains.
_STEEPEST, _CLEAR = np.tan(np.radians(60.0)), 1.0


class PointVisibility:
    """The nearest of the points in each pixel of a region, kept in an empty file that is open for both ways."""

    def __init__(self, file: BinaryIO, region: Window, rise: float) -> None:
        """``rise``: signed change of disparity for a height of one pixel's size on the ground."""
        self._region = region
        self._rise = rise
        self._sign = np.sign(rise)
        self._points = 0
        nothing = np.full(region.width, -np.inf, np.float32).tobytes()
        for _ in range(region.height):  # a full disk raises here; once mapped it would end the process
            file.write(nothing)
        file.flush()
        self._nearest = np.memmap(file, np.float32, "r+", shape=(region.height, region.width))

    def add(self, row: np.ndarray, column: np.ndarray, disparity: np.ndarray) -> None:
        """Add points at epipolar positions of the left image, ``(n,)`` each in pixels; only those in the region."""
        known = np.isfinite(row) & np.isfinite(column) & np.isfinite(disparity)
        row = np.rint(row[known]).astype(np.int64) - self._region.row
        column = np.rint(column[known]).astype(np.int64) - self._region.column
        inside = (row >= 0) & (row < self._region.height) & (column >= 0) & (column < self._region.width)
        self._points += int(inside.sum())
        nearness = self._sign * disparity[known][inside].astype(np.float32)
        np.maximum.at(self._nearest, (row[inside], column[inside]), nearness)

    def strips(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the first row and the disparities ``(rows, columns)``, NaN without a visible point, from the top."""
        for row in range(0, self._region.height, _ROWS):
            yield row, self._strip(Window(row, 0, min(_ROWS, self._region.height - row), self._region.width))

    def _strip(self, window: Window) -> np.ndarray:
        reach = self._reach()
        around = window.grown(reach, reach)
        common = around.clipped(Window(0, 0, *self._nearest.shape))
        nearest = np.full((around.height, around.width), -np.inf)
        nearest[common.relative_to(around).slices] = self._nearest[common.slices]
        seen = nearest[window.relative_to(around).slices]
        if reach:
            explained = _CLEAR + _STEEPEST * reach * abs(self._rise)
            seen = np.where(seen >= _largest_around(nearest, reach) - explained, seen, -np.inf)
        return np.where(np.isfinite(seen), self._sign * seen, np.nan)

    def _reach(self) -> int:
        """Return how far around a pixel points may hide it, in pixels; 0 if they are too few to decide."""
        density = self._points / self._nearest.size
        reach = 0 if not density else max(1, int(np.ceil((np.sqrt(_AROUND / density) - 1) / 2)))
        return reach if reach <= _FURTHEST else 0


def _largest_around(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the largest value within ``reach`` rows and columns of each but the outermost ``reach``."""
    for axis in (0, 1):
        windows = np.lib.stride_tricks.sliding_window_view(values, 2 * reach + 1, axis=axis)
        values = windows.max(axis=-1)
    return values
