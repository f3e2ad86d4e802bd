"""Single layers that fit in memory: those of the demo, and the truth that results are held against."""

import os
from contextlib import suppress
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


def write_layer(
    path: str | os.PathLike[str], pixels: np.ndarray, nodata: float, georeferencing: Georeferencing
) -> None:
    """Write ``(rows, columns)`` as a tiled, compressed GeoTIFF of one band."""
    height, width = pixels.shape
    kind = {"count": 1, "dtype": pixels.dtype.name, "nodata": nodata, "tiled": True, "compress": "deflate"}
    with (
        Env(),
        gdal.create(str(path), height=height, width=width, **kind, **georeferencing.creation_options()) as dataset,
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
    if path.exists() and not overwrite:
        with suppress(*gdal.GDAL_ERRORS):
            if np.array_equal(read_layers(path), pixels[np.newaxis], equal_nan=pixels.dtype.kind == "f"):
                return
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
