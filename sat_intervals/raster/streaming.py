"""Compress a file's rows as they come: rows of blocks, and those of its overviews, in temporary files."""

import errno
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np

from sat_intervals.machine import usable_cores
from sat_intervals.raster.blocks import BLOCK, COLUMNS, compressed, factors, halved
from sat_intervals.raster.cog import Part
from sat_intervals.raster.files import File

# Bytes of a pixel of which COLUMNS are compressed at a time, fewer of larger ones: each thread has some copies.
_PIXEL = 16


class Stream:
    """A file's rows from the top, in `parts` once a row of blocks is full.

    Rows that wait for a full row of blocks are in a file too, so that memory does not grow with the width.
    """

    def __init__(self, file: File, folder: Path, shape: tuple[int, int]) -> None:
        """``folder``: where temporary files without names are made."""
        self._file = file
        self._folder = folder
        self._shapes = [(-(-shape[0] // factor), -(-shape[1] // factor)) for factor in factors(*shape)]
        self._rows = [0 for _ in self._shapes]
        with ExitStack() as files:
            self._strips = [files.enter_context(TemporaryFile(prefix="strips-", dir=folder)) for _ in self._shapes]
            self._buffers = [self._buffer(width) for _, width in self._shapes]
            self._files = files.pop_all()
        self.parts: list[list[Part]] = [[] for _ in self._shapes]

    def _buffer(self, width: int) -> np.ndarray:
        shape = len(self._file.bands), BLOCK, width
        with TemporaryFile(prefix="strips-", dir=self._folder) as stream:
            # a full disk is an error here, not a signal later
            os.posix_fallocate(stream.fileno(), 0, int(np.prod(shape)) * np.dtype(self._file.dtype).itemsize)
            return np.memmap(stream, self._file.dtype, "r+", shape=shape)

    def write(self, bands: np.ndarray, level: int = 0) -> None:
        """Write ``(bands, rows, width)``, the next rows of a level."""
        height, buffer = self._shapes[level][0], self._buffers[level]
        while bands.shape[1]:
            filled = self._rows[level] % BLOCK
            taken = min(BLOCK - filled, bands.shape[1])
            buffer[:, filled : filled + taken] = bands[:, :taken]
            self._rows[level] += taken
            bands = bands[:, taken:]
            if filled + taken == BLOCK or self._rows[level] == height:
                self._end_row(level, buffer[:, : filled + taken])

    def _end_row(self, level: int, rows: np.ndarray) -> None:
        """Compress a row of blocks, and add its reduced rows to the next level."""
        step = max(BLOCK, COLUMNS * _PIXEL // (rows.shape[0] * rows.itemsize) // BLOCK * BLOCK)
        columns = (rows[:, :, first : first + step] for first in range(0, rows.shape[2], step))
        out = self._strips[level]
        start, sizes = out.tell(), list[int]()
        with ThreadPoolExecutor(usable_cores()) as pool:
            for blocks in pool.map(partial(compressed, file=self._file), columns):
                out.write(blocks.content)
                sizes += blocks.sizes
        out.flush()
        self.parts[level].append(Part(sizes, (level, start)))
        if level + 1 < len(self._shapes):
            self.write(halved(rows), level + 1)

    def copy_parts(self, path: Path, parts: Sequence[tuple[int, Part]]) -> None:
        """Write the parts into a file; see `CopyParts`."""
        with open(path, "r+b") as out:
            for offset, part in parts:
                level, start = part.source
                self._strips[level].seek(start)
                out.seek(offset)
                out.write(self._strips[level].read(part.length))

    def check_complete(self) -> None:
        """Raise if rows are missing."""
        if self._rows[0] != self._shapes[0][0]:
            raise OSError(errno.EIO, f"{self._rows[0]} of {self._shapes[0][0]} rows were written")

    def close(self) -> None:
        """Close the temporary files, which are then gone."""
        self._files.close()
