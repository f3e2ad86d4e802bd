"""Register reference heights to the points of a run: gather blocks of both, see `kernels.registration`."""

import numpy as np

from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.lattice import Extent, Lattice
from sat_intervals.heights.point_cloud import Cells, PointCloud
from sat_intervals.kernels import registration
from sat_intervals.kernels.gridding import mean_heights
from sat_intervals.kernels.relief import sampled
from sat_intervals.raster import HeightRaster, Projection
from sat_intervals.results import Run
from sat_intervals.tiling import Window

_SMALLEST = 24  # smallest side of a block in pixels


def blocks_of_raster(
    run: Run, lattice: Lattice, raster: HeightRaster, projection: Projection, pixel: float
) -> registration.Blocks | None:
    """Return points of a run on surfaces of a raster, None if nothing is common; ``pixel`` is metres on the ground."""
    cell = max(pixel, raster.cell)
    parts = []
    for window in registration.spread_blocks(Window(0, 0, *run.shape), _SMALLEST):
        points = lattice.points(window, run.read_bands(window).matched)
        points = points[:, np.isfinite(points[2])]
        if points.size:
            x, y, height = points[:, registration.every_nth(points.shape[1])]
            cells = _around(x, y, cell)
            parts.append((_on_cells(raster, projection, cells), *_in_cells(cells, x, y), height))
    return registration.put_together(parts, cell, moves=1)


def blocks_of_points(run: Run, lattice: Lattice, places: np.ndarray, pixel: float) -> registration.Blocks | None:
    """Return points, ``(n, 3)`` on the map and above the ellipsoid, on surfaces of a run; None without a point."""
    cloud = PointCloud(run, lattice, SurfaceChoices("envelope").for_intervals([run.config.interval]))
    side = registration.block_side(*run.shape, _SMALLEST) * pixel
    groups, numbers = np.unique(np.floor(places[:, :2] / side), axis=0, return_inverse=True)
    counts = np.bincount(numbers.ravel(), minlength=len(groups))
    parts = []
    for group in np.argsort(-counts, kind="stable")[: registration.ACROSS**2]:
        x, y, height = places[numbers.ravel() == group][: registration.POINTS].T
        cells = _around(x, y, pixel)
        gathered, _ = cloud.splat(cells, Window(0, 0, cells.rows, cells.columns), pixel)
        parts.append((mean_heights(gathered), *_in_cells(cells, x, y), height))
    return registration.put_together(parts, pixel, moves=-1)


def _around(x: np.ndarray, y: np.ndarray, cell: float) -> Cells:
    """Return cells that cover map places, and a shift of them."""
    return Cells.over(Extent(x.min(), y.min(), x.max(), y.max()).grown((registration.REACH + 1) * cell), cell)


def _in_cells(cells: Cells, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and rows of map places; centres of cells are integers."""
    return (x - cells.left) / cells.resolution - 0.5, (cells.top - y) / cells.resolution - 0.5


def _on_cells(raster: HeightRaster, projection: Projection, cells: Cells) -> np.ndarray:
    """Return heights above the ellipsoid at centres of cells, NaN where unknown; interpolated between the corners."""
    nothing = np.full((cells.rows, cells.columns), np.nan)
    across, down = (np.array([0.5, size - 0.5]) * cells.resolution for size in (cells.columns, cells.rows))
    x, y = np.meshgrid(cells.left + across, cells.top - down)
    column, row, level = raster.positions(*projection.degrees(x, y), np.zeros(x.shape))
    if not np.isfinite([column, row, level]).all():
        return nothing
    first = int(np.floor(row.min())) - 1, int(np.floor(column.min())) - 1
    window = Window(*first, int(row.max()) + 3 - first[0], int(column.max()) + 3 - first[1])
    common = window.clipped(Window(0, 0, *raster.shape))
    if min(common.height, common.width) < 2:
        return nothing
    v, u = np.meshgrid(np.linspace(0, 1, cells.rows), np.linspace(0, 1, cells.columns), indexing="ij")
    column, row, level = (
        (1 - v) * ((1 - u) * ends[0, 0] + u * ends[0, 1]) + v * ((1 - u) * ends[1, 0] + u * ends[1, 1])
        for ends in (column, row, level)
    )
    surface = raster.read(common)[np.newaxis]
    zero = np.zeros(row.size, np.int64)
    found = sampled(surface, zero, (column - common.column).ravel(), (row - common.row).ravel()).reshape(row.shape)
    return np.asarray((found - level) * raster.frame.unit)
