"""Read and write layers that fit in memory, and replace files atomically."""

import errno
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType

import numpy as np
from rasterio import Env
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.windows import Window as RasterioWindow

from sat_intervals.errors import SatIntervalsError, check_regular
from sat_intervals.raster import gdal
from sat_intervals.raster.beside import check_beside, check_place
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.images import check_holds, opened
from sat_intervals.raster.old_publishing import (
    OutputError,
    check_opened,
    check_own,
    examined,
    pinned,
    rename_new,
    replace_same,
    stamps,
)
from sat_intervals.raster.seal import is_as_made
from sat_intervals.store.folder import LocalFolder
from sat_intervals.tiling import Window, strips

# Pixels read back at a time.
_STRIP = 1 << 22
SUM_WRAPS = 1 << 64
"""Sums of bits are modulo 2^64."""
_DIFFERS = "the content read back differs from that written"
# Name of a file kept aside: the report's stamp and the file's name.
_ASIDE = ".sat-intervals.{}.{}"

MARK = MappingProxyType({"SOFTWARE": "sat-intervals"})
"""Tag of rasters that this tool may replace."""


def north_up(crs: str | int, x: float, y: float, pixel: float) -> Georeferencing:
    """Return the georeferencing of a north-up image with square pixels and its upper left corner at ``x, y``."""
    return Georeferencing(crs=CRS.from_user_input(crs), transform=Affine(pixel, 0.0, x, 0.0, -pixel, y))


@contextmanager
def whole_file(path: str | os.PathLike[str], before: Mapping[str, str] | None = None) -> Iterator[Path]:
    """Give the block a temporary file to write; rename it to ``path`` at the end, or delete it on failure.

    A file at ``path`` is replaced only if it has its stamp in ``before``, the `stamps` that a command takes before its
    work, by default now; any other is kept. A symbolic link there is replaced, not followed. What a killed process left
    is deleted, see `LocalFolder.scratch`.

    Raises
    ------
    OutputError
        Names ``path`` and the system's reason, or says that another file came there, or another folder in its place.
    """
    path = Path(path)
    if not path.is_symlink():
        check_regular(path, "move it away")
    with _named(path), pinned(path.parent.resolve()) as parent:  # nothing is done in a folder that takes its place
        before = stamps(parent, [path.name]) if before is None else before
        if path.is_dir() and not path.is_symlink():
            raise OutputError(f"{path} is a folder: move it away")
        scratch = LocalFolder(parent).scratch(path.name, "[0-9a-f]{32}.*")
        with scratch as folder, pinned(folder) as own:
            new = own / f"{uuid.uuid4().hex}{path.suffix}"  # nobody can put a link there before
            yield new
            check_own(new)
            with new.open("rb") as file:
                written = os.fstat(file.fileno())
                os.fsync(file.fileno())  # after a power loss it could be empty
                if os.fstat(file.fileno()).st_size != written.st_size:
                    raise OutputError(f"{path} was truncated while it was written: rerun the command")
            check_opened(path.parent, parent, path.parent)
            _put(new, parent / path.name, before)
        check_opened(path.parent, parent, path.parent)


