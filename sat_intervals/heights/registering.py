"""Register reference heights to the points of a run: gather blocks of both, see `kernels.registration`."""

import math
import threading
from collections.abc import Iterable, Sequence

import numpy as np

from sat_intervals.heights.point_cloud import Cells, Extent, PointCloud
from sat_intervals.heights.points import read_points
from sat_intervals.kernels.registration import REACH, Blocks, sampled
from sat_intervals.kernels.splat import mean_heights
from sat_intervals.raster import HeightRaster, Projection
from sat_intervals.results import Run
from sat_intervals.tiling import Grid, Tile, Window

# Blocks of each side of the image, their sides in pixels, and points of a block.
_BLOCKS, _SMALLEST, _LARGEST, _POINTS = 8, 24, 256, 1000


def blocks_of_raster(run: Run, raster: HeightRaster, projection: Projection, pixel: float) -> Blocks | None:
    """Return points of a run on surfaces of a raster; None if nothing is common. ``pixel`` is metres on the ground."""
    cell = max(pixel, raster.cell)
    parts, surfaces = [], []
    for tile in _spread(Grid(Window(0, 0, *run.shape), _side(run))):
        bands, known = read_points(run.out / "points.tif", tile.core)
        longitude, latitude, height = (band[known] for band in bands[:3])
        if not longitude.size:
            continue
        chosen = slice(None, None, max(1, math.ceil(longitude.size / _POINTS)))
        x, y = projection.place(longitude[chosen], latitude[chosen])
        extent = Extent(x.min(), y.min(), x.max(), y.max()).grown((REACH + 1) * cell)
        cells = Cells.over(extent, cell)
        surface = _on_cells(raster, projection, cells)
        if surface is not None:
            parts.append((*_in_cells(cells, x, y), height[chosen]))
            surfaces.append(surface)
    return _blocks(surfaces, parts, cell, 1)


def blocks_of_points(run: Run, places: np.ndarray, projection: Projection, pixel: float) -> Blocks | None:
    """Return points, ``(n, 3)`` on the map and above the ellipsoid, on surfaces of a run; None without a point."""
    cloud, side = PointCloud(run, projection), _side(run) * pixel
    groups, numbers = np.unique(np.floor(places[:, :2] / side), axis=0, return_inverse=True)
    counts = np.bincount(numbers.ravel(), minlength=len(groups))
    parts, surfaces = [], []
    for group in np.argsort(-counts, kind="stable")[: _BLOCKS**2]:
        x, y, height = places[numbers.ravel() == group][: 4 * _POINTS].T
        cells = Cells.over(Extent(x.min(), y.min(), x.max(), y.max()).grown((REACH + 1) * pixel), pixel)
        window = Window(0, 0, cells.rows, cells.columns)
        surface = mean_heights(cloud.splat(cells, window, pixel, threading.Event()))
        if np.isfinite(surface).any():
            parts.append((*_in_cells(cells, x, y), height))
            surfaces.append(surface)
    return _blocks(surfaces, parts, pixel, -1)


def _side(run: Run) -> int:
    return min(_LARGEST, max(_SMALLEST, min(run.shape) // _BLOCKS))


def _spread(grid: Grid) -> Iterable[Tile]:
    """Return tiles spread evenly, at most about `_BLOCKS` along each side."""
    rows, columns = (range(0, count, math.ceil(count / _BLOCKS)) for count in (grid.rows, grid.columns))
    return [grid.tile(row, column) for row in rows for column in columns]


def _in_cells(cells: Cells, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and rows of map places; centres of cells are integers."""
    return (x - cells.left) / cells.resolution - 0.5, (cells.top - y) / cells.resolution - 0.5


def _on_cells(raster: HeightRaster, projection: Projection, cells: Cells) -> np.ndarray | None:
    """Return heights above the ellipsoid at centres of cells, interpolated between the corners; None without any."""
    across, down = (np.array([0.5, size - 0.5]) * cells.resolution for size in (cells.columns, cells.rows))
    x, y = np.meshgrid(cells.left + across, cells.top - down)
    column, row, level = raster.positions(*projection.degrees(x, y), np.zeros(x.shape))
    if not np.isfinite([column, row, level]).all():
        return None
    first = int(np.floor(row.min())) - 1, int(np.floor(column.min())) - 1
    window = Window(*first, int(row.max()) + 3 - first[0], int(column.max()) + 3 - first[1])
    common = window.clipped(Window(0, 0, *raster.shape))
    if min(common.height, common.width) < 2:
        return None
    v, u = np.meshgrid(np.linspace(0, 1, cells.rows), np.linspace(0, 1, cells.columns), indexing="ij")
    column, row, level = (
        (1 - v) * ((1 - u) * ends[0, 0] + u * ends[0, 1]) + v * ((1 - u) * ends[1, 0] + u * ends[1, 1])
        for ends in (column, row, level)
    )
    surface = raster.read(common)[np.newaxis]
    zero = np.zeros(row.size, np.int64)
    found = sampled(surface, zero, (column - common.column).ravel(), (row - common.row).ravel()).reshape(row.shape)
    found = (found - level) * raster.frame.unit
    return found if np.isfinite(found).any() else None


def _blocks(
    surfaces: Sequence[np.ndarray], parts: Sequence[tuple[np.ndarray, ...]], cell: float, moves: int
) -> Blocks | None:
    """Put blocks together; smaller surfaces are filled up with unknown heights."""
    if not parts:
        return None
    rows, columns = (max(surface.shape[axis] for surface in surfaces) for axis in (0, 1))
    whole = np.full((len(surfaces), rows, columns), np.nan, np.float32)
    for index, surface in enumerate(surfaces):
        whole[index, : surface.shape[0], : surface.shape[1]] = surface
    block = np.concatenate([np.full(part[0].size, index) for index, part in enumerate(parts)])
    x, y, height = (np.concatenate(values) for values in zip(*parts, strict=True))
    return Blocks(whole, cell, block, x, y, height, moves)
