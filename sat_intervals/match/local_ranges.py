"""Search ranges of the cells of an image: within them pixels are matched as over the whole range (METHOD.md, 17)."""

import base64
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from sat_intervals.config import Config
from sat_intervals.kernels.cost import Cells
from sat_intervals.tiling import Window


@dataclass(frozen=True)
class LocalRanges:
    """Search ranges of square cells, counted from the first pixel of the left image.

    minimum, maximum: ``(rows, columns)`` int16: first and last disparity of each cell in pixels; they cover the image.
    height, width: pixels of a cell.
    """

    minimum: np.ndarray
    maximum: np.ndarray
    height: int
    width: int

    def clipped(self, minimum: int, maximum: int) -> "LocalRanges":
        """Ranges within a whole one; a cell that then has none, or had none, gets all of it."""
        least, most = np.maximum(self.minimum, minimum), np.minimum(self.maximum, maximum)
        empty = least > most
        least, most = np.where(empty, minimum, least), np.where(empty, maximum, most)
        return LocalRanges(least.astype(np.int16), most.astype(np.int16), self.height, self.width)

    def _cells_of(self, window: Window) -> tuple[slice, slice]:
        """Cells that a window inside the image meets."""
        rows = slice(window.row // self.height, -(-window.row_stop // self.height))
        return rows, slice(window.column // self.width, -(-window.column_stop // self.width))

    def within(self, window: Window, config: Config) -> Config:
        """Settings that search the hull of the ranges of a window: as much as one of its pixels needs, and no more."""
        here = self._cells_of(window)
        least, most = int(self.minimum[here].min()), int(self.maximum[here].max())
        hull = config.disparity.model_copy(update={"minimum": least, "maximum": most})
        return config.model_copy(update={"disparity": hull})

    def cells(self, window: Window, minimum: int) -> Cells:
        """Ranges of the cells of a window for the kernels; ``minimum`` is the first disparity of its hull."""
        rows, columns = here = self._cells_of(window)
        first, last = (bound[here].astype(np.int64) - minimum for bound in (self.minimum, self.maximum))
        row, column = window.row - rows.start * self.height, window.column - columns.start * self.width
        return Cells(first, last, self.height, self.width, row, column)

    def at(self, window: Window, step: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """First and last disparity of the cell of each pixel, or of every n-th row and column, of a window."""
        rows = np.arange(window.row, window.row_stop, step) // self.height
        columns = np.arange(window.column, window.column_stop, step) // self.width
        return self.minimum[np.ix_(rows, columns)], self.maximum[np.ix_(rows, columns)]

    def report(self) -> dict[str, Any]:
        """Return the mapping that the store and run.json hold; bounds are int16 in base 64, compressed by zlib."""
        bounds = {name: getattr(self, name).astype("<i2").tobytes() for name in ("minimum", "maximum")}
        packed = {name: base64.b64encode(zlib.compress(content, 9)).decode() for name, content in bounds.items()}
        rows, columns = self.minimum.shape
        return {"rows": rows, "columns": columns, "height": self.height, "width": self.width, **packed}

    @classmethod
    def of_report(cls, report: dict[str, Any]) -> "LocalRanges":
        """Read the mapping that `report` makes."""
        rows, columns = report["rows"], report["columns"]
        packed = (zlib.decompress(base64.b64decode(report[name])) for name in ("minimum", "maximum"))
        minimum, maximum = (np.frombuffer(bound, "<i2").astype(np.int16).reshape(rows, columns) for bound in packed)
        return cls(minimum, maximum, report["height"], report["width"])

    @property
    def share(self) -> float:
        """Mean number of candidates of a cell, as a share of the whole range."""
        counts = self.maximum.astype(int) - self.minimum + 1
        return float(counts.mean() / (int(self.maximum.max()) - int(self.minimum.min()) + 1))


def narrowed(ranges: LocalRanges | None, window: Window, config: Config) -> Config:
    """Settings that a window is matched with: over the hull of its local ranges, if there are any."""
    return ranges.within(window, config) if ranges else config
