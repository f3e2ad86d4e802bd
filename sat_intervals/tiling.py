"""Cores, overlaps and margins: which pixels a tile keeps, which it needs. Pure geometry."""

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels, rows ``[row, row + height)`` and columns ``[column, column + width)``."""

    row: int
    column: int
    height: int
    width: int

    @property
    def row_stop(self) -> int:
        """The row after the last."""
        return self.row + self.height

    @property
    def column_stop(self) -> int:
        """The column after the last."""
        return self.column + self.width

    @property
    def slices(self) -> tuple[slice, slice]:
        """The window as an index into a ``(row, column)`` array."""
        return slice(self.row, self.row_stop), slice(self.column, self.column_stop)

    def grown(self, rows: int, columns: int | tuple[int, int]) -> "Window":
        """The window with ``rows`` more above and below and ``columns`` more left and right (or one figure each)."""
        left, right = columns if isinstance(columns, tuple) else (columns, columns)
        return Window(self.row - rows, self.column - left, self.height + 2 * rows, self.width + left + right)

    def clipped(self, other: "Window") -> "Window":
        """The part of the window inside ``other``; of zero size where they do not meet."""
        row, column = max(self.row, other.row), max(self.column, other.column)
        return Window(
            row,
            column,
            max(0, min(self.row_stop, other.row_stop) - row),
            max(0, min(self.column_stop, other.column_stop) - column),
        )

    def relative_to(self, origin: "Window") -> "Window":
        """The same pixels, counted from the first pixel of ``origin``."""
        return Window(self.row - origin.row, self.column - origin.column, self.height, self.width)


@dataclass(frozen=True)
class Tile:
    """One task: the core it owns and its place in the grid."""

    grid_row: int
    grid_column: int
    core: Window

    @property
    def name(self) -> str:
        """How records, messages and reports call the tile."""
        return f"{self.grid_row}_{self.grid_column}"


@dataclass(frozen=True)
class Grid:
    """The tiles of a region of the left image: every pixel of the region lies in exactly one core."""

    region: Window
    size: int

    @property
    def rows(self) -> int:
        """Number of rows of tiles."""
        return -(-self.region.height // self.size)

    @property
    def columns(self) -> int:
        """Number of columns of tiles."""
        return -(-self.region.width // self.size)

    def __len__(self) -> int:
        return self.rows * self.columns

    def __iter__(self) -> Iterator[Tile]:
        return (self.tile(row, column) for row in range(self.rows) for column in range(self.columns))

    def tile(self, grid_row: int, grid_column: int) -> Tile:
        """The tile at a place of the grid."""
        row = self.region.row + grid_row * self.size
        column = self.region.column + grid_column * self.size
        return Tile(grid_row, grid_column, Window(row, column, self.size, self.size).clipped(self.region))


def strips(height: int, width: int, pixels: int) -> Iterator[Window]:
    """Windows of whole rows, from the top, of no more pixels; of as many rows as the blocks of our files, or fewer."""
    rows = min(512, max(1, pixels // width))
    rows = rows // 64 * 64 or rows
    for row in range(0, height, rows):
        yield Window(row, 0, min(rows, height - row), width)


def facing(window: Window, minimum: int, maximum: int) -> Window:
    """The right pixels that face a left window over the search range.

    The first column is the one that faces the window's first column at ``minimum``: with arrays cut so,
    ``right[r, c + k]`` faces ``left[r, c]`` for disparity index ``k``.
    """
    return Window(window.row, window.column + minimum, window.height, window.width + maximum - minimum)
