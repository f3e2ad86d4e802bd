"""Single layers that fit in memory: those of the demo, and the truth that results are held against."""

import os

import numpy as np
from rasterio import Env
from rasterio.crs import CRS
from rasterio.transform import Affine

from sat_intervals.raster import gdal
from sat_intervals.raster.georeferencing import Georeferencing


def north_up(epsg: int, x: float, y: float, pixel: float) -> Georeferencing:
    """The georeferencing of an image whose upper left corner is at ``x, y`` of a CRS, with square pixels."""
    return Georeferencing(crs=CRS.from_epsg(epsg), transform=Affine(pixel, 0.0, x, 0.0, -pixel, y))


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


def read_layers(path: str | os.PathLike[str]) -> np.ndarray:
    """Read all bands of a file: ``(bands, rows, columns)`` in the file's type."""
    with gdal.reading(str(path)) as dataset:
        return np.asarray(dataset.read())
