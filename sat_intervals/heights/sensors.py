"""Convert epipolar pixels to ground points with sensor models and epipolar grids (shareloc)."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.lattice import Lattice
from sat_intervals.heights.models import read_model, read_with  # raises without the extra `dsm`
from sat_intervals.kernels.compiled import kernels_of_others
from sat_intervals.kernels.row_offsets import RowOffsets
from sat_intervals.progress import Progress
from sat_intervals.raster import GROUND, Georeferencing, between_180, read_known, read_tags
from sat_intervals.raster.rpc import local_copy
from sat_intervals.tiling import Window

try:
    from scipy.interpolate import RegularGridInterpolator
except ModuleNotFoundError as error:
    raise SatIntervalsError("sensor models need shareloc: pip install 'sat-intervals[dsm]'") from error

with kernels_of_others():
    from affine import Affine
    from shareloc.geofunctions.rectification_grid import RectificationGrid
    from shareloc.geofunctions.triangulation import epipolar_triangulation

_SPACING = 32  # pixels between nodes of the lattice: interpolation errors are below 1 mm
_AT_ONCE = 100_000  # nodes triangulated at a time, a kilobyte each
_CHECKED = 9  # positions along rows and columns of a region, to check models and grids
_NEAR_180 = 2.0  # degrees of longitude from the 180th meridian: models nearer to it are turned
# Metres: lines of sight of one scene meet within centimetres, those of two scenes miss by hundreds of metres.
_LARGEST_RESIDUAL = 10.0
_TAG, _OTB = "METADATATYPE", "OTB"  # OTB 8 tags every raster that it writes with this
# Sensor pixels per epipolar pixel, along and across: one at full resolution, more for reduced images.
_SCALES = 0.4, 40.0


@dataclass(frozen=True)
class Sensors:
    """Sensor models of both images, and grids from epipolar to sensor positions, as read by shareloc."""

    left_model: Any
    right_model: Any
    left_grid: RectificationGrid
    right_grid: RectificationGrid
    turn: float = 0.0  # degrees of longitude by which the models are turned, away from the 180th meridian
    rows: RowOffsets | None = None  # by which matched right rows are lower than those of the right grid

    @classmethod
    def load(
        cls,
        left_model: Path,
        right_model: Path,
        left_grid: Path,
        right_grid: Path,
        *,
        left: Georeferencing | None = None,
        rows: RowOffsets | None = None,
    ) -> "Sensors":
        """Read RPC models, see `models.read_model`, and epipolar grids, see `read_grid`."""
        grid = partial(read_with, kind="epipolar grid", reader=partial(read_grid, left=left or Georeferencing()))
        models = read_model(left_model), read_model(right_model)
        return cls(*models, grid(left_grid), grid(right_grid), _turned(models), rows)

    def triangulate(self, row: np.ndarray, column: np.ndarray, disparity: np.ndarray) -> np.ndarray:
        """Return ``(n, 4)`` longitude, latitude, height and residual of epipolar positions ``(n,)``.

        Degrees (WGS 84; longitudes are continuous across 180), metres above its ellipsoid, and metres from the point to
        either line of sight. Pixel centres are integers; the right pixel is at ``column + disparity`` of the same row,
        or of the one that was matched.
        """
        right = column + disparity
        lower = self.rows.at(row, right) if self.rows else 0.0
        matches = np.column_stack([column, row, right, row + lower]).astype(np.float64)
        found = [self._triangulate(matches[first : first + _AT_ONCE]) for first in range(0, len(matches), _AT_ONCE)]
        return np.concatenate(found)

    def _triangulate(self, matches: np.ndarray) -> np.ndarray:
        sensors = self.left_model, self.right_model, self.left_grid, self.right_grid
        try:
            with warnings.catch_warnings(action="ignore"):
                _, points, residuals = epipolar_triangulation(matches, None, "sift", *sensors, residues=True)
        except SystemError as error:  # numba's word for an interrupt
            raise error.__cause__ or error from None
        return np.column_stack([points[:, 0] + self.turn, points[:, 1:], np.max(residuals, axis=1)])


def _turned(models: Sequence[Any]) -> float:
    """Turn models near the 180th meridian, where shareloc ends, about the Earth's axis to longitude 0; return it."""
    turn = float(models[0].offset_x)
    if 180 - abs(turn) > _NEAR_180:
        return 0.0
    for model in models:
        model.offset_x = between_180(model.offset_x - turn)
    return turn


