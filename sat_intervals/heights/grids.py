"""Read epipolar grids: sensor positions, as CARS and shareloc write them, or displacements, as OTB writes them."""

from pathlib import Path

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from shareloc.geofunctions.rectification_grid import RectificationGrid

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import Georeferencing, read_known, read_tags

# OTB 8 tags every raster that it writes with this.
_TAG, _OTB = "METADATATYPE", "OTB"
# Sensor pixels per epipolar pixel, along and across: one at full resolution, more for reduced images.
_SCALES = 0.4, 40.0


def read_grid(path: Path, left: Georeferencing) -> RectificationGrid:
    """Read a grid as sensor positions at epipolar positions; pixel centres of the left epipolar image are integers.

    Columns are in band 1, rows in band 2; no data means no position. Grids of OTB have displacements from epipolar
    coordinates, which are the positions of pixels in the georeferencing ``left`` of the whole left epipolar image, also
    for the right one.
    """
    grid = RectificationGrid(str(path))
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
        grid.points = _pixels(columns, rows, left)
    grid.interpolator = RegularGridInterpolator(grid.points, sensor, bounds_error=False, fill_value=None)
    return grid


def _scales(nodes: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    """Return the largest and the smallest number of sensor pixels per unit of the nodes, of an affine fit."""
    known = np.isfinite(sensor).all(axis=-1)
    if np.iscomplexobj(sensor) or known.sum() < 3:
        return np.zeros(2)
    with_one = np.column_stack([nodes[known], np.ones(int(known.sum()))])
    return np.linalg.svd(np.linalg.lstsq(with_one, sensor[known], rcond=None)[0][:2], compute_uv=False)


def _pixels(columns: np.ndarray, rows: np.ndarray, left: Georeferencing) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel positions of epipolar coordinates; an image without transform begins at 0, as in OTB."""
    if left.transform is None:
        return columns - 0.5, rows - 0.5
    a, _, c, _, e, f = left.transform[:6]
    return (columns - c) / a - 0.5, (rows - f) / e - 0.5
