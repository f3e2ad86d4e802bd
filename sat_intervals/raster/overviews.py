"""Read reduced versions of large rasters through their overviews; memory depends on the reduced size."""

import os

import numpy as np
from rasterio.enums import Resampling
from rasterio.windows import Window as RasterioWindow

from sat_intervals.raster.images import Image, opened
from sat_intervals.raster.windows import read_inside
from sat_intervals.tiling import Window


def read_small_layers(path: str | os.PathLike[str], shape: tuple[int, int]) -> np.ndarray:
    """Read all bands of a file as ``(bands, *shape)`` in the file's type, with nearest-neighbour sampling."""
    with opened(str(path)) as dataset:
        return np.asarray(dataset.read(out_shape=(dataset.count, *shape)))


def read_small_image(image: Image, window: Window, shape: tuple[int, int]) -> np.ndarray:
    """Read a window inside an image as ``shape`` pixels, averaged; NaN where not usable."""
    picked, state = read_inside(image, window, shape)
    if shape == (window.height, window.width):
        means = picked
    else:
        area = RasterioWindow(window.column, window.row, window.width, window.height)
        with opened(image.path, window) as dataset:
            means = dataset.read(image.band, window=area, out_shape=shape, resampling=Resampling.average)
    return np.where(state == 0, means, np.nan)
