"""Convert points on the WGS 84 ellipsoid to maps, CRS and vertical references of files, and back."""

from dataclasses import dataclass
from functools import partial
from math import floor
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS, Proj, Transformer
from pyproj.exceptions import CRSError, ProjError

from sat_intervals.errors import SatIntervalsError, check_file
from sat_intervals.raster.georeferencing import Georeferencing, between_180
from sat_intervals.raster.images import opened

_GEOGRAPHIC = "EPSG:4326"
Places = tuple[np.ndarray, np.ndarray, np.ndarray]  # degrees of longitude and latitude, and metres
_UTM = -80.0, 84.0  # degrees of latitude beyond which UPS replaces UTM
_BEYOND = 6.0  # degrees outside the area of a CRS that are accepted: the next UTM zone
# Largest scale error of a map: above that of UTM in the next zone (1 %) and of polar maps at their edges (4 %).
_LARGEST_DISTORTION = 0.05
_LARGEST_UNDULATION = 120.0  # metres


def utm_of(longitude: float, latitude: float) -> str:
    """Return the UTM zone of a place (degrees), such as ``EPSG:32637``, or the polar map of UPS."""
    longitude = between_180(longitude)
    if not _UTM[0] <= latitude <= _UTM[1]:
        return "EPSG:32661" if latitude > 0 else "EPSG:32761"
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + floor((longitude + 180) / 6) % 60 + 1}"


def grid_mapping(place: Georeferencing) -> dict[str, Any]:
    """Return CRS and transform as attributes of a CF grid mapping, with those of GDAL; empty without both."""
    attributes: dict[str, Any] = {}
    if place.crs is not None:
        wkt = place.crs.to_wkt()
        attributes |= CRS.from_wkt(wkt).to_cf() | {"crs_wkt": wkt, "spatial_ref": wkt}
    if place.transform is not None:
        attributes["GeoTransform"] = " ".join(map(repr, place.transform.to_gdal()))
    return attributes


def _crs_of(name: str) -> CRS:
    """Return the CRS of a name such as EPSG:2154, 2154 or WKT."""
    try:
        return CRS.from_user_input(f"EPSG:{name}" if name.isdecimal() else name)
    except CRSError as error:
        raise SatIntervalsError(f"{name} is not a CRS known to PROJ: give one such as EPSG:32637") from error


