"""Convert points on the WGS 84 ellipsoid to the CRS and the vertical reference of reference heights, and back."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
from pyproj.exceptions import CRSError

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster.projection import geoid_grid, transformed, undulation

_GEOGRAPHIC = "EPSG:4326"
# Degrees of longitude and latitude, and metres.
Places = tuple[np.ndarray, np.ndarray, np.ndarray]


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
        try:
            whole = pyproj.CRS.from_user_input(f"EPSG:{crs}" if crs.isdecimal() else crs)
        except CRSError as error:
            raise SatIntervalsError(f"{crs} is not a CRS known to PROJ: give one such as EPSG:32637") from error
        flat = whole.sub_crs_list[0] if whole.is_compound else whole
        if not (flat.is_geographic or flat.is_projected):
            raise SatIntervalsError(
                f"the CRS of {name}, {whole.name}, is a local one: give one of the Earth with --crs"
            )
        self.crs = flat.to_2d()
        # metres of a unit of height
        self.unit = whole.axis_info[2].unit_conversion_factor if len(whole.axis_info) > 2 else 1.0
        self._geoid = None if vertical.geoid is None else geoid_grid(vertical.geoid)
        self._grid = vertical.geoid
        if vertical.geoid is None:
            _check_ellipsoid(name, whole, vertical, level)
        self._from_ellipsoid = pyproj.Transformer.from_crs(_GEOGRAPHIC, self.crs, always_xy=True)

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


def _check_ellipsoid(name: str, whole: pyproj.CRS, vertical: Vertical, level: str) -> None:
    """Raise if heights refer to a geoid, or to nothing that is known."""
    datum = whole.sub_crs_list[1].name if whole.is_compound else ""
    if datum and "ellipsoid" not in datum.lower():
        raise SatIntervalsError(f"{name} has heights of {datum}: give the grid of this geoid with --geoid")
    if vertical.ellipsoid or datum or len(whole.axis_info) > 2 or level.endswith("ellipsoid"):
        return
    if level:
        raise SatIntervalsError(f"{name} has heights {level}: give this grid with --geoid")
    raise SatIntervalsError(
        f"{name} does not say what its heights refer to: give --ellipsoid, or the grid of their geoid with --geoid"
    )
