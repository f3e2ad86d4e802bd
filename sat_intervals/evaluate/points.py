"""Reference heights at points, compared with the cells of a surface model that they fall in."""

from pathlib import Path

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.point_files import PointFile
from sat_intervals.kernels.registration import ACROSS, REACH, Blocks, block_side, every_nth, put_together
from sat_intervals.raster import Georeferencing, Projection, Vertical, read_layers, read_tags
from sat_intervals.raster.georeferencing import horizontal_name
from sat_intervals.tiling import Window

_MOST = 1 << 20  # points that are used: a sample, if there are more


def read_points(
    surface: Path, reference: Path, place: Georeferencing, shape: tuple[int, int], sigma: float | None
) -> np.ndarray:
    """Return points in the cells of a surface: ``(n, 4)`` easting, northing, height, standard deviation of its error.

    The latter is that of the file's column, else ``sigma``, else 0. Heights refer to what those of the surface do.
    """
    assert place.crs is not None
    crs = horizontal_name(place.crs)
    file = PointFile(reference, None, Vertical(ellipsoid=True), (crs, read_tags(surface).get("HEIGHTS", "")))
    projection, random = Projection(crs), np.random.default_rng(0)
    found, share = np.empty((0, 4)), 1.0
    for part in file.parts(with_sigma=True):
        longitude, latitude, height = file.frame.to_ellipsoid(*part[:, :3].T)
        points = np.column_stack([*projection.place(longitude, latitude), height, part[:, 3]])
        points = points[np.isfinite(points[:, :2]).all(axis=1)]  # others are too far for the projection
        inside = cells_of(points, place).T
        chosen = ((inside >= 0) & (inside < shape)).all(axis=1) & (random.random(len(points)) < share)
        found = np.concatenate([found, points[chosen]])
        while len(found) > _MOST:
            share /= 2
            found = found[random.random(len(found)) < 0.5]
    found[:, 3] = np.where(np.isfinite(found[:, 3]), found[:, 3], sigma or 0.0)
    if not len(found):
        raise SatIntervalsError(f"no point of {reference} falls on {surface}: give a reference of the same place")
    if not (least := found[:, 3].min()) >= 0:
        raise SatIntervalsError(f"sigma of {reference} is {least:g}: give standard deviations in metres")
    return found


def summary_of(points: np.ndarray) -> dict[str, float]:
    """Return the number of points, and the median standard deviation of their errors."""
    return {"count": len(points), "sigma": float(np.median(points[:, 3]))}


def cells_of(points: np.ndarray, place: Georeferencing) -> np.ndarray:
    """Return row and column of the cells that points fall in: ``(2, n)``."""
    grid = place.affine
    row, column = (points[:, 1] - grid.f) / grid.e, (points[:, 0] - grid.c) / grid.a
    return np.floor([row, column]).astype(np.int64)


def blocks_of(surface: Path, points: np.ndarray, place: Georeferencing, shape: tuple[int, int]) -> Blocks | None:
    """Return points on blocks of a surface, for their registration; None without a height there."""
    grid, cells = place.affine, cells_of(points, place)
    side = block_side(int(np.ptp(cells[0])) + 1, int(np.ptp(cells[1])) + 1, 1)
    groups, numbers = np.unique(cells // side, axis=1, return_inverse=True)
    counts = np.bincount(numbers.ravel(), minlength=groups.shape[1])
    parts = []
    for group in np.argsort(-counts, kind="stable")[: ACROSS**2]:
        chosen = np.flatnonzero(numbers.ravel() == group)
        chosen = chosen[every_nth(chosen.size)]
        ends = cells[:, chosen].min(axis=1).tolist(), (cells[:, chosen].max(axis=1) + 1).tolist()
        window = Window.around(*ends).grown(REACH + 1, REACH + 1).clipped(Window(0, 0, *shape))
        x, y, height, _ = points[chosen].T
        column, row = (x - grid.c) / grid.a - 0.5 - window.column, (y - grid.f) / grid.e - 0.5 - window.row
        parts.append((read_layers(surface, window)[0].astype(np.float64), column, row, height))
    return put_together(parts, grid.a, moves=-1)
