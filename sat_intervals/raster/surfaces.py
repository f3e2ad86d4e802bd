"""Read rasters on the grid of a surface model."""

from dataclasses import replace
from math import ceil, floor
from pathlib import Path

import numpy as np
import pyproj
from rasterio.crs import CRS
from rasterio.enums import MaskFlags, Resampling
from rasterio.transform import Affine, array_bounds
from rasterio.vrt import WarpedVRT
from rasterio.warp import calculate_default_transform, reproject, transform_bounds

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import SURFACE
from sat_intervals.raster import gdal
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.heightfield import is_ground, other_unit, warn_of_no_data
from sat_intervals.raster.images import opened
from sat_intervals.raster.vertical import horizontal
from sat_intervals.tiling import Window

Bounds = tuple[float, float, float, float]
_DATUM = 10.0  # metres: a larger median difference is another datum, not an error


def surface_place(path: Path) -> tuple[tuple[int, int], Georeferencing]:
    """Return what `read_place` does; raise if a file has not the bands of a surface model."""
    with opened(str(path)) as dataset:
        if dataset.descriptions != tuple(band.name for band in SURFACE):
            raise SatIntervalsError(f"{path} is not a surface model of sat-intervals dsm: give one, or make it again")
    return read_place(path)


def read_place(path: Path, *, is_flat: bool = True) -> tuple[tuple[int, int], Georeferencing]:
    """Return rows and columns of a raster, and its georeferencing, which must be north up.

    The CRS is horizontal, or has heights, too, where the file says so and ``is_flat`` is False.
    """
    with opened(str(path)) as dataset:
        place = Georeferencing.of(dataset)
        place = replace(place, crs=horizontal(place.crs) if is_flat else place.crs)
        if place.crs is None or place.transform is None or place.transform.b or place.transform.d:
            raise SatIntervalsError(f"{path} has no CRS or is not north up: give a north-up raster with a CRS")
        return dataset.shape, place


def check_reference(path: Path, surface: Path) -> None:
    """Raise if reference heights have a local CRS, another unit, or another vertical datum than a surface model."""
    with opened(str(surface)) as dataset:
        level = dataset.tags().get("HEIGHTS", "")
    check_level(path, str(surface), level)


def check_level(path: Path, surface: str, level: str) -> None:
    """Do the same of a surface whose heights are above ``level``, in words."""
    with opened(str(path)) as dataset:
        crs, unit = pyproj.CRS.from_wkt(dataset.crs.to_wkt()), other_unit(dataset)
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    if not (parts[0].is_geographic or parts[0].is_projected):
        raise SatIntervalsError(f"the CRS of {path}, {crs.name}, is a local one: give a reference on the Earth")
    if len(crs.axis_info) > 2 and crs.axis_info[2].unit_conversion_factor != 1:
        unit = crs.axis_info[2].unit_name
    if unit:
        raise SatIntervalsError(
            f"{path} has heights in {unit}: convert them to metres, or correct the unit of the band"
        )
    if len(parts) > 1 and level.endswith("ellipsoid") and "ellipsoid" not in parts[1].name.lower():
        raise SatIntervalsError(
            f"{path} has heights of {parts[1].name}, {surface} heights {level}: make the surface with --geoid, or "
            "convert the reference to the ellipsoid"
        )


def datum_warnings(one: Path, other: Path, median: float) -> list[str]:
    """Return a warning if the median difference of heights is as large as that of two datums."""
    if abs(median) <= _DATUM:
        return []
    return [
        f"heights of {one} and {other} differ by {median:.1f} m in the median, as heights above a geoid and heights "
        "above the ellipsoid do: check what they refer to"
    ]


def resolution_of(path: Path, place: Georeferencing) -> float:
    """Return the pixel size of a raster in units of another CRS."""
    with opened(str(path)) as dataset:
        transform, _, _ = calculate_default_transform(
            dataset.crs, place.crs, dataset.width, dataset.height, *dataset.bounds
        )
        return float(transform.a)


def covered_window(path: Path, place: Georeferencing, shape: tuple[int, int]) -> Window:
    """Return the part of a north-up grid of cells that the extent of a raster covers; all cells if it is unknown."""
    whole, grid = Window(0, 0, *shape), place.affine
    with opened(str(path)) as dataset:
        given = dataset.bounds
        cells = transform_bounds(place.crs, dataset.crs, *array_bounds(*shape, grid))
        left, right = max(cells[0], given.left), min(cells[2], given.right)
        bottom, top = max(cells[1], min(given.bottom, given.top)), min(cells[3], max(given.bottom, given.top))
        if not (left < right and bottom < top):  # apart, or across the antimeridian
            return whole
        # only the common part: the whole extent may reach where the CRS of the cells is not defined
        west, south, east, north = transform_bounds(dataset.crs, place.crs, left, bottom, right, top)
    first = (north - grid.f) / grid.e, (west - grid.c) / grid.a
    last = (south - grid.f) / grid.e, (east - grid.c) / grid.a
    return Window.around(first, last).clipped(whole)


