"""Write rasters of one size as Cloud-Optimized GeoTIFFs and publish all of them or none."""

import errno
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from rasterio import Env
from rasterio.enums import Resampling
from rasterio.io import DatasetReader, DatasetWriter
from rasterio.shutil import copy
from rasterio.windows import Window as RasterioWindow

from sat_intervals.raster import gdal
from sat_intervals.raster.files import File
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.identity import checksum_of
from sat_intervals.raster.publishing import REPLACED, REPORTS, OutputError, publish, put_back, stamps
from sat_intervals.store.folder import LocalFolder

# Locked folder of unfinished files, named after the first of them. Files of these names from a killed process are
# replaced, others stay.
_SCRATCH = ".unpublished-{}"
# Names there: a final one, that of its strips, and those of GDAL beside both.
_UNFINISHED = r"(?:strips-)?(?:{})(?:\.aux\.xml|(?:\.warped\.tif|\.msk)?(?:\.ovr)?\.tmp)?"
# Layout of the temporary strips. Blocks are low, so that a strip fills most of those it touches; interleaving by band
# saves a fifth of the time of the final files.
_STRIPS = {"tiled": True, "blockxsize": 256, "blockysize": 64, "interleave": "band", "bigtiff": "IF_SAFER"}
# Every GeoTIFF reader supports DEFLATE. On the bands of a Pleiades pair level 1 writes 5.4 Mpx per second and core, 49
# bits per pixel; level 6: 3.2 and 46; no compression: 9.1 and 186. Predictors are slower and larger (4.3 and 63), since
# bounds are integers and V-fits are fractions of small ones, whose bytes repeat.
_COG = {"COMPRESS": "DEFLATE", "LEVEL": "1", "OVERVIEW_RESAMPLING": "NEAREST", "BIGTIFF": "IF_SAFER"}
# Tags in the file itself, not in another beside it.
_PNG = {"WRITE_METADATA_AS_TEXT": "YES"}
# Side in pixels of the smallest overview.
_OVERVIEW_SIZE = 512
# GDAL's block cache in bytes; the default is a twentieth of the memory. A larger cache is not faster, even for strips
# of 60 000 columns, and keeps small images in memory.
_CACHE = 16 << 20
# Rows and columns of a window that is read back: enough blocks for every thread.
_READ_BACK = 512, 4096
_SUM_WRAPS = 1 << 64  # sums of bits are modulo 2^64
_WAY_OUT = "free disk space or choose another folder"


