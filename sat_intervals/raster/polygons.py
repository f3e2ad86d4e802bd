"""Turn cells into polygons and polygons into cells."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rasterio.features import rasterize, shapes
from rasterio.warp import transform_geom

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import gdal
from sat_intervals.raster.georeferencing import Georeferencing

Polygon = Mapping[str, Any]
"""A polygon as GeoJSON has it."""


def outline(inside: np.ndarray, place: Georeferencing) -> Polygon:
    """Return the polygon around cells that touch along rows or columns, ``(rows, columns)`` bool."""
    found: Polygon = next(shapes(inside.astype(np.uint8), inside, transform=place.affine))[0]
    return found


def burned(polygons: Sequence[Polygon], crs: str, place: Georeferencing, shape: tuple[int, int]) -> np.ndarray:
    """Return which cells have their centre in one of some polygons of a CRS."""
    try:
        moved = transform_geom(crs, place.crs, polygons)
    except gdal.GDAL_ERRORS as error:
        raise SatIntervalsError(
            f"polygons of {crs[:40]} are not on the map of the surface: {gdal.reason(error)}"
        ) from error
    return np.asarray(rasterize(moved, shape, transform=place.affine, dtype=np.uint8)) > 0
