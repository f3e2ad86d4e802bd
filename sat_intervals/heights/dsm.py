"""Make a surface model with height intervals from the points of one or several runs.

Cells are computed in tiles, each from the points near it, so memory depends on the tile only. A point contributes to
the cell that contains it and to all cells whose centre is within a radius. Other cells are no data; they are never
filled.
"""

import math
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.fusion import cells_of_run, fused
from sat_intervals.heights.point_cloud import WINDOW, Cells, Extent, PointCloud, read_points
from sat_intervals.heights.triangulate import check_points
from sat_intervals.products import POINTS
from sat_intervals.progress import Progress
from sat_intervals.raster import (
    OutputWriter,
    Projection,
    is_surface,
    north_up,
    read_shape,
    read_tags,
    surface_file,
    utm_of,
)
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import Grid, Window

# Cells of a tile: some tens of megabytes.
_TILE_ROWS, _TILE_COLUMNS = 512, 2048
# Cells of a strip of tiles, 24 bytes each, a few strips in memory; tiles of wide surfaces have fewer rows.
_STRIP_CELLS, _LOWEST = 1 << 22, 64
# More cells per point mean a wrong resolution or runs of different places.
_CELLS_PER_POINT = 1000
# Largest radius in cells: the work grows with its square.
_REACH = 32
# Metres: largest cell and largest radius.
_LARGEST = 10_000.0


