"""Turn cells into polygons and polygons into cells."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from rasterio.features import bounds, rasterize, shapes
from rasterio.transform import array_bounds
from rasterio.warp import transform_bounds, transform_geom

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import gdal
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.images import opened
from sat_intervals.raster.surfaces import read_place
from sat_intervals.tiling import Window

_ONE = Lock()  # rasterio changes the filters of warnings, which all threads share

Polygon = Mapping[str, Any]
"""A polygon as GeoJSON has it."""


def outlines(labels: np.ndarray, place: Georeferencing) -> list[Polygon]:
    """Return the polygons of cells of one number that touch along rows or columns, int32, by their numbers but 0."""
    found = shapes(labels, labels != 0, transform=place.affine)
    return [polygon for polygon, _ in sorted(found, key=itemgetter(1))]


@dataclass(frozen=True)
class Areas:
    """Polygons of a file on a map."""

    path: Path
    crs: str
    polygons: Sequence[Polygon]

    @cached_property
    def _extents(self) -> np.ndarray:
        """Return left, bottom, right and top of each polygon: ``(n, 4)``."""
        return np.array([bounds(one) for one in self.polygons]).reshape(-1, 4)

    def on(self, place: Georeferencing, shape: tuple[int, int]) -> "Areas":
        """Return the areas that are on a surface, on its map."""
        assert place.crs is not None
        crs, extent = place.crs.to_wkt(), array_bounds(*shape, place.affine)
        try:  # those of other places may be on no map of this one
            near = [self.polygons[one] for one in self.near(transform_bounds(crs, self.crs, *extent))]
            return Areas(self.path, crs, transform_geom(self.crs, crs, near) if near else [])
        except gdal.GDAL_ERRORS as error:
            raise SatIntervalsError(f"{self.path} is not on the map of the surface: {gdal.reason(error)}") from error

    def near(self, extent: tuple[float, float, float, float]) -> list[int]:
        """Return the indices of the areas whose extents meet one: left, bottom, right, top."""
        left, bottom, right, top = extent
        wests, souths, easts, norths = self._extents.T
        return np.flatnonzero((wests < right) & (left < easts) & (souths < top) & (bottom < norths)).tolist()


def areas_of_raster(path: Path) -> Areas:
    """Return the areas of a raster that is not 0 inside: cells that touch along rows or columns are one."""
    _, place = read_place(path)
    assert place.crs is not None
    with opened(str(path)) as dataset:
        values = dataset.read(1)
        inside = (dataset.read_masks(1) != 0) & (values != 0) & ~np.isnan(values)
    return Areas(path, place.crs.to_wkt(), outlines(inside.astype(np.int32), place))


def numbers_of(areas: Areas | None, place: Georeferencing, window: Window) -> np.ndarray:
    """Return the number of the area, from 1, that has the centre of each cell, 0 of none; the last one counts."""
    cells, shape = place.shifted(window).affine, (window.height, window.width)
    numbered = [(areas.polygons[one], one + 1) for one in areas.near(array_bounds(*shape, cells))] if areas else []
    if not numbered:
        return np.zeros(shape, np.int32)
    with _ONE:
        return np.asarray(rasterize(numbered, shape, transform=cells, dtype=np.int32))
