"""Files out: rasters of one size as Cloud-Optimized GeoTIFFs, all of them under their names or none."""

import errno
import os
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

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import gdal
from sat_intervals.raster.files import File
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.identity import checksum_of
from sat_intervals.store.folder import LocalFolder

# Folder, beside the files, where they grow until they are whole; named after the first of them, and locked. Files of
# these names that a killed process left there are replaced, others stay.
_SCRATCH = ".unpublished-{}"
# The report of a run, which is published with its files.
_REPORT = "run.json"
# Strips are kept as they come, in blocks low enough that a strip fills most of those it touches, and band by band, from
# which the final files are made in four fifths of the time.
_STRIPS = {"tiled": True, "blockxsize": 256, "blockysize": 64, "interleave": "band", "bigtiff": "IF_SAFER"}
# DEFLATE is read by all that read GeoTIFF. On the bands of a Pleiades pair level 1 makes 5.4 Mpx a second and core, and
# 49 bits a pixel; level 6, 3.2 and 46; no compression, 9.1 and 186. Predictors make these slower and larger (4.3 and
# 63): bounds are whole numbers and V-fits fractions of small ones, which come back byte for byte.
_COG = {"COMPRESS": "DEFLATE", "LEVEL": "1", "OVERVIEW_RESAMPLING": "NEAREST", "BIGTIFF": "IF_SAFER"}
# Pixels of a side below which there is no smaller overview.
_OVERVIEW_SIZE = 512
# Bytes of blocks in GDAL's hands, by default a twentieth of the machine's memory. More makes nothing faster, not even
# strips of 60 000 columns, and keeps the whole of a small image in memory.
_CACHE = 16 << 20
# Pixels of a window that is read back: blocks enough for every thread.
_READ_BACK = 512, 4096
_SUM_WRAPS = 1 << 64  # the bits of a few float64 are more
_WAY_OUT = "make room or choose another folder"


class OutputError(SatIntervalsError):
    """An output that cannot be written."""