def read_grid(path: Path, left: Georeferencing) -> RectificationGrid:
    """Read a grid, columns in band 1, rows in band 2, as sensor positions at epipolar ones: pixel centres are integers.

    Grids of OTB have displacements from epipolar coordinates, for both images those of pixels in the georeferencing
    ``left`` of the whole left epipolar image.
    """
    with TemporaryDirectory() as folder:
        grid = RectificationGrid(local_copy(str(path), folder, ends=("",)))
    grid.grid_filename = str(path)
    has_displacements = read_tags(path).get(_TAG) == _OTB
    columns, rows = grid.points
    nodes = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1)
    # shareloc takes no-data values for positions
    sensor = read_known(path)[:2].T + (nodes if has_displacements else 0.0)
    scales = _scales(nodes, sensor)
    if not (_SCALES[0] <= scales[-1] and scales[0] <= _SCALES[1]):
        kind = f"displacements, as its tag {_TAG}={_OTB} says" if has_displacements else "sensor positions"
        raise SatIntervalsError(
            f"{path} does not contain {kind}: give the grid of CARS or shareloc, or that of OTB with tag {_TAG}={_OTB}"
        )
    grid.col_positions, grid.row_positions = sensor[..., 0], sensor[..., 1]
    if has_displacements:
        a, _, c, _, e, f = (left.transform or Affine.identity())[:6]  # without one, the image begins at 0, as in OTB
        grid.points = (columns - c) / a - 0.5, (rows - f) / e - 0.5
    grid.interpolator = RegularGridInterpolator(grid.points, sensor, bounds_error=False, fill_value=None)
    return grid


def _scales(nodes: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    """Return the largest and the smallest number of sensor pixels per unit of the nodes, of an affine fit."""
    known = np.isfinite(sensor).all(axis=-1)
    if np.iscomplexobj(sensor) or known.sum() < 3:
        return np.zeros(2)
    with_one = np.column_stack([nodes[known], np.ones(int(known.sum()))])
    return np.linalg.svd(np.linalg.lstsq(with_one, sensor[known], rcond=None)[0][:2], compute_uv=False)


def lattice_of(
    sensors: Sensors,
    region: Window,
    minimum: int,
    maximum: int,
    progress: Progress = lambda stage, done, total: None,
) -> Lattice:
    """Triangulate nodes over a region of the left image and disparities: a million points would take 15 s."""
    ends = (region.row, region.row_stop - 1), (region.column, region.column_stop - 1), (minimum, maximum)
    axes, spacing = zip(*(_axis(*pair) for pair in ends), strict=True)
    nodes = np.empty((*map(len, axes), 4))
    column, disparity = (axis.ravel() for axis in np.meshgrid(*axes[1:], indexing="ij"))
    for i, row in enumerate(axes[0]):
        progress("geometry", i, len(nodes))
        nodes[i] = sensors.triangulate(np.full(column.size, row), column, disparity).reshape(nodes.shape[1:])
    return Lattice(nodes, spacing, region, float(minimum))


def _axis(first: float, last: float) -> tuple[np.ndarray, float]:
    """Return nodes from first to last, at most `_SPACING` apart, and their distance."""
    count = max(1, math.ceil((last - first) / _SPACING))
    step = max(1.0, (last - first) / count)
    return first + step * np.arange(count + 1), step


def check_cover(sensors: Sensors, region: Window, right_width: int, minimum: int, maximum: int) -> None:
    """Raise if a grid does not cover the images, the right one ``right_width`` wide: shareloc extrapolates silently."""
    rows = region.row, region.row_stop - 1
    columns = region.column, region.column_stop - 1
    seen = max(0, columns[0] + minimum), min(right_width - 1, columns[1] + maximum)
    for grid, side, (first, last) in ((sensors.left_grid, "left", columns), (sensors.right_grid, "right", seen)):
        grid_columns, grid_rows = grid.points
        for name, nodes in (("rows", grid_rows), ("columns", grid_columns)):
            if nodes[0] > nodes[-1]:
                raise SatIntervalsError(
                    f"the {name} of {grid.grid_filename} are in descending order: give a grid in ascending order"
                )
        inside = grid_rows[0] <= rows[0] and rows[1] <= grid_rows[-1]
        if not (inside and grid_columns[0] <= first and last <= grid_columns[-1]):
            raise SatIntervalsError(
                f"{grid.grid_filename} covers rows {grid_rows[0]:g} to {grid_rows[-1]:g} and columns "
                f"{grid_columns[0]:g} to {grid_columns[-1]:g} of the {side} epipolar image, the run needs rows "
                f"{rows[0]} to {rows[1]} and columns {first} to {last}: give the grid of this image"
            )


def median_residual(sensors: Sensors, region: Window, minimum: int, maximum: int) -> float:
    """Return the median residual at some positions across a region; raise if the models do not fit."""
    sensors = replace(sensors, rows=None)  # rows that were moved tell how models differ from the ground, not from grids
    rows = np.linspace(region.row, region.row_stop - 1, _CHECKED)
    columns = np.linspace(region.column, region.column_stop - 1, _CHECKED)
    places = np.meshgrid(rows, columns, [minimum, maximum], indexing="ij")
    points = sensors.triangulate(*(place.ravel() for place in places))
    points = points[np.isfinite(points).all(axis=1)]
    if 2 * len(points) < places[0].size:
        raise SatIntervalsError(
            f"shareloc finds no point for {places[0].size - len(points)} of {places[0].size} lines of sight: check "
            "which model and which grid belong to the left and the right image"
        )
    residual, height = float(np.median(points[:, 3])), float(np.median(points[:, 2]))
    if not (residual <= _LARGEST_RESIDUAL and GROUND[0] <= height <= GROUND[1]):
        raise SatIntervalsError(
            f"the models do not fit these images: lines of sight miss each other by {residual:.1f} m at a height "
            f"of {height:.0f} m (medians): check which model and which grid belong to the left and the right image"
        )
    return residual