def read_heights(
    path: Path, place: Georeferencing, shape: tuple[int, int], window: Window, *, smooth: bool = False, band: int = 1
) -> np.ndarray:
    """Read a band, scaled, at the cells of a window, NaN if unknown; interpolated if ``smooth``, else the nearest."""
    height, width = shape
    grid = {"crs": place.crs, "transform": place.transform, "height": height, "width": width}
    grid |= {"resampling": Resampling.bilinear if smooth else Resampling.nearest}
    area = window.slices
    with opened(str(path), window) as dataset:
        try:
            with WarpedVRT(dataset, dtype="float64", nodata=np.nan, **grid) as warped:
                values = warped.read(band, window=area)
            # GDAL ignores the mask of a raster with a no-data value
            if dataset.nodata is not None and MaskFlags.per_dataset in dataset.mask_flag_enums[band - 1]:
                with WarpedVRT(dataset, src_nodata=None, dtype="float64", nodata=np.nan, **grid) as masked:
                    values[masked.read(band, window=area) != values] = np.nan  # also where one of both was interpolated
        except gdal.GDAL_ERRORS as error:
            raise SatIntervalsError(f"{path} cannot be resampled to the surface: {gdal.reason(error)}") from error
        return np.asarray(values * dataset.scales[band - 1] + dataset.offsets[band - 1])


def ground_of(path: Path, bounds: Bounds, around: float) -> tuple[np.ndarray, Georeferencing]:
    """Return heights of a raster, resampled to EPSG:4326, and their georeferencing.

    It must cover ``bounds``, in degrees; ``around``: degrees more, where unknown heights are the median of the others.
    """
    shape, place = read_place(path)
    west, south, east, north = bounds
    window = _cells(place, bounds)
    whole = Window(0, 0, *shape)
    degrees = CRS.from_epsg(4326)
    if window.clipped(whole) != window:
        ends = array_bounds(*shape, place.transform)
        own = transform_bounds(place.crs, degrees, ends[0], min(ends[1::2]), ends[2], max(ends[1::2]))
        raise SatIntervalsError(
            f"{path} does not cover the images, at longitudes {west:.4f} to {east:.4f}, latitudes {south:.4f} to "
            f"{north:.4f}, but only {own[0]:.4f} to {own[2]:.4f} and {own[1]:.4f} to {own[3]:.4f}: give a larger DEM"
        )
    warn_of_no_data(path, window)
    cell = resolution_of(path, Georeferencing(crs=degrees))
    columns, rows = (ceil((last - first + 2 * around) / cell) for first, last in ((west, east), (south, north)))
    grid = Georeferencing(crs=degrees, transform=Affine(cell, 0, west - around, 0, -cell, north + around))
    near = _cells(place, (west - around, south - around, east + around, north + around)).grown(2, 2).clipped(whole)
    heights, given = np.full((rows, columns), np.nan), {"src_crs": place.crs, "src_nodata": np.nan}
    wanted = {"dst_crs": degrees, "dst_transform": grid.transform, "resampling": Resampling.bilinear}
    with opened(str(path), near) as dataset:
        known = dataset.read(1, window=near.slices) * dataset.scales[0] + dataset.offsets[0]
        known[(dataset.read_masks(1, window=near.slices) == 0) | ~is_ground(known)] = np.nan
    reproject(known, heights, src_transform=place.shifted(near).transform, **given, **wanted)
    margin = floor(around / cell)
    outside = np.ones(heights.shape, bool)
    outside[margin : rows - margin, margin : columns - margin] = False
    known = heights[np.isfinite(heights)]
    if not known.size:
        raise SatIntervalsError(f"{path} has no heights at the images: give a DEM that has some there")
    heights[outside & np.isnan(heights)] = np.median(known)
    return heights, grid


def _cells(place: Georeferencing, bounds: Bounds) -> Window:
    """Return the cells of a raster, north or south up, around bounds in degrees."""
    a, _, c, _, e, f = place.affine[:6]
    left, bottom, right, top = transform_bounds("EPSG:4326", place.crs, *bounds)
    rows, columns = sorted(((bottom - f) / e, (top - f) / e)), sorted(((left - c) / a, (right - c) / a))
    return Window.around(*zip(rows, columns, strict=True))
