"""A pair as its preparation sees it: windows of two sides, of files or of arrays; and who does the work."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from sat_intervals.config import Disparity
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.row_offsets import RowOffsets, shift_rows
from sat_intervals.match.around import CELL, ranges_around
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.whole import cut, whole_view
from sat_intervals.prepare.local import given_ranges
from sat_intervals.raster import Image, OutputWriter, read_window
from sat_intervals.tiling import View, Window

Each = Callable[[Callable[..., Any], Sequence[tuple[Any, ...]], str], Iterator[tuple[int, Any]]]
"""Calls a function with each of some arguments in a stage; yields results with the number of their arguments."""

Rows = tuple[list[np.ndarray], dict[str, Any]]
"""A row of blocks of files, ``(bands, rows, columns)`` of each, and what is noted of it, in JSON."""

RowArguments = Callable[[Window], tuple[Any, ...]]
"""Returns what a function needs that makes the rows of a window; all of it picklable."""


class Pool(Protocol):
    """Who does the work: an `Each` that also writes files."""

    @property
    def progress(self) -> Callable[[str, int, int], None]:
        """Return the callback that it calls."""

    def __call__(
        self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], stage: str
    ) -> Iterator[tuple[int, Any]]:
        """See `Each`."""

    def write_rows(
        self, writer: OutputWriter, function: Callable[..., Rows], arguments: RowArguments, stage: str
    ) -> list[dict[str, Any]]:
        """Write all files of a writer; ``function`` makes a row of blocks from ``arguments`` of its window.

        Returns what is noted of each row of blocks, from the top.
        """


def is_plain(image: Image) -> bool:
    """Return whether nothing declares pixels of an image as no data."""
    return image.nodata is None and not image.use_mask and image.alpha is None and image.mask is None


@dataclass(frozen=True)
class FilePair:
    """A pair of files; side 0 is the left one. Where workers are processes it is picklable."""

    left: Image
    right: Image

    @property
    def names(self) -> tuple[str, str]:
        """Return what messages call both images."""
        return self.left.path, self.right.path

    @property
    def shapes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return rows and columns of both images."""
        return (self.left.height, self.left.width), (self.right.height, self.right.width)

    def is_plain(self, side: int) -> bool:
        """Return whether nothing declares pixels of an image as no data."""
        return is_plain((self.left, self.right)[side])

    def view(self, side: int, window: Window) -> View:
        """Read a window, which may leave the image: beyond it there is no data. Runs on a worker."""
        return View(window, *read_window((self.left, self.right)[side], window))

    def given_ranges(self, search: Disparity) -> tuple[LocalRanges, str] | None:
        """Return local search ranges that a raster gives, and its path; None without."""
        return given_ranges(search, self.left)

    def with_rows(self, rows: RowOffsets | None) -> "FilePair":
        """Return the pair whose right image is read at other rows."""
        return replace(self, right=replace(self.right, rows=rows))


class ArrayPair:
    """A pair of masked arrays ``(rows, columns)`` of floats; ``disparity`` is that of another matcher, NaN for none."""

    names = "the left array", "the right array"

    def __init__(self, left: np.ma.MaskedArray, right: np.ma.MaskedArray, disparity: np.ndarray | None = None) -> None:
        self.images, self.disparity = (left, right), disparity
        self.shapes = left.shape, right.shape
        self._views = whole_view(left), whole_view(right)

    def is_plain(self, side: int) -> bool:
        """Return whether no pixel of an image is masked."""
        return not np.ma.getmaskarray(self.images[side]).any()

    def view(self, side: int, window: Window) -> View:
        """Cut a window out."""
        return cut(self._views[side], window)

    def given_ranges(self, search: Disparity) -> tuple[LocalRanges, str] | None:
        """Return the ranges around the disparities."""
        if search.grid or search.around:
            raise SatIntervalsError("a raster needs files: use match_pair, or disparity local, or intervals_around")
        if self.disparity is None:
            return None
        rows = (self.disparity[row : row + CELL] for row in range(0, len(self.disparity), CELL))
        return ranges_around(rows, search.margin), "the array of disparities"

    def with_rows(self, rows: RowOffsets | None) -> "ArrayPair":
        """Return the pair with its right image resampled; itself without row offsets."""
        if rows is None:
            return self
        first, count, *places = rows.read(0, 0, *self.shapes[1])
        wider = self.view(1, Window(first, 0, count, self.shapes[1][1]))
        pixels, state = shift_rows(wider.pixels, wider.state, *places)
        return ArrayPair(self.images[0], np.ma.array(pixels, mask=state != 0), self.disparity)


Pair = FilePair | ArrayPair


def here(
    function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], stage: str = ""
) -> Iterator[tuple[int, Any]]:
    """Call a function with each of some arguments, one after the other; an `Each`."""
    return enumerate(function(*each) for each in arguments)
