"""Write rasters of one size as Cloud-Optimized GeoTIFFs and publish all of them or none."""

import errno
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Self

import numpy as np
from rasterio import Env
from rasterio.io import DatasetWriter
from rasterio.shutil import copy
from rasterio.windows import Window as RasterioWindow

from sat_intervals.config.sealing import ROOM, sealed
from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import gdal
from sat_intervals.raster.beside import check_place
from sat_intervals.raster.cog import CopyParts, Part, assemble, template
from sat_intervals.raster.files import File
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.hidden import HiddenFolder
from sat_intervals.raster.identity import checksum_of, checksum_of_text
from sat_intervals.raster.layers import SUM_WRAPS, sum_of_bits
from sat_intervals.raster.old_publishing import OutputError, flush, stamps
from sat_intervals.raster.space import check_space, file_bytes, way_out
from sat_intervals.raster.streaming import Stream

# Tags in the file itself, not in another beside it.
_PNG = {"WRITE_METADATA_AS_TEXT": "YES"}
# GDAL's block cache in bytes; the default is a twentieth of the memory.
_CACHE = 16 << 20


class OutputWriter:
    """Write files from full-width strips of rows in increasing order, or from parts that were made elsewhere.

    ::

        with OutputWriter(folder, RUN_FILES, height, width, georeferencing, tags) as writer:
            writer.write(row, intervals, validity)  # strip by strip
            writer.publish()

    Memory depends on the strip. Until `publish` the files are in a hidden folder inside ``folder``, first in parts;
    leaving the context removes it in any case. The folder is locked: a second process that writes the same files is
    refused.

    Parameters
    ----------
    folder
        Output folder; created if missing.
    files
        The files to write.
    height, width
        Pixels.
    georeferencing
        Georeferencing of the pixels written.
    tags
        Metadata of all files.
    threads
        Threads for compression; None for one per core.

    Raises
    ------
    OutputError
        From every method: names the file that cannot be written.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        files: Sequence[File],
        height: int,
        width: int,
        georeferencing: Georeferencing,
        tags: Mapping[str, str],
        *,
        threads: int | None = None,
    ) -> None:
        self._folder = Path(folder)
        self._hidden = HiddenFolder(self._folder, [file.name for file in files])
        self._locked = ExitStack()
        self._files = tuple(files)
        self._shape = height, width
        self._georeferencing = georeferencing
        self._tags = dict(tags)
        self._threads = threads
        self._streams: dict[str, Stream] = {}
        self._pictures: dict[str, tuple[DatasetWriter, int]] = {}  # with the sum of the pixels
        self._made: dict[str, dict[str, int]] = {}

    def __enter__(self) -> Self:
        self._check_places()
        self._check_beside_places()
        with self._failing(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
        self._locked.enter_context(self._hidden.opened())
        try:
            with self._failing(self._folder):
                self._locked.enter_context(self._hidden.made())
            check_space(self._folder, file_bytes(self._files, *self._shape), "files")
        except BaseException:
            self._clean()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._clean()

    def _check_places(self) -> None:
        """Raise if something is in the place of a file that is not a file."""
        for place in (self._folder / file.name for file in self._files):
            if place.exists() and not place.is_file():
                raise OutputError(f"{place} cannot be written: it is not a regular file: choose another name or folder")

    def _check_beside_places(self) -> None:
        """Raise if GDAL would read a file with one of those that are written, see `check_place`."""
        for place in (self._folder / file.name for file in self._files):
            try:
                check_place(place, has_transform=self._georeferencing.transform is not None)
            except SatIntervalsError as error:
                raise OutputError(str(error)) from error

    def write(self, row: int, *rasters: np.ndarray) -> None:
        """Write the strip that begins at ``row``; one array per file, ``(bands, rows, width)`` or ``(rows, width)``."""
        if not row:
            check_space(self._folder, 2 * file_bytes(self._files, *self._shape), "files")  # parts or plain files, too
        for file, raster in zip(self._files, rasters, strict=True):
            bands = np.ascontiguousarray(raster.reshape(-1, *raster.shape[-2:]), file.dtype)
            with self._failing(self._folder / file.name):
                if file.driver == "COG":
                    if file.name not in self._streams:
                        self._streams[file.name] = Stream(file, self._hidden.opened_files, self._shape, self._threads)
                    self._streams[file.name].write(row, bands)
                else:
                    self._draw(file, row, bands)

    def _draw(self, file: File, row: int, bands: np.ndarray) -> None:
        """Write a strip of a picture, which GDAL makes of a plain GeoTIFF."""
        with Env(GDAL_CACHEMAX=_CACHE):
            if file.name not in self._pictures:
                height, width = self._shape
                kind = {"count": len(file.bands), "dtype": file.dtype, "nodata": file.nodata}
                path = self._new(file.name)
                self._pictures[file.name] = gdal.create(str(path), height=height, width=width, **kind), 0
                self._pictures[file.name][0].update_tags(**self._tags, COMMENT=ROOM)
                file.describe(self._pictures[file.name][0])
            strips, before = self._pictures[file.name]
            strips.write(bands, window=RasterioWindow(0, row, self._shape[1], bands.shape[1]))
            self._pictures[file.name] = strips, before + sum_of_bits(bands)

    def assemble(self, name: str, levels: Sequence[Sequence[Part]], copy_parts: CopyParts) -> None:
        """Make a file of rows of blocks, see `cog.assemble`, under a temporary name."""
        (file,) = (file for file in self._files if file.name == name)
        self._hidden.check()
        with self._failing(self._folder / name):
            made = template(file, self._georeferencing, self._tags)
            path = self._hidden.files / self._new(name).name
            self._made[name] = assemble(path, made, self._shape, levels, copy_parts)
            os.replace(self._hidden.opened_files / path.name, self._hidden.opened_files / name)

    def _new(self, name: str) -> Path:
        """Return a place for a temporary file, where nobody can put a link before.

        A worker that was lost does not write into the file of a later run either.
        """
        return self._hidden.opened_files / f"strips-{uuid.uuid4().hex}-{name}"

    def build(self) -> dict[str, dict[str, int]]:
        """Build the final files under temporary names; return size and CRC-32 by name."""
        for name, stream in self._streams.items():
            with self._failing(self._folder / name):
                stream.check_complete()
            self.assemble(name, stream.parts, stream.copy_parts)
            stream.close()
        self._streams.clear()
        for name, (strips, expected) in self._pictures.items():
            with self._failing(self._folder / name), Env(GDAL_CACHEMAX=_CACHE):
                strips.close()
                place = self._new(name)
                copy(strips.name, str(place), driver="PNG", **_PNG)
                place.write_bytes(sealed(place.read_bytes()))
                flush(place)
                with gdal.reading(str(place)) as dataset:
                    if (sum_of_bits(dataset.read()) - expected) % SUM_WRAPS:
                        raise OSError(errno.EIO, "the content read back differs from that written")
                self._made[name] = checksum_of(place)
                os.replace(place, self._hidden.opened_files / name)
            os.unlink(strips.name)
        self._pictures.clear()
        return dict(self._made)

    def publish(
        self,
        report: tuple[str, str] | None = None,
        *,
        replaceable: Mapping[str, str] = MappingProxyType({}),
        announce: Callable[[list[str]], None] = lambda stamps: None,
    ) -> dict[str, str]:
        """Rename the files to their final names, all of them or none; `publishing.publish` has the rules.

        Return their `stamps`.

        Parameters
        ----------
        report
            Name and text of a file that marks the others as complete: the old one is removed first and the new one
            comes last.
        replaceable
            `stamps` of the files that may be replaced, see `examined`.
        announce
            Called before, with the `stamps` that the files will have, the report last.
        """
        made = self.build()
        names = [file.name for file in self._files] + ([report[0]] if report else [])
        if report:
            name, text = report
            with self._failing(self._folder / name):
                with (self._hidden.opened_files / name).open("x", encoding="utf-8") as stream:
                    stream.write(text)
                flush(self._hidden.opened_files / name)
            made[name] = checksum_of_text(text)
        compared = stamps(self._hidden.opened_files, made)
        for name, checksum in made.items():
            with self._failing(self._folder / name):
                if checksum_of(self._hidden.opened_files / name) != checksum:
                    raise OSError(errno.EIO, "the content read back differs from that written")
        self._check_beside_places()  # some may have appeared
        self._hidden.check_complete()
        published = stamps(self._hidden.opened_files, names)
        announce(list(published.values()))
        self._hidden.publish(names, replaceable, self._failing, compared)
        return published

    @contextmanager
    def _failing(self, path: Path) -> Iterator[None]:
        """Turn errors into an OutputError with the final name of the file and the system's reason."""
        try:
            yield
        except (*gdal.GDAL_ERRORS, OSError) as error:
            why = f"{self._reason(error)}: {way_out(error)}"
            if gdal.is_out_of_memory(error):
                why = f"not enough memory ({gdal.reason(error)}): give the process more memory"
            raise OutputError(f"{path} cannot be written: {why}") from error

    def _reason(self, error: Exception) -> str:
        """Return the system's reason, which GDAL hides when the disk is full."""
        if isinstance(error, OSError) and error.strerror:
            return error.strerror
        is_full = shutil.disk_usage(self._folder).free < file_bytes(self._files, *self._shape)
        return f"{os.strerror(errno.ENOSPC)}: {gdal.reason(error)}" if is_full else gdal.reason(error)

    def _clean(self) -> None:
        for strips, _ in self._pictures.values():
            with suppress(*gdal.GDAL_ERRORS):
                strips.close()
        for stream in self._streams.values():
            with suppress(OSError):
                stream.close()
        self._pictures.clear()
        self._streams.clear()
        self._hidden.remove()
        self._locked.close()
