"""Rasters of heights that a test makes up: references, surface models, geoids."""

import numpy as np
import rasterio
from rasterio.transform import Affine

from sat_intervals.products import SURFACE

PLACE = Affine(1, 0, 370_000, 0, -1, 4_830_000)


def write_raster(path, bands, place=PLACE, crs="EPSG:32631", tags=None):
    """Write bands ``(bands, rows, columns)``; six of them make a surface model."""
    bands = np.asarray(bands, np.float32)
    kind = {"height": bands.shape[1], "width": bands.shape[2], "count": bands.shape[0], "dtype": "float32"}
    with rasterio.open(path, "w", driver="GTiff", nodata=np.nan, crs=crs, transform=place, **kind) as dataset:
        dataset.write(bands)
        dataset.update_tags(**tags or {})
        if len(bands) == len(SURFACE):
            dataset.descriptions = [band.name for band in SURFACE]
    return path


def write_surface(path, height, lower, upper, tags=None):
    """Write a surface model of cells of 1 m."""
    more = np.ones((len(SURFACE) - 3, *np.shape(height)))
    return write_raster(path, np.concatenate([[height, lower, upper], more]), tags=tags)


def write_geoid(path, height):
    """Write a geoid at one height over the whole area."""
    return write_raster(path, np.full((1, 4, 4), height), Affine(1, 0, 0, 0, -1, 46), "EPSG:4326")