class OutputWriter:
    """Write files from full-width strips of rows in increasing order.

    ::

        with OutputWriter(folder, RUN_FILES, height, width, georeferencing, tags) as writer:
            writer.write(row, intervals, validity)  # strip by strip
            writer.publish()

    Memory depends on the strip. Until `publish` the files are in a hidden folder inside ``folder``, as plain GeoTIFFs
    and then as Cloud-Optimized GeoTIFFs; leaving the context removes it in any case. The folder is locked: a second
    process that writes the same files is refused.

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
        self._locked = ExitStack()
        self._files = tuple(files)
        self._names = (*(file.name for file in files), *REPORTS)
        self._shape = height, width
        self._georeferencing = georeferencing
        self._tags = dict(tags)
        self._threads = "ALL_CPUS" if threads is None else str(threads)
        self._strips: dict[str, DatasetWriter] = {}
        self._sums = {file.name: 0 for file in files}
        self._there: dict[str, str] = {}
        self._is_published = False

    def __enter__(self) -> Self:
        for file in self._files:
            place = self._folder / file.name
            if place.exists() and not place.is_file():
                raise OutputError(f"{place} cannot be written: it is not a regular file: choose another name or folder")
        with self._failing(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
        for place in (self._hidden, self._scratch, self._replaced):
            if place.is_symlink():
                raise OutputError(f"{place} is a symbolic link, but temporary files go there: remove it")
        self._locked.enter_context(LocalFolder(self._hidden).locked())
        try:
            with self._failing(self._folder):
                put_back(self._scratch, self._folder, self._names)
                self._remove_scratch()
                self._replaced.mkdir(parents=True, exist_ok=True)
                self._there = stamps(self._folder, self._names)
            check_space(self._folder, self._files, *self._shape)
            for file in self._files:
                self._strips[file.name] = self._create(file)
        except BaseException:
            self._clean()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._clean()

    def write(self, row: int, *rasters: np.ndarray) -> None:
        """Write the strip that begins at ``row``; one array per file, ``(bands, rows, width)`` or ``(rows, width)``."""
        for file, raster in zip(self._files, rasters, strict=True):
            bands = np.ascontiguousarray(raster.reshape(-1, *raster.shape[-2:]), file.dtype)
            area = RasterioWindow(0, row, self._shape[1], bands.shape[1])
            with self._failing(self._folder / file.name), Env(GDAL_CACHEMAX=_CACHE):
                self._strips[file.name].write(bands, window=area)
            self._sums[file.name] += _sum(bands)

    def build(self) -> dict[str, dict[str, int]]:
        """Build the final files under temporary names and read them back; return size and CRC-32 by name."""
        files = [file for file in self._files if file.name in self._strips]
        with ThreadPoolExecutor() as threads:  # GDAL compresses in threads, but reads and writes in one
            return {file.name: made for file, made in zip(files, threads.map(self._build, files), strict=True)}

    def _build(self, file: File) -> dict[str, int]:
        name, strips, whole = file.name, self._strips[file.name], self._scratch / file.name
        options = _COG | {"NUM_THREADS": self._threads, "PREDICTOR": file.predictor} if file.driver == "COG" else _PNG
        with self._failing(self._folder / name), Env(GDAL_CACHEMAX=_CACHE):
            if file.driver == "COG":
                self._add_overviews(strips)
            strips.close()
            del self._strips[name]
            copy(strips.name, str(whole), driver=file.driver, **options)
            _flush(whole)
            self._verify(whole, self._sums[name])
            made = checksum_of(whole)
        os.unlink(strips.name)
        return made

    def publish(self, report: tuple[str, str] | None = None, *, replaceable: Mapping[str, str] | None = None) -> None:
        """Rename the files to their final names, all of them or none; `publishing.publish` has the rules.

        Parameters
        ----------
        report
            Name and text of a file that marks the others as complete: the old one is removed first and the new one
            comes last.
        replaceable
            `stamps` of the files that may be replaced, by default of those that were there when the context was
            entered.
        """
        self.build()
        names = [file.name for file in self._files]
        if report:
            name, text = report
            names.append(name)
            with self._failing(self._folder / name):
                (self._scratch / name).write_text(text, encoding="utf-8")
                _flush(self._scratch / name)
        publish(self._scratch, self._folder, names, self._there if replaceable is None else replaceable, self._failing)
        self._is_published = True

    def _create(self, file: File) -> DatasetWriter:
        """Create a plain GeoTIFF for the strips, with all metadata of the final file."""
        height, width = self._shape
        kind = {"count": len(file.bands), "dtype": file.dtype, "nodata": file.nodata}
        options = _STRIPS | kind | self._georeferencing.creation_options()
        with self._failing(self._folder / file.name), Env(GDAL_CACHEMAX=_CACHE):
            strips = gdal.create(str(self._scratch / f"strips-{file.name}"), height=height, width=width, **options)
            strips.update_tags(**self._tags)
            file.describe(strips)
        return strips

    def _add_overviews(self, strips: DatasetWriter) -> None:
        """Add overviews to the strips; the COG driver's own take longer than all its other work."""
        size = max(self._shape)
        factors = [2**level for level in range(1, 32) if size > _OVERVIEW_SIZE << (level - 1)]
        if factors:
            strips.build_overviews(factors, Resampling.nearest)

    def _verify(self, whole: Path, expected: int) -> None:
        """Read a file back, with its overviews: GDAL may not report a full disk."""
        found = 0
        with gdal.reading(str(whole), num_threads=self._threads) as dataset:
            levels = range(len(dataset.overviews(1)))
            for area in _areas(dataset):
                found += _sum(dataset.read(window=area))
        for level in levels:
            with gdal.reading(str(whole), overview_level=level, num_threads=self._threads) as dataset:
                for area in _areas(dataset):
                    dataset.read(window=area)
        if (found - expected) % _SUM_WRAPS:
            raise OSError(errno.EIO, "the content read back differs from that written")

    @contextmanager
    def _failing(self, path: Path) -> Iterator[None]:
        """Turn errors into an OutputError with the final name of the file and the system's reason."""
        try:
            yield
        except (*gdal.GDAL_ERRORS, OSError) as error:
            if gdal.is_out_of_memory(error):
                raise OutputError(
                    f"{path} cannot be written: not enough memory ({gdal.reason(error)}): give the process more memory"
                ) from error
            raise OutputError(f"{path} cannot be written: {self._reason(error)}: {_WAY_OUT}") from error

    def _reason(self, error: Exception) -> str:
        if isinstance(error, OSError) and error.strerror:
            return error.strerror
        # GDAL hides the system's reason. A Cloud-Optimized GeoTIFF needs room for two copies.
        free = shutil.disk_usage(self._folder).free
        full = (
            f"{os.strerror(errno.ENOSPC)}, {_size(free)} free: " if free < 2 * _bytes(self._files, *self._shape) else ""
        )
        return full + gdal.reason(error)

    def _clean(self) -> None:
        for strips in self._strips.values():
            with suppress(*gdal.GDAL_ERRORS):
                strips.close()
        self._strips.clear()
        self._remove_scratch()
        self._locked.close()

    def _remove_scratch(self) -> None:
        """Delete temporary files of this or a killed process, and the replaced ones after publishing; no others."""
        ours = re.compile(_UNFINISHED.format("|".join(map(re.escape, self._names))))
        for folder in (self._replaced, self._scratch):
            with suppress(OSError):
                for file in folder.iterdir() if folder == self._scratch or self._is_published else ():
                    if ours.fullmatch(file.name) and not file.is_dir():
                        file.unlink()
                folder.rmdir()


