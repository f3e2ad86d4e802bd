"""Windows, their pixels, and tiles: which pixels a tile owns and which it needs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil, floor
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels, rows ``[row, row + height)`` and columns ``[column, column + width)``."""

    row: int
    column: int
    height: int
    width: int

    @property
    def row_stop(self) -> int:
        """Return the row after the last."""
        return self.row + self.height

    @property
    def column_stop(self) -> int:
        """Return the column after the last."""
        return self.column + self.width

    @property
    def slices(self) -> tuple[slice, slice]:
        """Return the index of the window into a ``(row, column)`` array."""
        return slice(self.row, self.row_stop), slice(self.column, self.column_stop)

    @property
    def in_words(self) -> str:
        """Return first and last rows and columns, for messages and tags."""
        return f"rows {self.row} to {self.row_stop - 1}, columns {self.column} to {self.column_stop - 1}"

    @classmethod
    def around(cls, first: Sequence[float], last: Sequence[float]) -> "Window":
        """Return the window of whole pixels around the part from ``first`` to ``last``, rows and columns."""
        row, column = map(floor, first)
        row_stop, column_stop = map(ceil, last)
        return cls(row, column, row_stop - row, column_stop - column)

    def grown(self, rows: int, columns: int | tuple[int, int]) -> "Window":
        """Return the window grown by ``rows`` above and below and ``columns`` (or a pair) left and right."""
        left, right = columns if isinstance(columns, tuple) else (columns, columns)
        return Window(self.row - rows, self.column - left, self.height + 2 * rows, self.width + left + right)

    def clipped(self, other: "Window") -> "Window":
        """Return the intersection with ``other``; its size is zero if they do not overlap."""
        row, column = max(self.row, other.row), max(self.column, other.column)
        height = min(self.row_stop, other.row_stop) - row
        return Window(row, column, max(0, height), max(0, min(self.column_stop, other.column_stop) - column))

    def relative_to(self, origin: "Window") -> "Window":
        """Return the same pixels, counted from the first pixel of ``origin``."""
        return Window(self.row - origin.row, self.column - origin.column, self.height, self.width)


class View(NamedTuple):
    """Pixels (float) and states (uint8) of a window of an image; outside the image the state is NO_DATA."""

    window: Window
    pixels: np.ndarray
    state: np.ndarray

    def inner(self, array: np.ndarray, window: Window) -> np.ndarray:
        """Crop ``pixels`` or ``state`` to a window."""
        return np.ascontiguousarray(array[window.relative_to(self.window).slices])

    def cropped(self, window: Window) -> "View":
        """Crop the view to a window."""
        return View(window, self.inner(self.pixels, window), self.inner(self.state, window))


Views = tuple[View, ...]
"""Views of the left and of the right image, or of as many images as a matching cost reads."""


@dataclass(frozen=True)
class Tile:
    """One task: its place in the grid and its core, the pixels it owns."""

    grid_row: int
    grid_column: int
    core: Window

    @property
    def name(self) -> str:
        """Return the name of the tile in records, messages and reports."""
        return f"{self.grid_row}_{self.grid_column}"


@dataclass(frozen=True)
class Grid:
    """The tiles of a region of the left image: each pixel of the region belongs to exactly one core."""

    region: Window
    size: int

    @property
    def rows(self) -> int:
        """Return the number of rows of tiles."""
        return -(-self.region.height // self.size)

    @property
    def columns(self) -> int:
        """Return the number of columns of tiles."""
        return -(-self.region.width // self.size)

    def __len__(self) -> int:
        return self.rows * self.columns

    def __iter__(self) -> Iterator[Tile]:
        return (self.tile(row, column) for row in range(self.rows) for column in range(self.columns))

    def tile(self, grid_row: int, grid_column: int) -> Tile:
        """Return the tile at a grid position."""
        row = self.region.row + grid_row * self.size
        column = self.region.column + grid_column * self.size
        return Tile(grid_row, grid_column, Window(row, column, self.size, self.size).clipped(self.region))

    def within(self, window: Window) -> list[Tile]:
        """Return the tiles of a window of whole tiles, row by row."""
        inside = window.relative_to(self.region)
        rows = range(inside.row // self.size, -(-inside.row_stop // self.size))
        columns = range(inside.column // self.size, -(-inside.column_stop // self.size))
        return [self.tile(row, column) for row in rows for column in columns]


def strips(height: int, width: int, pixels: int) -> Iterator[Window]:
    """Yield windows of whole rows from the top: at most ``pixels`` pixels and 512 rows, if possible 64 n rows."""
    rows = min(512, max(1, pixels // width))
    rows = rows // 64 * 64 or rows
    for row in range(0, height, rows):
        yield Window(row, 0, min(rows, height - row), width)


def strips_of_windows(shape: tuple[int, int], rows: int, columns: int) -> Iterator[list[Window]]:
    """Yield the windows of strips from the top, of at most so many rows and columns."""
    whole = Window(0, 0, *shape)
    for row in range(0, shape[0], rows):
        yield [Window(row, column, rows, columns).clipped(whole) for column in range(0, shape[1], columns)]


def hull(windows: Sequence[Window]) -> Window:
    """Return the smallest window that contains all windows."""
    row, column = min(window.row for window in windows), min(window.column for window in windows)
    row_stop = max(window.row_stop for window in windows)
    return Window(row, column, row_stop - row, max(window.column_stop for window in windows) - column)


def facing(window: Window, minimum: int, maximum: int) -> Window:
    """Return the window of right pixels that are candidates of a left window over the search range.

    In arrays cut this way, ``right[r, c + k]`` is the candidate of ``left[r, c]`` at disparity ``minimum + k``.
    """
    return Window(window.row, window.column + minimum, window.height, window.width + maximum - minimum)