class Projection:
    """Convert points to map coordinates in metres, and heights above the ellipsoid to heights above a geoid."""

    def __init__(self, crs: str, geoid: Path | None = None) -> None:
        """``crs`` is a projected CRS in metres, ``geoid`` a grid of geoid heights that PROJ reads (GTX, GeoTIFF)."""
        target = _crs_of(crs)
        name = f"{crs} ({target.name})"
        if not target.is_projected or target.axis_info[0].unit_name != "metre":
            raise SatIntervalsError(f"{name} is not a map in metres: give a projected CRS such as EPSG:32637")
        if len(target.axis_info) != 2:
            raise SatIntervalsError(f"{name} includes heights: give a horizontal CRS, and the geoid apart")
        self.crs = f"EPSG:{crs}" if crs.isdecimal() else crs
        self.definition = target
        self._map = Transformer.from_crs(_GEOGRAPHIC, target, always_xy=True)
        self._geoid = None if geoid is None else geoid_grid(geoid)

    def check(self, longitude: float, latitude: float) -> None:
        """Raise if the CRS or the geoid does not fit at a place (degrees)."""
        here = f"longitude {longitude:.2f}, latitude {latitude:.2f}"
        area = self.definition.area_of_use
        if area is not None:
            away = (longitude - (area.west + area.east) / 2 + 180) % 360 - 180 if area.west <= area.east else 0.0
            beyond = abs(away) - (area.east - area.west) / 2, area.south - latitude, latitude - area.north
            if max(beyond) > _BEYOND:
                raise SatIntervalsError(
                    f"{self.crs} is for longitudes {area.west:g} to {area.east:g} and latitudes {area.south:g} to "
                    f"{area.north:g}, the points are at {here}: give a CRS of this area, or none for its UTM zone"
                )
        factors = Proj(self.definition).get_factors(longitude, latitude)
        scale = max(factors.meridional_scale, factors.parallel_scale, key=lambda factor: abs(factor - 1))
        if not abs(scale - 1) <= _LARGEST_DISTORTION:
            raise SatIntervalsError(
                f"a metre of {self.crs} is {1 / scale:.3g} m on the ground at {here}: give a map with true scale "
                f"there, such as {utm_of(longitude, latitude)}"
            )
        undulation = float(self.undulation(np.array([longitude]), np.array([latitude]))[0])
        if not abs(undulation) <= _LARGEST_UNDULATION:
            raise SatIntervalsError(
                f"the grid of geoid heights has {undulation:g} m at {here}, where the points are: give one that covers "
                f"them; the geoid is at most {_LARGEST_UNDULATION:g} m from the ellipsoid"
            )

    def place(self, longitude: np.ndarray, latitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return easting and northing in metres."""
        x, y = transformed(self._map, longitude, latitude)
        return x, y

    def degrees(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return longitude and latitude of map coordinates."""
        longitude, latitude = transformed(self._map, x, y, inverse=True)
        return longitude, latitude

    def undulation(self, longitude: np.ndarray, latitude: np.ndarray) -> np.ndarray:
        """Return metres from the ellipsoid up to the geoid; 0 without a geoid, NaN outside its grid."""
        return undulation(self._geoid, longitude, latitude)


@dataclass(frozen=True)
class Vertical:
    """What heights refer to, as a person states it: the ellipsoid, a geoid grid, or nothing (then the file must)."""

    ellipsoid: bool = False
    geoid: Path | None = None


class Frame:
    """The coordinates of a file of heights."""

    def __init__(self, name: str, crs: str | None, vertical: Vertical, level: str = "") -> None:
        """``name`` is for messages, ``crs`` WKT or such as EPSG:2154, ``level`` tag HEIGHTS of our surface models."""
        if crs is None:
            raise SatIntervalsError(f"{name} has no CRS: give it with --crs, such as EPSG:32637")
        whole = _crs_of(crs)
        flat = whole.sub_crs_list[0] if whole.is_compound else whole
        if not (flat.is_geographic or flat.is_projected):
            raise SatIntervalsError(f"the CRS of {name}, {whole.name}, is a local one: give one of the Earth")
        self.crs = flat.to_2d()
        # metres of a unit of height
        self.unit = whole.axis_info[2].unit_conversion_factor if len(whole.axis_info) > 2 else 1.0
        self._geoid = None if vertical.geoid is None else geoid_grid(vertical.geoid)
        self._grid = vertical.geoid
        if vertical.geoid is None:
            _check_ellipsoid(name, whole, vertical, level)
        self._from_ellipsoid = Transformer.from_crs(_GEOGRAPHIC, self.crs, always_xy=True)

    @property
    def metres(self) -> float:
        """Return the metres of a unit of the CRS, about those of a degree of latitude if it is geographic."""
        factor = float(self.crs.axis_info[0].unit_conversion_factor)
        return factor * 6_371_000 if self.crs.is_geographic else factor

    def from_ellipsoid(self, longitude: np.ndarray, latitude: np.ndarray, height: np.ndarray) -> Places:
        """Return x, y and height in the frame of points on the WGS 84 ellipsoid; NaN outside the geoid grid."""
        x, y = transformed(self._from_ellipsoid, longitude, latitude)
        return x, y, (height - undulation(self._geoid, longitude, latitude)) / self.unit

    def to_ellipsoid(self, x: np.ndarray, y: np.ndarray, height: np.ndarray) -> Places:
        """Return longitude, latitude (WGS 84) and ellipsoidal height of points in the frame."""
        longitude, latitude = transformed(self._from_ellipsoid, x, y, inverse=True)
        return longitude, latitude, height * self.unit + undulation(self._geoid, longitude, latitude)

    def check(self, longitude: float, latitude: float) -> None:
        """Raise if the geoid grid does not cover a place (degrees)."""
        if np.isnan(undulation(self._geoid, np.array([longitude]), np.array([latitude]))[0]):
            raise SatIntervalsError(
                f"{self._grid} has no geoid height at longitude {longitude:.2f}, latitude {latitude:.2f}: give a grid "
                "that covers the run"
            )


def _check_ellipsoid(name: str, whole: CRS, vertical: Vertical, level: str) -> None:
    """Raise if heights refer to a geoid, or to nothing that is known."""
    datum = whole.sub_crs_list[1].name if whole.is_compound else ""
    is_stated = vertical.ellipsoid and level and not level.endswith("ellipsoid")
    if datum and "ellipsoid" not in datum.lower() and not is_stated:
        raise SatIntervalsError(
            f"{name} has heights of {datum}: give the grid of this geoid with --geoid, to sat-intervals reference"
        )
    if vertical.ellipsoid or datum or len(whole.axis_info) > 2 or level.endswith("ellipsoid"):
        return
    if level:
        raise SatIntervalsError(f"{name} has heights {level}: give this grid with --geoid")
    raise SatIntervalsError(
        f"{name} does not say what its heights refer to: give --ellipsoid, or the grid of their geoid with --geoid"
    )


def transformed(transformer: Transformer, *values: np.ndarray, inverse: bool = False) -> tuple[np.ndarray, ...]:
    """Transform arrays of any shape: of one value, pyproj would take it for a number where numpy (before 2.4) does."""
    transform = partial(transformer.transform, direction="INVERSE" if inverse else "FORWARD")
    shape = np.shape(values[0])
    if shape == () or np.size(values[0]) != 1:
        return tuple(transform(*values))
    return tuple(value[:1].reshape(shape) for value in transform(*(np.repeat(value, 2) for value in values)))


def undulation(geoid: Transformer | None, longitude: np.ndarray, latitude: np.ndarray) -> np.ndarray:
    """Return metres from the ellipsoid up to the geoid of `geoid_grid`; 0 without one, NaN outside its grid."""
    if geoid is None:
        return np.zeros(np.shape(longitude))
    height = transformed(geoid, longitude, latitude, np.zeros(np.shape(longitude)))[2]
    return np.where(np.isfinite(height), -height, np.nan)


def geoid_grid(path: Path) -> Transformer:
    """Return a transformer from heights above the ellipsoid to heights above a geoid (degrees, metres)."""
    check_file(path, "give a grid of geoid heights")
    if path.suffix.lower() in (".tif", ".tiff"):
        with opened(str(path)) as dataset:
            if dataset.crs is None:  # PROJ would read it half a cell off
                raise SatIntervalsError(f"{path} has no CRS: declare it, such as with gdal_edit.py -a_srs EPSG:4326")
    if "," in str(path.resolve()):
        raise SatIntervalsError(f"{path.resolve()}: PROJ reads no file with a comma in its path: rename it")
    radians = "+proj=unitconvert +xy_in=deg +xy_out=rad"
    degrees = "+proj=unitconvert +xy_in=rad +xy_out=deg"
    shift = f'+proj=vgridshift +grids="{path.resolve()}" +multiplier=-1'
    try:
        return Transformer.from_pipeline(f"+proj=pipeline +step {radians} +step {shift} +step {degrees}")
    except ProjError as error:
        raise SatIntervalsError(f"{path} is not a grid of geoid heights that PROJ reads: {error}") from error