def remove_scratch(folder: Path, files: Sequence[File]) -> None:
    """Delete temporary files of a killed process whose final files exist."""
    with _killed(folder, files) as writer:
        writer._is_published = True


def restore(folder: Path, files: Sequence[File]) -> None:
    """Restore the files that a killed process put aside, and delete its temporary ones."""
    with _killed(folder, files) as writer:
        put_back(writer._scratch, folder, writer._names)


@contextmanager
def _killed(folder: Path, files: Sequence[File]) -> Iterator[OutputWriter]:
    """Yield the writer of a killed process; afterwards delete its temporary files."""
    writer = OutputWriter(folder, files, 0, 0, Georeferencing(), {})
    if writer._hidden.is_dir() and not writer._hidden.is_symlink():
        with LocalFolder(writer._hidden).locked():
            yield writer
            writer._remove_scratch()
    else:
        yield writer


def check_space(folder: Path, files: Sequence[File], height: int, width: int) -> None:
    """Raise if a folder has not enough free space for files of ``height`` x ``width`` pixels.

    Raises
    ------
    OutputError
        Gives free and needed space.
    """
    needed, free = _bytes(files, height, width), shutil.disk_usage(folder).free
    if needed > free:
        raise OutputError(f"{folder} has {_size(free)} free, the bands need at least {_size(needed)}: {_WAY_OUT}")


def _bytes(files: Sequence[File], height: int, width: int) -> int:
    """Return the size of all bands without compression."""
    return height * width * sum(len(file.bands) * np.dtype(file.dtype).itemsize for file in files)


def _areas(dataset: DatasetReader) -> Iterator[RasterioWindow]:
    """Yield windows that cover a file."""
    height, width = _READ_BACK
    for row in range(0, dataset.height, height):
        for column in range(0, dataset.width, width):
            yield RasterioWindow(column, row, min(width, dataset.width - column), min(height, dataset.height - row))


def _sum(bands: np.ndarray) -> int:
    """Return the sum of an array's bits as unsigned integers, modulo 2^64; independent of the order of blocks."""
    return int(bands.view(f"uint{8 * bands.itemsize}").sum(dtype=np.uint64))


def _flush(path: Path) -> None:
    """Flush a file to the disk; raises if that fails."""
    with open(path, "rb") as stream:
        os.fsync(stream.fileno())


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB"
