"""Rasters on the cells of a surface model."""

from pathlib import Path

import numpy as np
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window as Area

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import gdal
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.images import opened
from sat_intervals.tiling import Window


def read_place(path: Path) -> tuple[tuple[int, int], Georeferencing]:
    """Rows and columns of a surface, and where it lies.

    Raises
    ------
    SatIntervalsError
        Where it has no CRS or is not north up.
    """
    with opened(str(path)) as dataset:
        place = Georeferencing.of(dataset)
        if place.crs is None or place.transform is None or place.transform.b or place.transform.d:
            raise SatIntervalsError(f"{path} does not say where it lies: give a north-up raster with a CRS")
        return dataset.shape, place


def read_heights(path: Path, place: Georeferencing, shape: tuple[int, int], window: Window) -> np.ndarray:
    """The first band of a raster at the centres of cells, the nearest value of each; NaN where there is none.

    Parameters
    ----------
    path
        Any raster with a CRS.
    place, shape
        The cells.
    window
        Which of them.
    """
    height, width = shape
    grid = {"crs": place.crs, "transform": place.transform, "height": height, "width": width}
    with opened(str(path), window) as dataset:
        try:
            with WarpedVRT(dataset, resampling=Resampling.nearest, dtype="float64", nodata=np.nan, **grid) as warped:
                return np.asarray(warped.read(1, window=Area(window.column, window.row, window.width, window.height)))
        except gdal.GDAL_ERRORS as error:
            raise SatIntervalsError(f"{path} cannot be laid on the surface: {gdal.reason(error)}") from error