class OutputWriter:
    """Files from full-width strips of rows in increasing order.

    ::

        with OutputWriter(folder, RUN_FILES, height, width, georeferencing, tags) as writer:
            writer.write(row, intervals, validity)  # strip by strip
            writer.publish()

    Memory follows the strip. Until `publish` the files are in a hidden folder inside ``folder``, as plain GeoTIFFs and
    then as Cloud-Optimized GeoTIFFs; leaving the context removes it, whatever happened. It is locked: of two processes
    that write the same files the second is refused.

    Parameters
    ----------
    folder
        Where the files go; made if missing.
    files
        Which.
    height, width
        Pixels.
    georeferencing
        That of the pixels written.
    tags
        Metadata of both files.
    threads
        That compress; None for one a core.

    Raises
    ------
    OutputError
        What cannot be written, from every method.
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
        self._scratch, self._replaced = self._hidden / "files", self._hidden / "files" / "replaced"
        self._locked = ExitStack()
        self._files = tuple(files)
        self._shape = height, width
        self._georeferencing = georeferencing
        self._tags = dict(tags)
        self._threads = "ALL_CPUS" if threads is None else str(threads)
        self._strips: dict[str, DatasetWriter] = {}
        self._sums = {file.name: 0 for file in files}

    def __enter__(self) -> Self:
        for file in self._files:
            place = self._folder / file.name
            if place.exists() and not place.is_file():
                raise OutputError(f"{place} cannot be written: it is no file: choose another name or folder")
        with self._failing(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
        for place in (self._hidden, self._scratch, self._replaced):
            if place.is_symlink():
                raise OutputError(f"{place} is a symbolic link, and files grow there: remove it")
        self._locked.enter_context(LocalFolder(self._hidden).locked())
        try:
            with self._failing(self._folder):
                self._remove_scratch()
                self._replaced.mkdir(parents=True, exist_ok=True)
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
        """Write the strip that begins at ``row``: of each file ``(bands, rows, width)``, or ``(rows, width)``."""
        for file, raster in zip(self._files, rasters, strict=True):
            bands = np.ascontiguousarray(raster.reshape(-1, *raster.shape[-2:]), file.dtype)
            area = RasterioWindow(0, row, self._shape[1], bands.shape[1])
            with self._failing(self._folder / file.name), Env(GDAL_CACHEMAX=_CACHE):
                self._strips[file.name].write(bands, window=area)
            self._sums[file.name] += _sum(bands)

    def build(self) -> dict[str, dict[str, int]]:
        """Make the files that `publish` names, and read them back; returns size and CRC-32 of those made, by name."""
        files = [file for file in self._files if file.name in self._strips]
        with ThreadPoolExecutor() as threads:  # GDAL's own threads compress, but one alone reads and writes a file
            return {file.name: made for file, made in zip(files, threads.map(self._build, files), strict=True)}

    def _build(self, file: File) -> dict[str, int]:
        name, strips, whole = file.name, self._strips[file.name], self._scratch / file.name
        options = _COG | {"NUM_THREADS": self._threads, "PREDICTOR": file.predictor} if file.driver == "COG" else {}
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

    def publish(self, report: tuple[str, str] | None = None) -> None:
        """Give the files their names, all of them or none.

        With a ``report``, name and text of a file that tells that the others are whole, that of before goes first and
        this one comes last: without it the others do not count. Where one fails the files of before are put back.
        """
        self.build()
        names = [file.name for file in self._files]
        if report:
            name, text = report
            names.append(name)
            with self._failing(self._folder / name):
                (self._scratch / name).write_text(text, encoding="utf-8")
                _flush(self._scratch / name)
        try:
            if report:
                self._put_aside(names[-1])
            for name in names:
                if name != names[-1]:  # after the last there is nothing to put back
                    self._put_aside(name)
                with self._failing(self._folder / name):
                    os.replace(self._scratch / name, self._folder / name)
        except BaseException:
            if (self._scratch / names[-1]).exists():
                self._take_back(names)
            raise

    def _put_aside(self, name: str) -> None:
        """Keep the file that has the name until the new ones have theirs."""
        place = self._folder / name
        with self._failing(place), suppress(FileNotFoundError):
            if place.is_dir() and not place.is_symlink():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
            os.replace(place, self._replaced / name)

    def _take_back(self, names: Sequence[str]) -> None:
        """Put back the files that had the names before."""
        for name in names:
            with suppress(OSError):
                if os.path.lexists(self._replaced / name):
                    os.replace(self._replaced / name, self._folder / name)
                elif not (self._scratch / name).exists():
                    os.unlink(self._folder / name)

    def _create(self, file: File) -> DatasetWriter:
        """A plain GeoTIFF for the strips, with all that is said of the file."""
        height, width = self._shape
        kind = {"count": len(file.bands), "dtype": file.dtype, "nodata": file.nodata}
        options = _STRIPS | kind | self._georeferencing.creation_options()
        with self._failing(self._folder / file.name), Env(GDAL_CACHEMAX=_CACHE):
            strips = gdal.create(str(self._scratch / f"strips-{file.name}"), height=height, width=width, **options)
            strips.update_tags(**self._tags)
            file.describe(strips)
        return strips

    def _add_overviews(self, strips: DatasetWriter) -> None:
        """Add overviews to the strips: the COG driver, left to itself, takes longer for them than for all the rest."""
        size = max(self._shape)
        factors = [2**level for level in range(1, 32) if size > _OVERVIEW_SIZE << (level - 1)]
        if factors:
            strips.build_overviews(factors, Resampling.nearest)

    def _verify(self, whole: Path, expected: int) -> None:
        """Read a file back, overviews included: GDAL may take a full disk for written."""
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
            raise OSError(errno.EIO, "what can be read back is not what was written")

    @contextmanager
    def _failing(self, path: Path) -> Iterator[None]:
        """Turn what fails into an error that names the file as the user knows it, and the system's reason."""
        try:
            yield
        except (*gdal.GDAL_ERRORS, OSError) as error:
            if gdal.is_out_of_memory(error):
                raise OutputError(
                    f"{path} cannot be written: not enough memory ({gdal.reason(error)}): give the process more"
                ) from error
            raise OutputError(f"{path} cannot be written: {self._reason(error)}: {_WAY_OUT}") from error

    def _reason(self, error: Exception) -> str:
        if isinstance(error, OSError) and error.strerror:
            return error.strerror
        # GDAL keeps the system's reason to itself. A Cloud-Optimized GeoTIFF is made with its overviews twice.
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
        """Delete what was made here, now or by a process that was killed, and nothing else that may be there."""
        names = [file.name for file in self._files]
        ours = (*names, *(f"strips-{name}" for name in names), _REPORT)
        for folder in (self._replaced, self._scratch):
            with suppress(OSError):
                for file in folder.iterdir():
                    if file.name.startswith(ours) and not file.is_dir():
                        file.unlink()
                folder.rmdir()


def remove_scratch(folder: Path, files: Sequence[File]) -> None:
    """Delete what a process that was killed left of files that have their names since."""
    hidden = folder / _SCRATCH.format(files[0].name)
    if hidden.is_dir() and not hidden.is_symlink():
        with LocalFolder(hidden).locked():
            OutputWriter(folder, files, 0, 0, Georeferencing(), {})._remove_scratch()


def check_space(folder: Path, files: Sequence[File], height: int, width: int) -> None:
    """Refuse a folder that has no room for files of so many pixels.

    Raises
    ------
    OutputError
        With the figures.
    """
    needed, free = _bytes(files, height, width), shutil.disk_usage(folder).free
    if needed > free:
        raise OutputError(f"{folder} has {_size(free)} left, the bands need {_size(needed)} to begin with: {_WAY_OUT}")


def _bytes(files: Sequence[File], height: int, width: int) -> int:
    """Of all bands uncompressed."""
    return height * width * sum(len(file.bands) * np.dtype(file.dtype).itemsize for file in files)


def _areas(dataset: DatasetReader) -> Iterator[RasterioWindow]:
    """Windows that cover a file."""
    height, width = _READ_BACK
    for row in range(0, dataset.height, height):
        for column in range(0, dataset.width, width):
            yield RasterioWindow(column, row, min(width, dataset.width - column), min(height, dataset.height - row))


def _sum(bands: np.ndarray) -> int:
    """Sum, modulo 2^64, of an array's bits taken as unsigned integers: one figure in whatever order blocks are read."""
    return int(bands.view(f"uint{8 * bands.itemsize}").sum(dtype=np.uint64))


def _flush(path: Path) -> None:
    """Have the system write a file to the disk, and tell if it cannot."""
    with open(path, "rb") as stream:
        os.fsync(stream.fileno())


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB"
