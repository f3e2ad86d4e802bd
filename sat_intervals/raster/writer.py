"""Write rasters of one size as Cloud-Optimized GeoTIFFs and publish all of them or none."""

import errno
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from rasterio import Env
from rasterio.io import DatasetWriter
from rasterio.shutil import copy
from rasterio.windows import Window as RasterioWindow

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import gdal
from sat_intervals.raster.cog import CopyParts, Part, assemble, template
from sat_intervals.raster.files import File
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.identity import checksum_of, checksum_of_text
from sat_intervals.raster.layers import SUM_WRAPS, sum_of_bits
from sat_intervals.raster.publishing import REPLACED, REPORTS, OutputError, flush, pinned, publish, put_back, stamps
from sat_intervals.raster.seal import check_place
from sat_intervals.raster.space import check_space, file_bytes, way_out
from sat_intervals.raster.streaming import Stream
from sat_intervals.store.folder import LocalFolder

# Locked folder of unfinished files, named after the first of them, and the mark that a process made these files. Those
# of a killed process are replaced, others stay.
_SCRATCH, _MADE = ".unpublished-{}", ".sat-intervals.files"
# Names there: a final one, an unfinished one, and those of GDAL beside both.
_UNFINISHED = r"(?:strips-(?:[0-9a-f]+-)?)?(?:{})(?:\.aux\.xml|(?:\.warped\.tif|\.msk)?(?:\.ovr)?\.tmp)?|strips-\w{{8}}"
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
        self._hidden = self._folder / _SCRATCH.format(files[0].name)
        self._scratch, self._replaced = self._hidden / "files", self._hidden / "files" / REPLACED
        self._folders: dict[Path, os.stat_result] = {}
        self._pinned = self._scratch
        self._locked = ExitStack()
        self._files = tuple(files)
        self._names = (*(file.name for file in files), *REPORTS)
        self._shape = height, width
        self._georeferencing = georeferencing
        self._tags = dict(tags)
        self._threads = threads
        self._streams: dict[str, Stream] = {}
        self._pictures: dict[str, tuple[DatasetWriter, int]] = {}  # with the sum of the pixels
        self._made: dict[str, dict[str, int]] = {}
        self._there: dict[str, str] = {}
        self._is_published = False

    def __enter__(self) -> Self:
        self._check_places()
        self._check_beside_places()
        with self._failing(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
        self._check_hidden()
        self._locked.enter_context(LocalFolder(self._hidden).locked())
        try:
            with self._failing(self._folder):
                put_back(self._scratch, self._folder, self._names)
                self._remove_scratch()
                (self._hidden / _MADE).touch()
                self._replaced.mkdir(parents=True, exist_ok=True)
                self._pinned = self._locked.enter_context(pinned(self._scratch))
                self._folders = {place: place.lstat() for place in (self._hidden, self._scratch, self._replaced)}
                self._there = stamps(self._folder, self._names)
            check_space(self._folder, file_bytes(self._files, *self._shape), "files")
        except BaseException:
            self._clean()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._clean()

    def _check_hidden(self) -> None:
        """Raise if folders of temporary files are links, or have files of their names that no killed process left."""
        self._check_folders()
        is_ours = (self._hidden / _MADE).exists() or LocalFolder(self._hidden).has_lock()
        if not is_ours and (foreign := next(self._unfinished(self._replaced, self._scratch), None)):
            raise OutputError(f"{foreign} was not written by sat-intervals: move {self._hidden} away")

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

    def _check_folders(self) -> None:
        """Raise if folders of temporary files are not folders, are links, or are not those that were made."""
        for place in (self._hidden, self._scratch, self._replaced):
            if place.is_symlink():
                raise OutputError(f"{place} is a symbolic link, but temporary files go there: remove it")
            if place.exists() and not place.is_dir():
                raise OutputError(f"{place} is not a folder, but temporary files go there: move it away")
        for place, made in self._folders.items():
            if place.exists() and not os.path.samestat(made, place.lstat()):
                raise OutputError(f"{place}, a folder of temporary files, was replaced: move it away and rerun")

    def _unfinished(self, *folders: Path) -> Iterator[Path]:
        """Yield files with names of temporary ones in some folders."""
        ours = re.compile(_UNFINISHED.format("|".join(map(re.escape, self._names))))
        for folder in folders:
            with suppress(OSError):
                yield from (file for file in folder.iterdir() if ours.fullmatch(file.name) and not file.is_dir())

    def write(self, row: int, *rasters: np.ndarray) -> None:
        """Write the strip that begins at ``row``; one array per file, ``(bands, rows, width)`` or ``(rows, width)``."""
        if not row:
            check_space(self._folder, 2 * file_bytes(self._files, *self._shape), "files")  # parts or plain files, too
        for file, raster in zip(self._files, rasters, strict=True):
            bands = np.ascontiguousarray(raster.reshape(-1, *raster.shape[-2:]), file.dtype)
            with self._failing(self._folder / file.name):
                if file.driver == "COG":
                    if file.name not in self._streams:
                        self._streams[file.name] = Stream(file, self._pinned, self._shape, self._threads)
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
                self._pictures[file.name][0].update_tags(**self._tags)
                file.describe(self._pictures[file.name][0])
            strips, before = self._pictures[file.name]
            strips.write(bands, window=RasterioWindow(0, row, self._shape[1], bands.shape[1]))
            self._pictures[file.name] = strips, before + sum_of_bits(bands)

    def assemble(self, name: str, levels: Sequence[Sequence[Part]], copy_parts: CopyParts) -> None:
        """Make a file of rows of blocks, see `cog.assemble`, under a temporary name."""
        (file,) = (file for file in self._files if file.name == name)
        self._check_folders()
        with self._failing(self._folder / name):
            made = template(file, self._georeferencing, self._tags)
            path = self._scratch / self._new(name).name
            self._made[name] = assemble(path, made, self._shape, levels, copy_parts, is_sealed=file.is_sealed)
            os.replace(self._pinned / path.name, self._pinned / name)

    def _new(self, name: str) -> Path:
        """Return a place for a temporary file, where nobody can put a link before.

        A worker that was lost does not write into the file of a later run either.
        """
        return self._pinned / f"strips-{uuid.uuid4().hex}-{name}"

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
                flush(place)
                with gdal.reading(str(place)) as dataset:
                    if (sum_of_bits(dataset.read()) - expected) % SUM_WRAPS:
                        raise OSError(errno.EIO, "the content read back differs from that written")
                self._made[name] = checksum_of(place)
                os.replace(place, self._pinned / name)
            os.unlink(strips.name)
        self._pictures.clear()
        return dict(self._made)

    def publish(
        self,
        report: tuple[str, str] | None = None,
        *,
        replaceable: Mapping[str, str] | None = None,
        announce: Callable[[list[str]], None] = lambda stamps: None,
    ) -> None:
        """Rename the files to their final names, all of them or none; `publishing.publish` has the rules.

        Parameters
        ----------
        report
            Name and text of a file that marks the others as complete: the old one is removed first and the new one
            comes last.
        replaceable
            `stamps` of the files that may be replaced, by default of those that were there when the context was
            entered.
        announce
            Called before, with the `stamps` that the files will have, the report last.
        """
        made = self.build()
        names = [file.name for file in self._files] + ([report[0]] if report else [])
        if report:
            name, text = report
            with self._failing(self._folder / name):
                with (self._pinned / name).open("x", encoding="utf-8") as stream:
                    stream.write(text)
                flush(self._pinned / name)
            made[name] = checksum_of_text(text)
        compared = stamps(self._pinned, made)
        for name, checksum in made.items():
            with self._failing(self._folder / name):
                if checksum_of(self._pinned / name) != checksum:
                    raise OSError(errno.EIO, "the content read back differs from that written")
        self._check_beside_places()  # some may have appeared
        self._check_folders()
        if not self._scratch.exists():  # perhaps another folder took the place of the whole one
            raise OutputError(f"{self._scratch}, a folder of temporary files, is gone: rerun the command")
        announce(list(stamps(self._pinned, names).values()))
        may_go = self._there if replaceable is None else replaceable
        publish(self._pinned, self._folder, names, may_go, self._failing, compared)
        self._is_published = True

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
        self._remove_scratch()
        self._locked.close()

    def _remove_scratch(self) -> None:
        """Delete temporary files of this or a killed process, and the replaced ones after publishing; no others.

        They are deleted in open folders, so that a link that takes the place of one leads to no others.
        """
        with suppress(OutputError, OSError):
            self._check_folders()
            with pinned(self._hidden) as hidden:
                with suppress(OSError), pinned(hidden / self._scratch.name) as scratch:
                    with suppress(OSError), pinned(scratch / self._replaced.name) as replaced:
                        if self._is_published:
                            self._delete(hidden, scratch, replaced)
                        (scratch / self._replaced.name).rmdir()
                    self._delete(hidden, scratch)
                with suppress(OSError):
                    (hidden / self._scratch.name).rmdir()
                if not any(self._unfinished(self._replaced, self._scratch)):
                    (hidden / _MADE).unlink()

    def _delete(self, *opened: Path) -> None:
        """Delete the files of the last of some open folders, unless one of them is not the one that was made."""
        pairs = zip(self._folders.values(), map(Path.stat, opened), strict=False)  # those of a killed one are unknown
        are_own = all(os.path.samestat(made, there) for made, there in pairs)
        for file in [*self._unfinished(opened[-1])] if are_own else []:
            with suppress(OSError):
                file.unlink()


def remove_scratch(folder: Path, files: Sequence[File]) -> None:
    """Delete temporary files of a killed process whose final files exist."""
    with _killed(folder, files) as writer:
        writer._is_published = True


def restore(folder: Path, files: Sequence[File]) -> None:
    """Restore the files that a killed process put aside, and delete its temporary ones."""
    with _killed(folder, files) as writer:
        put_back(writer._scratch, folder, writer._names)


def replaceable(folder: Path, files: Sequence[File]) -> dict[str, str]:
    """Return the `stamps` of files that exist before a command, after `restore`."""
    restore(folder, files)
    return stamps(folder, [file.name for file in files])


@contextmanager
def _killed(folder: Path, files: Sequence[File]) -> Iterator[OutputWriter]:
    """Yield the writer of a killed process; afterwards delete its temporary files."""
    writer = OutputWriter(folder, files, 0, 0, Georeferencing(), {})
    writer._check_hidden()
    if writer._hidden.is_dir():
        with LocalFolder(writer._hidden).locked():
            yield writer
            writer._remove_scratch()
    else:
        yield writer