def write_file(
    path: Path, content: bytes, before: Mapping[str, str] | None = None, check: Callable[[], None] = lambda: None
) -> str:
    """Write a small file as `whole_file` does and read it back; ``check`` is called before it gets its name.

    Returns
    -------
    Its stamp, see `stamps`.

    Raises
    ------
    OutputError
        See `whole_file`; or the content read back differs.
    """
    with whole_file(path, before) as new:
        new.write_bytes(content)
        check_own(new)
        with new.open("rb") as file:
            os.fsync(file.fileno())  # takes long: the content may change meanwhile
        check()
        if new.read_bytes() != content:
            raise OSError(errno.EIO, _DIFFERS)
        return stamps(new.parent, [new.name])[new.name]


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Turn errors of the block into an OutputError with the name of a file."""
    try:
        yield
    except FileExistsError as error:
        raise OutputError(f"{path} was written by another process meanwhile: move it away") from error
    except (*gdal.GDAL_ERRORS, OSError) as error:
        reason = getattr(error, "strerror", None) or gdal.reason(error)
        raise OutputError(f"{path} cannot be written: {reason}: make room or check its rights") from error


def _put(new: Path, path: Path, before: Mapping[str, str]) -> None:
    """Give a file its name; one that is there is replaced only if it has its stamp in ``before``."""
    if path.name in before and os.path.lexists(path):
        replace_same(new, path, before[path.name])
    else:
        rename_new(new, path)


@contextmanager
def put_back(files: Sequence[Path], report: Path) -> Iterator[None]:
    """Keep copies of files that the block may replace; restore them at the end unless it has replaced ``report``.

    If the process is killed, the next call with the same files restores them.
    """
    with LocalFolder(report.parent).locked():
        _settle(files, report)
        try:
            for file in files:
                if not (file.is_symlink() or is_marked(file)):  # the block keeps it
                    continue
                try:
                    os.link(file, _aside(file, report), follow_symlinks=False)
                except OSError:  # a file system without hard links
                    if file.is_symlink():
                        os.symlink(os.readlink(file), _aside(file, report))
                        continue
                    with whole_file(_aside(file, report)) as new:
                        shutil.copy2(file, new)
            yield
        finally:
            _settle(files, report)


def _settle(files: Sequence[Path], report: Path) -> None:
    """Restore the copies that belong to the current report, and delete those of an earlier one."""
    for file in files:
        ours = re.compile(rf"\.sat-intervals\.(?:[0-9a-f]+-[0-9a-f]+|none)\.{re.escape(file.name)}")
        for kept in [other for other in file.parent.iterdir() if ours.fullmatch(other.name)]:
            if kept == _aside(file, report):
                with examined(file.parent, [file.name]) as there:
                    check_marked(file)  # of the user's, since the process was killed
                with _named(file):
                    _put(kept, file, there)
            kept.unlink(missing_ok=True)


def _aside(file: Path, report: Path) -> Path:
    """Return where the copy of a file is kept until the current report is replaced."""
    which = stamps(report.parent, [report.name]).get(report.name, "none")
    return file.with_name(_ASIDE.format(which, file.name))


def write_layer(
    path: str | os.PathLike[str],
    pixels: np.ndarray,
    nodata: float,
    georeferencing: Georeferencing,
    tags: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Write ``(rows, columns)`` as a tiled, compressed GeoTIFF of one band; replaces an existing file."""
    _write(path, pixels, nodata, georeferencing, tags)


def _write(
    path: str | os.PathLike[str],
    pixels: np.ndarray,
    nodata: float,
    georeferencing: Georeferencing,
    tags: Mapping[str, str],
    before: Mapping[str, str] | None = None,
) -> None:
    """Write a layer and read it back: GDAL closes a file without an error when the disk is full."""
    height, width = pixels.shape
    kind = {"count": 1, "height": height, "width": width, "dtype": pixels.dtype.name, "nodata": nodata}
    kind |= {"tiled": True, "compress": "deflate", **georeferencing.creation_options()}
    difference = sum_of_bits(np.ascontiguousarray(pixels))
    with whole_file(path, before) as new:
        with Env(), gdal.create(str(new), **kind) as dataset:
            dataset.update_tags(**tags)
            dataset.write(pixels, 1)
        with gdal.reading(str(new)) as dataset:
            for window in strips(height, width, _STRIP):
                difference -= sum_of_bits(dataset.read(window=RasterioWindow(0, window.row, width, window.height)))
        if difference % SUM_WRAPS:
            raise OSError(errno.EIO, _DIFFERS)
        if MARK.items() <= tags.items():  # again: files may have appeared meanwhile
            check_marked(Path(path))
            check_place(Path(path), has_transform=georeferencing.transform is not None)


def sum_of_bits(bands: np.ndarray) -> int:
    """Return the sum of an array's bits as unsigned integers, modulo SUM_WRAPS; independent of the order of blocks."""
    return int(bands.view(f"uint{8 * bands.itemsize}").sum(dtype=np.uint64))


