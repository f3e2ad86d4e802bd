"""Find where both epipolar images show a ground point: inverse location, then the inverse of the epipolar grids."""

import warnings
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.sensors import Sensors
from sat_intervals.raster import Projection, between_180

try:
    from scipy.interpolate import RegularGridInterpolator
except ModuleNotFoundError as error:
    raise SatIntervalsError("sensor models need shareloc: pip install 'sat-intervals[dsm]'") from error

# Largest error of the inverse of a grid in sensor pixels, and iterations: a grid is affine but for a thousandth.
_NEAR, _MOST = 1e-6, 30
# Pixels between nodes of the lattice on the ground, nodes along its axes, and nodes over the heights.
_SPACING = 32
_NODES = 256
_LEVELS = 5


class Location:
    """Positions of ground points in both epipolar images."""

    def __init__(self, sensors: Sensors) -> None:
        self._turn = sensors.turn
        grids = _Inverse(sensors.left_grid), _Inverse(sensors.right_grid)
        self._views = list(zip((sensors.left_model, sensors.right_model), grids, strict=True))

    def positions(self, longitude: np.ndarray, latitude: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Return ``(n, 4)`` row and column in the left, then in the right image, NaN where none, of points ``(n,)``.

        Degrees (WGS 84) and metres above its ellipsoid; pixel centres are integers.
        """
        found = []
        if self._turn:
            longitude = between_180(longitude - self._turn)
        for model, grid in self._views:
            with warnings.catch_warnings(action="ignore"):
                row, column, _ = model.inverse_loc(longitude, latitude, height)
            if row is None:
                raise SatIntervalsError("a sensor model has no inverse coefficients: give a model with both ways")
            found.append(grid.positions(np.column_stack([column, row])))
        return np.concatenate(found, axis=1)


class _Inverse:
    """The inverse of an epipolar grid: Newton's method with the grid's affine part as derivative."""

    def __init__(self, grid: Any) -> None:
        self._grid = grid
        columns, rows = grid.points
        nodes = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1).reshape(-1, 2)
        sensor = np.stack([grid.col_positions, grid.row_positions], axis=-1).reshape(-1, 2)
        known = np.isfinite(sensor).all(axis=1)
        with_one = np.column_stack([sensor[known], np.ones(int(known.sum()))])
        self._affine = np.linalg.lstsq(with_one, nodes[known], rcond=None)[0]

    def positions(self, sensor: np.ndarray) -> np.ndarray:
        """Return ``(n, 2)`` epipolar row and column of sensor columns and rows ``(n, 2)``."""
        place = sensor @ self._affine[:2] + self._affine[2]
        for _ in range(_MOST):
            missing = sensor - self._grid.interpolate(place)
            place = place + missing @ self._affine[:2]
            if not (np.abs(missing) > _NEAR).any():
                break
        place[(np.abs(sensor - self._grid.interpolate(place)) > 1e3 * _NEAR).any(axis=1)] = np.nan
        return np.asarray(place[:, ::-1])


class GroundLattice:
    """Positions of ground points, interpolated between nodes on the map: exact ones take a minute for a million points.

    ``lowest`` and ``highest`` are corners of a box: easting, northing, ellipsoidal height; metres, as ``pixel``.
    """

    def __init__(
        self, location: Location, projection: Projection, lowest: np.ndarray, highest: np.ndarray, pixel: float
    ) -> None:
        highest = np.maximum(highest, lowest + 1.0)
        counts = np.clip(np.ceil((highest - lowest) / (_SPACING * pixel)) + 1, 2, (_NODES, _NODES, _LEVELS)).astype(int)
        axes = [np.linspace(*ends) for ends in zip(lowest, highest, counts, strict=True)]
        x, y, height = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        positions = location.positions(*projection.degrees(x, y), height).reshape(*counts, 4)
        self._interpolate = RegularGridInterpolator(axes, positions, bounds_error=False, fill_value=np.nan)

    def positions(self, places: np.ndarray) -> np.ndarray:
        """Return rows and columns of points ``(n, 3)``, see `Location.positions`; NaN outside the box."""
        return np.asarray(self._interpolate(places), np.float64)