def make_surface(
    outs: Sequence[str | Path],
    path: str | Path,
    *,
    resolution: float,
    crs: str | None = None,
    radius: float | None = None,
    interval: Literal["envelope", "mean"] = "envelope",
    geoid: str | Path | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Make a surface model from the points of one or several runs.

    Parameters
    ----------
    outs
        Folders of triangulated runs of the same place.
    path
        The Cloud-Optimized GeoTIFF to write.
    resolution
        Side of a cell in metres.
    crs
        A projected CRS in metres; by default the UTM zone of a point near the middle.
    radius
        A point also contributes to cells whose centre is within this distance (metres); by default the side of a cell.
    interval
        The cell's interval: ``envelope`` contains the intervals of all its points; ``mean`` is the weighted mean of
        their bounds. The intervals of several runs are intersected if they overlap; else their hull is taken.
    geoid
        Grid of geoid heights; heights then refer to the geoid, by default to the WGS 84 ellipsoid.
    progress
        Callback, see `Progress`.

    Returns
    -------
    ``crs``, ``rows``, ``columns``, ``points``, ``filled`` (share of cells with a height), ``disagreeing`` (share of the
    cells of several runs whose intervals do not overlap, None if there are none), ``without_intervals`` (folders of
    runs without intervals).

    Raises
    ------
    SatIntervalsError
        A run has no points, the CRS or the grid cannot be used, or the file cannot be written.
    """
    path, radius = Path(path), resolution if radius is None else radius
    _check_settings(resolution, radius, interval)
    _check_target(path)
    runs = triangulated([Path(out) for out in outs])
    for run in runs:
        run.check_kept([path], [run.out / "points.tif", geoid])
    projection = _projection(runs, crs, None if geoid is None else Path(geoid))
    clouds = []
    for done, run in enumerate(runs):
        progress("extent", done, len(runs))
        clouds.append(PointCloud(run, projection))
    cells = _cells(clouds, resolution, radius)
    tags = {
        "RUNS": runs_tag(runs),
        "INTERVAL": interval,
        "RADIUS": f"{radius:g} m",
        "HEIGHTS": f"above {geoid or 'the WGS 84 ellipsoid'}",
        **_nominal_tag(runs),
    }
    place = north_up(projection.crs, cells.left, cells.top, cells.resolution)
    writer = OutputWriter(path.parent, [surface_file(path.name)], cells.rows, cells.columns, place, tags)
    with writer, ThreadPoolExecutor() as threads:
        strips = _strips(threads, clouds, cells, radius, interval)
        filled, shared, disagreeing = _write(writer, strips, cells.rows, progress)
    return {
        "crs": projection.crs,
        "rows": cells.rows,
        "columns": cells.columns,
        "points": sum(cloud.points for cloud in clouds),
        "filled": filled / (cells.rows * cells.columns),
        "disagreeing": disagreeing / shared if shared else None,
        "without_intervals": [str(run.out) for run in runs if run.config.interval is None],
    }


def runs_tag(runs: Sequence[Run]) -> str:
    """Return the tag RUNS of a surface, which identifies its runs."""
    return " ".join(run.report["finished"] for run in runs)


def _nominal_tag(runs: Sequence[Run]) -> dict[str, str]:
    """Return the tag COVERAGE or ALPHA of a surface, none if its runs differ or have no intervals."""
    levels = {("COVERAGE", run.config.interval.coverage) if run.config.interval.coverage else
              ("ALPHA", run.config.interval.alpha) for run in runs if run.config.interval}  # fmt: skip
    return {name: str(level) for name, level in levels} if len(levels) == 1 else {}


def _check_settings(resolution: float, radius: float, interval: str) -> None:
    if interval not in ("envelope", "mean"):
        raise SatIntervalsError(f"interval is {interval!r}, allowed: envelope or mean")
    for name, value in (("resolution", resolution), ("radius", radius)):
        if not 0 < value <= _LARGEST:
            raise SatIntervalsError(f"{name} is {value:g} m: give one above 0, up to {_LARGEST:g}")
    if radius > _REACH * resolution:
        raise SatIntervalsError(
            f"radius is {radius:g} m, {radius / resolution:.0f} cells of {resolution:g} m: choose at most "
            f"{_REACH * resolution:g} m, or a coarser --resolution"
        )


def _check_target(path: Path) -> None:
    """Raise if the file exists and is not a surface model."""
    if path.exists() and not is_surface(path):
        raise SatIntervalsError(f"{path} exists and is not a surface model: choose another --output")


def triangulated(outs: Sequence[Path]) -> list[Run]:
    """Open runs with points of their own.

    Raises
    ------
    SatIntervalsError
        A folder is no run, is given twice, or has no points, those of an earlier run, or damaged ones.
    """
    for out, count in Counter(out.resolve() for out in outs).items():
        if count > 1:
            raise SatIntervalsError(f"{out} is given {count} times: give each run once")
    runs = []
    for out in outs:
        run = open_run(out)
        path = out / "points.tif"
        if not path.exists():
            raise SatIntervalsError(f"{out} has no points.tif: run sat-intervals triangulate on it first")
        if read_tags(path).get("RUN") != run.report["finished"] or read_shape(path) != (len(POINTS), *run.shape):
            raise SatIntervalsError(f"{path} belongs to an earlier run in {out}: triangulate again")
        check_points(out)
        runs.append(run)
    return runs


def _projection(runs: Sequence[Run], crs: str | None, geoid: Path | None) -> Projection:
    middle = point_near_the_middle(runs)
    projection = Projection(utm_of(*middle) if crs is None else crs, geoid)
    projection.check(*middle)
    return projection


def point_near_the_middle(runs: Sequence[Run]) -> tuple[float, float]:
    """Return longitude and latitude of the middle of a window with points, of the first run that has any."""
    for run in runs:
        tiles = Grid(Window(0, 0, *run.shape), WINDOW)
        middle = tiles.rows / 2 - 0.5, tiles.columns / 2 - 0.5
        for tile in sorted(tiles, key=lambda tile: math.dist((tile.grid_row, tile.grid_column), middle)):
            bands, known = read_points(run.out / "points.tif", tile.core)
            if known.any():
                return float(np.median(bands[0][known])), float(np.median(bands[1][known]))
    raise SatIntervalsError(f"no valid pixel in {', '.join(str(run.out) for run in runs)}: give runs with points")


def _cells(clouds: Sequence[PointCloud], resolution: float, radius: float) -> Cells:
    extents = [cloud.extent for cloud in clouds if cloud.extent is not None]
    left, bottom, right, top = zip(*extents, strict=True)
    cells = Cells.over(Extent(min(left), min(bottom), max(right), max(top)).grown(radius), resolution)
    points = sum(cloud.points for cloud in clouds)
    if cells.rows * cells.columns > _CELLS_PER_POINT * points:
        raise SatIntervalsError(
            f"{cells.rows} x {cells.columns} cells of {resolution:g} m for {points} points: "
            "choose a coarser --resolution, or runs of one place"
        )
    return cells


def _write(
    writer: OutputWriter, strips: Iterator[tuple[int, np.ndarray]], rows: int, progress: Progress
) -> tuple[int, int, int]:
    """Write and publish strips; return the number of cells with a height, of several runs, and in disagreement."""
    counts = np.zeros(3, np.int64)
    for row, strip in strips:
        writer.write(row, strip)
        agreement = strip[-1]
        counts += np.isfinite(strip[0]).sum(), np.isfinite(agreement).sum(), (agreement == 0).sum()
        progress("cells", row + strip.shape[1], rows)
    progress("files", 0, 1)
    writer.publish()
    progress("files", 1, 1)
    filled, shared, disagreeing = map(int, counts)
    return filled, shared, disagreeing


def _strips(
    threads: ThreadPoolExecutor, clouds: Sequence[PointCloud], cells: Cells, radius: float, interval: str
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield first row and bands of full-width strips from the top; an error stops the running tiles."""
    ended = threading.Event()

    def tile(window: Window) -> np.ndarray:
        return fused([cells_of_run(cloud.splat(cells, window, radius, ended), interval) for cloud in clouds])

    rows = min(_TILE_ROWS, max(_LOWEST, _STRIP_CELLS // cells.columns))
    for row in range(0, cells.rows, rows):
        height = min(rows, cells.rows - row)
        windows = (
            Window(row, column, height, min(_TILE_COLUMNS, cells.columns - column))
            for column in range(0, cells.columns, _TILE_COLUMNS)
        )
        try:
            tiles = list(threads.map(tile, windows))
        except BaseException:
            ended.set()
            raise
        yield row, np.concatenate(tiles, axis=2)
