"""Georeferencing of an image, as stored in its file, and its outline on the Earth."""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import pyproj
from pyproj import Transformer
from pyproj.exceptions import ProjError
from rasterio.control import GroundControlPoint
from rasterio.crs import CRS
from rasterio.rpc import RPC
from rasterio.transform import Affine

from sat_intervals.tiling import Window

Corners = list[tuple[float, float]]


class ControlPoint(NamedTuple):
    """A ground control point: row and column in pixels from the image's upper left corner, map x, y and height z."""

    row: float
    column: float
    x: float
    y: float
    z: float


@dataclass(frozen=True)
class Georeferencing:
    """CRS and transform, control points or RPCs, as far as the file has them."""

    crs: CRS | None = None
    transform: Affine | None = None  # from column and row to the CRS
    gcps: tuple[ControlPoint, ...] = ()
    gcps_crs: CRS | None = None
    rpcs: RPC | None = None

    @classmethod
    def of(cls, dataset: Any) -> "Georeferencing":
        """Return the georeferencing of an open rasterio dataset."""
        points, points_crs = dataset.gcps
        return cls(
            crs=dataset.crs,
            transform=None if dataset.transform == Affine.identity() else dataset.transform,
            gcps=tuple(ControlPoint(point.row, point.col, point.x, point.y, point.z or 0.0) for point in points),
            gcps_crs=points_crs,
            rpcs=dataset.rpcs,
        )

    @property
    def affine(self) -> Affine:
        """Return the transform where there must be one."""
        assert self.transform is not None
        return self.transform

    @property
    def pixel_size(self) -> tuple[float, float]:
        """Return width and height of a pixel in units of the CRS; needs a transform."""
        a, b, _, d, e, _ = self.affine[:6]
        return math.hypot(a, d), math.hypot(b, e)

    def shifted(self, window: Window) -> "Georeferencing":
        """Return the georeferencing of a window of the image."""
        row, column = window.row, window.column
        transform, rpcs = self.transform, self.rpcs
        if transform is not None:
            a, b, c, d, e, f = transform[:6]
            transform = Affine(a, b, c + a * column + b * row, d, e, f + d * column + e * row)
        if rpcs is not None:
            offsets = {"line_off": rpcs.line_off - row, "samp_off": rpcs.samp_off - column}
            rpcs = RPC(**rpcs.to_dict() | offsets)
        gcps = tuple(point._replace(row=point.row - row, column=point.column - column) for point in self.gcps)
        return replace(self, transform=transform, gcps=gcps, rpcs=rpcs)

    def moved(self, x: float, y: float) -> "Georeferencing":
        """Return the georeferencing with all pixels moved by x, y in units of the CRS; needs a transform."""
        a, b, c, d, e, f = self.affine[:6]
        return replace(self, transform=Affine(a, b, c + x, d, e, f + y))

    def coarser(self, across: float, down: float) -> "Georeferencing":
        """Return the georeferencing with pixels ``across`` x ``down`` times as large; needs a transform."""
        a, b, c, d, e, f = self.affine[:6]
        return replace(self, transform=Affine(a * across, b * down, c, d * across, e * down, f))

    def creation_options(self) -> dict[str, Any]:
        """Return rasterio's creation options for a new GeoTIFF, which stores a transform or control points."""
        options: dict[str, Any] = {"crs": self.crs, "transform": self.transform}
        if self.gcps and self.transform is None:
            options = {"gcps": [GroundControlPoint(*point) for point in self.gcps], "crs": self.gcps_crs or CRS()}
        if self.rpcs is not None:
            errors = {"ERR_BIAS": self.rpcs.err_bias, "ERR_RAND": self.rpcs.err_rand}  # to_gdal leaves out zeros
            known = {name: str(value) for name, value in errors.items() if value is not None}
            options["rpcs"] = self.rpcs.to_gdal() | known
        return options


def horizontal_name(crs: CRS) -> str:
    """Return code or WKT of a CRS of rasterio; of a compound one those of its horizontal part."""
    found = pyproj.CRS.from_wkt(crs.to_wkt()).to_2d()
    code = found.to_epsg()
    return f"EPSG:{code}" if code else found.to_wkt()


def between_180(longitude: Any) -> Any:
    """Return longitudes as degrees from -180 to 180."""
    return (longitude + 180) % 360 - 180


def footprint(place: Georeferencing, shape: tuple[int, int]) -> Corners | None:
    """Return longitude and latitude (degrees, WGS 84) of four corners, counter-clockwise; None without georeferencing.

    Longitudes are continuous across 180. RPCs alone give the box for which they are valid, larger than the image.
    """
    height, width = shape
    if place.crs is not None and place.transform is not None:
        a, b, c, d, e, f = place.transform[:6]
        ends = ((0, height), (width, height), (width, 0), (0, 0))
        corners = [(a * x + b * y + c, d * x + e * y + f) for x, y in ends]
        crs = place.crs
    elif place.gcps and place.gcps_crs:
        corners = _box([point.x for point in place.gcps], [point.y for point in place.gcps])
        crs = place.gcps_crs
    elif place.rpcs is not None:
        x, y, width, height = (getattr(place.rpcs, name) for name in ("long_off", "lat_off", "long_scale", "lat_scale"))
        return _box([x - width, x + width], [y - height, y + height])
    else:
        return None
    try:
        to_degrees = Transformer.from_crs(crs.to_wkt(), "EPSG:4326", always_xy=True)
    except ProjError:  # a local CRS has no place on the ground
        return None
    found = [to_degrees.transform(x, y) for x, y in corners]
    first = found[0][0]
    found = [(first + between_180(longitude - first), latitude) for longitude, latitude in found]
    area = sum(x * v - u * y for (x, y), (u, v) in zip(found, found[1:] + found[:1], strict=True))
    return found if area > 0 else found[::-1]


def _box(x: list[float], y: list[float]) -> Corners:
    return [(min(x), min(y)), (max(x), min(y)), (max(x), max(y)), (min(x), max(y))]
