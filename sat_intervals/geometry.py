"""Epipolar pixels to points on the ground, through sensor models and epipolar grids. The only home of shareloc."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.lattice import interpolate
from sat_intervals.tiling import Window

try:
    from shareloc.geofunctions.rectification_grid import RectificationGrid
    from shareloc.geofunctions.triangulation import epipolar_triangulation
    from shareloc.geomodels import GeoModel
except ModuleNotFoundError as error:
    raise SatIntervalsError("triangulation needs shareloc: pip install 'sat-intervals[dsm]'") from error

# Pixels between the nodes of the lattice: points are smooth enough for errors below a millimetre between them.
_SPACING = 32
# Lines of sight of one scene meet within centimetres; with models of two scenes they pass by hundreds of metres.
_FOREIGN_RESIDUAL = 10.0
# Metres above the ellipsoid between which all ground lies.
_GROUND = -600.0, 9500.0


class Points(NamedTuple):
    """Points of some pixels, all ``(rows, columns)`` float64, NaN where there is no disparity.

    Attributes
    ----------
    longitude, latitude
        Degrees, WGS 84.
    height
        Metres above its ellipsoid.
    residual
        Metres from the point to either line of sight.
    """

    longitude: np.ndarray
    latitude: np.ndarray
    height: np.ndarray
    residual: np.ndarray


@dataclass(frozen=True)
class Sensors:
    """Models of both images and the grids that lead from epipolar to sensor positions, as shareloc reads them."""

    left_model: Any
    right_model: Any
    left_grid: RectificationGrid
    right_grid: RectificationGrid

    @classmethod
    def load(cls, left_model: Path, right_model: Path, left_grid: Path, right_grid: Path) -> "Sensors":
        """Read RPC models (GeoTIFF tags, ``.geom``, DIMAP XML) and position grids (GeoTIFF: sensor column, sensor row).

        Raises
        ------
        SatIntervalsError
            A file that is missing or holds something else.
        """
        models = (_read(path, "RPC model", GeoModel) for path in (left_model, right_model))
        grids = (_read(path, "epipolar grid", RectificationGrid) for path in (left_grid, right_grid))
        return cls(*models, *grids)

    def triangulate(self, row: np.ndarray, column: np.ndarray, disparity: np.ndarray) -> np.ndarray:
        """Points of epipolar positions: ``(n, 4)`` longitude, latitude, height and residual, see `Points`.

        Parameters
        ----------
        row, column
            ``(n,)`` positions in the whole left epipolar image, pixel centres being integers.
        disparity
            ``(n,)`` pixels; the partner is at ``column + disparity`` of the same row.
        """
        matches = np.column_stack([column, row, column + disparity, row]).astype(np.float64)
        _, points, residuals = epipolar_triangulation(
            matches, None, "sift", self.left_model, self.right_model, self.left_grid, self.right_grid, residues=True
        )
        return np.column_stack([points, np.max(residuals, axis=1)])


def _read(path: Path, kind: str, reader: Any) -> Any:
    if not path.is_file():
        raise SatIntervalsError(f"{path}: no such file: give the {kind} of the image")
    try:
        return reader(str(path))
    except Exception as error:  # whatever shareloc, scipy or GDAL stumble over
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SatIntervalsError(f"{path} is no {kind} that shareloc reads: {reason}") from error


@dataclass(frozen=True)
class Lattice:
    """Points at the nodes of a lattice over rows, columns and disparities, and between them by interpolation.

    shareloc takes seconds for a million points, and there are three to a pixel. Between nodes 32 pixels apart the
    points are linear to less than a millimetre.

    Attributes
    ----------
    nodes
        ``(rows, columns, disparities, 4)`` longitude, latitude, height, residual.
    region
        The pixels of the left image that it covers; the first node is at its first pixel.
    spacing
        Pixels between nodes along rows, columns and disparities.
    minimum
        Disparity of the first node.
    """

    nodes: np.ndarray
    region: Window
    spacing: tuple[float, float, float]
    minimum: float

    @classmethod
    def over(cls, sensors: Sensors, region: Window, right_width: int, minimum: int, maximum: int) -> "Lattice":
        """The lattice of a region and a search range; ``right_width``: columns of the right image.

        Raises
        ------
        SatIntervalsError
            Grids that do not cover the region, models that do not fit each other.
        """
        _check_cover(sensors, region, right_width, minimum, maximum)
        rows, row_step = _axis(region.row, region.row_stop - 1)
        columns, column_step = _axis(region.column, region.column_stop - 1)
        disparities, disparity_step = _axis(minimum, maximum)
        row, column, disparity = np.meshgrid(rows, columns, disparities, indexing="ij")
        points = sensors.triangulate(row.ravel(), column.ravel(), disparity.ravel())
        _check_points(points)
        spacing = row_step, column_step, disparity_step
        return cls(points.reshape(*row.shape, 4), region, spacing, float(minimum))

    def points(self, window: Window, disparity: np.ndarray) -> Points:
        """Points of the disparities of a window ``(rows, columns)``, counted from the region's first pixel."""
        first = -float(window.row), -float(window.column), self.minimum
        return Points(*interpolate(self.nodes, self.spacing, first, disparity.astype(np.float64)))


def _axis(first: float, last: float) -> tuple[np.ndarray, float]:
    """Nodes that reach from first to last, at most `_SPACING` apart, and how far apart they are."""
    count = max(1, math.ceil((last - first) / _SPACING))
    step = max(1.0, (last - first) / count)
    return first + step * np.arange(count + 1), step


def _check_cover(sensors: Sensors, region: Window, right_width: int, minimum: int, maximum: int) -> None:
    """Refuse a grid that ends inside the images: shareloc goes on past its end without a word."""
    rows = region.row, region.row_stop - 1
    columns = region.column, region.column_stop - 1
    seen = max(0, columns[0] + minimum), min(right_width - 1, columns[1] + maximum)
    for grid, side, (first, last) in ((sensors.left_grid, "left", columns), (sensors.right_grid, "right", seen)):
        grid_columns, grid_rows = grid.points
        inside = grid_rows[0] <= rows[0] and rows[1] <= grid_rows[-1]
        if not (inside and grid_columns[0] <= first and last <= grid_columns[-1]):
            raise SatIntervalsError(
                f"{grid.grid_filename} covers rows {grid_rows[0]:g} to {grid_rows[-1]:g} and columns "
                f"{grid_columns[0]:g} to {grid_columns[-1]:g} of the {side} epipolar image, the run rows {rows[0]} to "
                f"{rows[1]} and columns {first} to {last}: give the grid of this image"
            )


def _check_points(points: np.ndarray) -> None:
    lost = 1 - np.isfinite(points).all(axis=1).mean()
    if lost > 0:
        raise SatIntervalsError(
            f"shareloc finds no point for {100 * lost:.0f} % of the lines of sight: check which model and which grid "
            "belong to the left and the right image; a scene across the 180th meridian is beyond it"
        )
    residual, height = float(np.median(points[:, 3])), float(np.median(points[:, 2]))
    if not (residual <= _FOREIGN_RESIDUAL and _GROUND[0] <= height <= _GROUND[1]):
        raise SatIntervalsError(
            f"the models do not fit these images: lines of sight pass each other by {residual:.1f} m and meet at "
            f"{height:.0f} m (medians): check which model and which grid belong to the left and the right image"
        )