def write_once(
    path: Path, pixels: np.ndarray, nodata: float, georeferencing: Georeferencing, before: Mapping[str, str] | None
) -> None:
    """Write a layer with `write_layer` and `MARK`, unless the file already has the same content.

    ``before`` are the `stamps` of the files that may be replaced, None if none may.

    Raises
    ------
    SatIntervalsError
        The file has other content, and may not be replaced or has no mark; or see `check_place`.
    """
    check_place(path, has_transform=georeferencing.transform is not None)
    with examined(path.parent, [path.name]):
        if path.exists():
            with suppress(SatIntervalsError):
                if np.array_equal(read_layers(path), pixels[np.newaxis], equal_nan=pixels.dtype.kind == "f"):
                    return
            if before is None:
                raise SatIntervalsError(f"{path} has other content: choose another folder or --overwrite")
            check_marked(path)
    _write(path, pixels, nodata, georeferencing, MARK, before or {})


def read_layers(path: str | os.PathLike[str], window: Window | None = None, band: int | None = None) -> np.ndarray:
    """Read all bands of a file or of a window inside it, ``(bands, rows, columns)`` in the file's type.

    Of one ``band``, counted from 1: ``(rows, columns)``.
    """
    area = window and RasterioWindow(window.column, window.row, window.width, window.height)
    with opened(str(path), window) as dataset:
        if window:
            check_holds(dataset, str(path), window, band or 1)
        return np.asarray(dataset.read(band, window=area))


def read_known(path: str | os.PathLike[str]) -> np.ndarray:
    """Read all bands of a file, ``(bands, rows, columns)``; NaN where there is no data."""
    with opened(str(path)) as dataset:
        return np.where(dataset.read_masks() != 0, dataset.read(), np.nan)


def read_shape(path: str | os.PathLike[str]) -> tuple[int, int, int]:
    """Return the numbers of bands, rows and columns of a file."""
    with opened(str(path)) as dataset:
        return dataset.count, dataset.height, dataset.width


def is_marked(path: str | os.PathLike[str]) -> bool:
    """Return whether a raster has the tag of all files of this tool, see `MARK`."""
    with suppress(SatIntervalsError):
        tags = read_tags(path)
        return tags.get("SOFTWARE", tags.get("Software", "")).startswith(MARK["SOFTWARE"])  # the latter in PNG
    return False


def check_marked(path: Path) -> None:
    """Raise if a raster exists without the mark of this tool. Links are replaced, never followed: they pass."""
    if path.exists() and not path.is_symlink() and not is_marked(path):
        raise SatIntervalsError(
            f"{path} exists and was not made by sat-intervals, or by a version that left no mark in it: move it away"
        )


def check_as_made(path: Path) -> None:
    """Raise if a raster with a CRC-32 in it, such as a surface model, was changed since; links pass, as above.

    Other programs that make another file of one copy its `MARK`, but not the CRC-32.
    """
    if path.is_file() and not path.is_symlink() and not is_as_made(path):
        raise SatIntervalsError(
            f"{path} was changed since sat-intervals made it, or is of a version without checksums: move it away"
        )


def check_made_by(path: Path, command: str, tag: str, value: str | None = None) -> None:
    """Raise if a raster exists that this command did not make: it lacks `MARK` or the command's tag.

    If ``value`` is None, any value of the tag passes.
    Links are replaced, never followed: they pass.
    """
    check_marked(path)
    if path.is_file() and not path.is_symlink():
        found = read_tags(path).get(tag)
        if found is None or value not in (None, found):
            raise SatIntervalsError(
                f"{path} exists and was not made by sat-intervals {command}, or by an earlier version: move it away"
            )


def read_alone(path: str | os.PathLike[str]) -> tuple[tuple[int, int, int], Georeferencing]:
    """Return bands, rows and columns of one of our rasters, and its georeferencing.

    Raises
    ------
    SatIntervalsError
        Files beside it change what GDAL reads from it, see `check_beside`.
    """
    with opened(str(path)) as dataset:
        check_beside(os.fspath(path), dataset.files)
        return (dataset.count, dataset.height, dataset.width), Georeferencing.of(dataset)


def read_tags(path: str | os.PathLike[str]) -> dict[str, str]:
    """Read the tags of a file as a whole."""
    with opened(str(path)) as dataset:
        return dict(dataset.tags())
