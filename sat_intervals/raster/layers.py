"""Single layers that fit in memory, such as those of the demo, and files that replace others when they are whole."""

import os
import shutil
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from rasterio import Env
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.windows import Window as RasterioWindow

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import gdal
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.images import opened
from sat_intervals.store.folder import LocalFolder
from sat_intervals.tiling import Window

# A file kept aside: by which report, and its name.
_ASIDE = ".sat-intervals.{}.{}"


def north_up(crs: str | int, x: float, y: float, pixel: float) -> Georeferencing:
    """The georeferencing of an image whose upper left corner is at ``x, y`` of a CRS, with square pixels."""
    return Georeferencing(crs=CRS.from_user_input(crs), transform=Affine(pixel, 0.0, x, 0.0, -pixel, y))


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A new file beside ``path``, for the block to write, that takes the name at its end, or goes where it fails.

    A link that has the name is replaced, not followed.
    """
    path = Path(path)
    new = path.with_name(f".{uuid.uuid4().hex}-{path.name}")
    try:
        yield new
        os.replace(new, path)
    finally:
        with suppress(OSError):
            new.unlink()


@contextmanager
def put_back(files: Sequence[Path], report: Path) -> Iterator[None]:
    """Keep files aside while the block may replace them; put them back where it ends before ``report`` is new.

    Where the process is killed, the next block of the same files begins with that.
    """
    with LocalFolder(report.parent).locked():
        _settle(files, report)
        try:
            for file in filter(os.path.lexists, files):
                try:
                    os.link(file, _aside(file, report), follow_symlinks=False)
                except OSError:  # a disk without links
                    with whole_file(_aside(file, report)) as new:
                        shutil.copy2(file, new, follow_symlinks=False)
            yield
        finally:
            _settle(files, report)


def _settle(files: Sequence[Path], report: Path) -> None:
    """Put files back that were kept with the report that is there, and delete those kept with one of before."""
    for file in files:
        for kept in file.parent.glob(_ASIDE.format("*", file.name)):
            if kept == _aside(file, report):
                os.replace(kept, file)
            kept.unlink(missing_ok=True)  # also where it is a link to the very file


def _aside(file: Path, report: Path) -> Path:
    """Where a file is kept until the report that is there now is replaced."""
    status = report.stat() if report.exists() else None
    which = f"{status.st_size:x}-{status.st_mtime_ns:x}" if status else "none"
    return file.with_name(_ASIDE.format(which, file.name))


def write_layer(
    path: str | os.PathLike[str], pixels: np.ndarray, nodata: float, georeferencing: Georeferencing
) -> None:
    """Write ``(rows, columns)`` as a tiled, compressed GeoTIFF of one band, in place of what has the name."""
    height, width = pixels.shape
    kind = {"count": 1, "dtype": pixels.dtype.name, "nodata": nodata, "tiled": True, "compress": "deflate"}
    with (
        whole_file(path) as new,
        Env(),
        gdal.create(str(new), height=height, width=width, **kind, **georeferencing.creation_options()) as dataset,
    ):
        dataset.write(pixels, 1)


def write_once(
    path: Path, pixels: np.ndarray, nodata: float, georeferencing: Georeferencing, *, overwrite: bool
) -> None:
    """Write a layer as `write_layer` does, unless the file holds it already.

    Raises
    ------
    SatIntervalsError
        When the file holds something else, and is not to be overwritten.
    """
    if path.exists():
        with suppress(SatIntervalsError):
            if np.array_equal(read_layers(path), pixels[np.newaxis], equal_nan=pixels.dtype.kind == "f"):
                return
        if not overwrite:
            raise SatIntervalsError(f"{path} holds something else: choose another folder or --overwrite")
    write_layer(path, pixels, nodata, georeferencing)


def read_layers(path: str | os.PathLike[str], window: Window | None = None) -> np.ndarray:
    """Read all bands of a file, or of a window inside it: ``(bands, rows, columns)`` in the file's type."""
    area = window and RasterioWindow(window.column, window.row, window.width, window.height)
    with opened(str(path), window) as dataset:
        return np.asarray(dataset.read(window=area))


def read_shape(path: str | os.PathLike[str]) -> tuple[int, int, int]:
    """Bands, rows and columns of a file."""
    with opened(str(path)) as dataset:
        return dataset.count, dataset.height, dataset.width


def read_tags(path: str | os.PathLike[str]) -> dict[str, str]:
    """What a file says of itself as a whole."""
    with opened(str(path)) as dataset:
        return dict(dataset.tags())
