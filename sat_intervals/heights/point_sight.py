"""Disparities of points with heights: the visible one of each pixel, strip by strip."""

from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from sat_intervals.tiling import Window

# Rows of a strip.
_ROWS = 256
_RECORD = np.dtype([("row", "<i4"), ("column", "<i4"), ("disparity", "<f4")])
# Number of points needed around a pixel to decide whether a point is hidden, and the largest distance in pixels that is
# searched for them.
_AROUND, _FURTHEST = 8, 8
# The steepest slope that is not a wall, and pixels of disparity that no slope explains.
_STEEPEST, _CLEAR = np.tan(np.radians(60.0)), 1.0


class PointSight:
    """Points in the pixels of a region, gathered by strips of rows in an empty file that is open for both ways.

    ``rise`` is the signed change of disparity for a height of one pixel's size on the ground.
    """

    def __init__(self, file: BinaryIO, region: Window, rise: float) -> None:
        self._file, self._region, self._rise = file, region, rise
        self._parts: dict[int, list[tuple[int, int]]] = {}  # of each strip: places in the file, bytes
        self.points = 0
        """Points in the region."""

    def add(self, row: np.ndarray, column: np.ndarray, disparity: np.ndarray) -> None:
        """Add points at epipolar positions of the left image, ``(n,)`` each in pixels; only those in the region."""
        known = np.isfinite(row) & np.isfinite(column) & np.isfinite(disparity)
        records = np.empty(int(known.sum()), _RECORD)
        records["row"] = np.rint(row[known]) - self._region.row
        records["column"] = np.rint(column[known]) - self._region.column
        records["disparity"] = disparity[known]
        inside = (records["row"] >= 0) & (records["row"] < self._region.height)
        inside &= (records["column"] >= 0) & (records["column"] < self._region.width)
        records = records[inside]
        self.points += records.size
        records = records[np.argsort(records["row"] // _ROWS, kind="stable")]
        strips, begins = np.unique(records["row"] // _ROWS, return_index=True)
        for strip, part in zip(strips.tolist(), np.split(records, begins[1:]) if strips.size else (), strict=True):
            self._parts.setdefault(strip, []).append((self._file.tell(), part.nbytes))
            self._file.write(part.tobytes())

    @property
    def reach(self) -> int:
        """Return how far around a pixel points may hide it, in pixels; 0 if they are too few to decide."""
        density = self.points / (self._region.height * self._region.width)
        reach = 0 if not density else max(1, int(np.ceil((np.sqrt(_AROUND / density) - 1) / 2)))
        return reach if reach <= _FURTHEST else 0

    def strips(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the first row and the disparities ``(rows, columns)``, NaN without a visible point, from the top."""
        for row in range(0, self._region.height, _ROWS):
            yield row, self._strip(row, min(_ROWS, self._region.height - row))

    def _strip(self, row: int, rows: int) -> np.ndarray:
        reach, sign = self.reach, np.sign(self._rise)
        nearest = np.full((rows + 2 * reach, self._region.width + 2 * reach), -np.inf)
        for strip in range(row // _ROWS - 1, row // _ROWS + 2):
            for records in self._records(strip):
                place = records["row"] - (row - reach)
                near = (place >= 0) & (place < nearest.shape[0])
                np.maximum.at(
                    nearest, (place[near], records["column"][near] + reach), sign * records["disparity"][near]
                )
        seen = nearest[reach : reach + rows, reach : reach + self._region.width]
        if reach:
            explained = _CLEAR + _STEEPEST * reach * abs(self._rise)
            seen = np.where(seen >= _largest_around(nearest, reach) - explained, seen, -np.inf)
        return np.where(np.isfinite(seen), sign * seen, np.nan)

    def _records(self, strip: int) -> Iterator[np.ndarray]:
        for place, size in self._parts.get(strip, []):
            self._file.seek(place)
            yield np.frombuffer(self._file.read(size), _RECORD)


def _largest_around(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the largest value within ``reach`` rows and columns of each but the outermost ``reach``."""
    for axis in (0, 1):
        windows = np.lib.stride_tricks.sliding_window_view(values, 2 * reach + 1, axis=axis)
        values = windows.max(axis=-1)
    return values
