"""Write rasters of one size as Cloud-Optimized GeoTIFFs and publish all of them."""

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np

from sat_intervals.raster.cog import CopyParts, Part, assemble, template
from sat_intervals.raster.files import File
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.layers import png_of
from sat_intervals.raster.publishing import Unfinished, check_space, failing, file_bytes, unfinished
from sat_intervals.raster.streaming import Stream
from sat_intervals.store.remote import disk_of, path_of


class OutputWriter:
    """Write files of a folder from full-width strips in increasing order, or from parts that were made elsewhere.

    Until `publish` all files have temporary names, see `new_file`; leaving the context removes these. All methods raise
    `OutputError` with the final name. Pictures (PNG) are kept in memory.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        files: Sequence[File],
        height: int,
        width: int,
        georeferencing: Georeferencing,
        tags: Mapping[str, str],
    ) -> None:
        self.folder = path_of(folder)
        self.files = tuple(files)
        self.shape = height, width
        self._georeferencing = georeferencing
        self._tags = dict(tags)
        self._opened = ExitStack()
        self._unfinished: dict[str, Unfinished] = {}
        self._streams: dict[str, Stream] = {}
        self._pictures: dict[str, list[np.ndarray]] = {}  # strips

    def __enter__(self) -> Self:
        with failing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            for file in self.files:
                self._unfinished[file.name] = stack.enter_context(unfinished(self.folder / file.name))
            check_space(self.folder, file_bytes(self.files, *self.shape), "files")
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    def write(self, row: int, *rasters: np.ndarray) -> None:
        """Write the strip that begins at ``row``; one array per file, ``(bands, rows, width)`` or ``(rows, width)``."""
        if not row:  # parts, too
            check_space(self.folder, 2 * file_bytes(self.files, *self.shape), "files")
        for file, raster in zip(self.files, rasters, strict=True):
            name = file.name
            bands = np.ascontiguousarray(raster.reshape(-1, *raster.shape[-2:]), file.dtype)
            with failing(self.folder / name):
                if file.driver == "PNG":
                    self._pictures.setdefault(name, []).append(bands)
                    continue
                if name not in self._streams:
                    self._streams[name] = Stream(file, disk_of(self.folder), self.shape)
                    self._opened.callback(self._streams[name].close)
                self._streams[name].write(bands)

    def assemble(self, file: File, levels: Sequence[Sequence[Part]], copy_parts: CopyParts) -> None:
        """Make a file of rows of blocks, see `cog.assemble`, under its temporary name."""
        with failing(self.folder / file.name):
            made = template(file, self._georeferencing, self._tags)
            assemble(self._unfinished[file.name].temporary, made, self.shape, levels, copy_parts)

    def build(self) -> dict[str, Path]:
        """Finish all files under their temporary names, and return these by name."""
        for file in self.files:
            made = self._unfinished[file.name]
            with failing(made.path):
                if stream := self._streams.pop(file.name, None):
                    stream.check_complete()
                    self.assemble(file, stream.parts, stream.copy_parts)
                    stream.close()
                if file.name in self._pictures:
                    bands = np.concatenate(self._pictures[file.name], axis=1)
                    made.temporary.write_bytes(png_of(bands, file.nodata, partial(file.describe, tags=self._tags)))
                made.flush()
        return {name: file.temporary for name, file in self._unfinished.items()}

    def publish(self) -> None:
        """Finish all files and give them their names, in the order in which the files were given."""
        self.build()
        for file in self._unfinished.values():
            with failing(file.path):
                file.commit()
