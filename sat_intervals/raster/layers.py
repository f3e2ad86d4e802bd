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
from sat_intervals.tiling import Window


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
    """Keep files aside while the block may replace them; put them back where it fails before ``report`` is new."""

    def which() -> tuple[int, int] | None:
        return (report.stat().st_ino, report.stat().st_mtime_ns) if report.exists() else None

    of_before = which()
    aside = {file: file.with_name(f".{uuid.uuid4().hex}-{file.name}") for file in files if os.path.lexists(file)}
    try:
        for file, before in aside.items():
            try:
                os.link(file, before, follow_symlinks=False)
            except OSError:  # a disk without links
                shutil.copy2(file, before, follow_symlinks=False)
        yield
    except BaseException:
        for file, before in aside.items():
            with suppress(FileNotFoundError):
                if which() == of_before:
                    os.replace(before, file)
        raise
    finally:
        for before in aside.values():  # also where it is a link to the very file
            before.unlink(missing_ok=True)


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
