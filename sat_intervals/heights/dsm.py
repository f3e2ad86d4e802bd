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
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.fusion import cells_of_run, fused, without_poor_cells
from sat_intervals.heights.point_cloud import LISTED, WINDOW, Cells, Extent, PointCloud, read_points
from sat_intervals.heights.triangulate import check_points
from sat_intervals.products import POINTS
from sat_intervals.progress import Progress
from sat_intervals.raster import (
    OutputWriter,
    Projection,
    is_surface,
    north_up,
    read_place,
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
# Points of all cells of a tile, where a cell's bounds need all its points: some 60 bytes each.
_LISTED_POINTS = 1 << 22
# Widths are counted in steps of 2 cm, up to this many metres.
_WIDEST = 1000
# Metres: half widths above this are reported as a share.
WIDE = 20.0
_DEFAULTS = SurfaceChoices()
# Metres: largest cell and largest radius.
_LARGEST = 10_000.0


def make_surface(
    outs: Sequence[str | Path],
    path: str | Path,
    *,
    resolution: float | Path,
    crs: str | None = None,
    radius: float | None = None,
    geoid: str | Path | None = None,
    choices: SurfaceChoices = _DEFAULTS,
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
        Side of a cell in metres; or a north-up raster with square pixels, whose grid and CRS are used.
    crs
        A projected CRS in metres; by default the UTM zone of a point near the middle, or that of the raster.
    radius
        A point also contributes to cells whose centre is within this distance (metres); by default the side of a cell.
    geoid
        Grid of geoid heights; heights then refer to the geoid, by default to the WGS 84 ellipsoid.
    choices
        The cell's interval, and what is left out. The intervals of several runs are intersected if they overlap; else
        their hull is taken.
    progress
        Callback, see `Progress`.

    Returns
    -------
    ``crs``, ``rows``, ``columns``, ``points``, ``filled`` (share of cells with a height), ``disagreeing`` (share of the
    cells of several runs whose intervals do not overlap, None if there are none), ``without_intervals`` (folders of
    runs without intervals); ``bounds``; ``median_half_width`` (metres) and ``wide``, the share of cells with bounds
    whose half width exceeds 20 m, both None without bounds; ``outliers``, ``open`` and ``poor_cells``, the numbers of
    points and cells left out.

    Raises
    ------
    SatIntervalsError
        A run has no points, the CRS or the grid cannot be used, or the file cannot be written.
    """
    path, geoid = Path(path), None if geoid is None else Path(geoid)
    like = resolution if isinstance(resolution, Path) else None
    grid, resolution, crs, radius = checked_cells(path, resolution, crs, radius)
    runs = triangulated([Path(out) for out in outs])
    for run in runs:
        run.check_kept([path], [run.out / "points.tif", geoid, like])
    choices = choices.for_runs(runs)
    clouds = _clouds(runs, projection := _projection(runs, crs, geoid), choices, progress)
    cells = _cells(clouds, resolution, radius, grid)
    tags = {
        "RUNS": runs_tag(runs),
        **choices.tags(),
        "RADIUS": f"{radius:g} m",
        "HEIGHTS": f"above {geoid or 'the WGS 84 ellipsoid'}",
        **_nominal_tag(runs),
    }
    place = north_up(projection.crs, cells.left, cells.top, cells.resolution)
    writer = OutputWriter(path.parent, [surface_file(path.name)], cells.rows, cells.columns, place, tags)
    with writer, ThreadPoolExecutor() as threads:
        strips = _strips(threads, clouds, cells, radius, str(choices.bounds))
        tally = _write(writer, strips, cells.rows, choices, progress)
    return {
        "crs": projection.crs,
        "rows": cells.rows,
        "columns": cells.columns,
        **{name: sum(getattr(cloud, name) for cloud in clouds) for name in ("points", "outliers", "open")},
        **tally.report(cells.rows * cells.columns),
        "bounds": choices.bounds,
        "without_intervals": [str(run.out) for run in runs if run.config.interval is None],
    }


def checked_cells(
    path: Path, resolution: float | Path, crs: str | None, radius: float | None
) -> tuple[Cells | None, float, str | None, float]:
    """Check the arguments of `make_surface` that need no run; return the grid of a raster, resolution, CRS and radius.

    Raises
    ------
    SatIntervalsError
        The file to write is something else, or an argument cannot be used.
    """
    if path.exists() and not is_surface(path):
        raise SatIntervalsError(f"{path} exists and is not a surface model: choose another --output")
    grid = None
    if isinstance(resolution, Path):
        grid, crs = _grid_of(resolution, crs)
        resolution = grid.resolution
    radius = resolution if radius is None else radius
    _check_lengths(resolution, radius)
    return grid, resolution, crs, radius


def runs_tag(runs: Sequence[Run]) -> str:
    """Return the tag RUNS of a surface, which identifies its runs."""
    return " ".join(run.report["finished"] for run in runs)


def _nominal_tag(runs: Sequence[Run]) -> dict[str, str]:
    """Return the tag COVERAGE or ALPHA of a surface, none if its runs differ or have no intervals."""
    levels = {("COVERAGE", run.config.interval.coverage) if run.config.interval.coverage else
              ("ALPHA", run.config.interval.alpha) for run in runs if run.config.interval}  # fmt: skip
    return {name: str(level) for name, level in levels} if len(levels) == 1 else {}


def _check_lengths(resolution: float, radius: float) -> None:
    for name, value in (("resolution", resolution), ("radius", radius)):
        if not 0 < value <= _LARGEST:
            raise SatIntervalsError(f"{name} is {value:g} m: give one above 0, up to {_LARGEST:g}")
    if radius > _REACH * resolution:
        raise SatIntervalsError(
            f"radius is {radius:g} m, {radius / resolution:.0f} cells of {resolution:g} m: choose at most "
            f"{_REACH * resolution:g} m, or a coarser --resolution"
        )


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


def _grid_of(path: Path, given: str | None) -> tuple[Cells, str]:
    """Return the grid of a raster as cells of a surface, and its CRS, beside which none may be given."""
    if given is not None:
        raise SatIntervalsError(f"the CRS is that of {path}, but {given} is given too: leave it out")
    (rows, columns), place = read_place(path)
    assert place.transform is not None
    assert place.crs is not None
    across, down = place.transform.a, -place.transform.e
    if not (across > 0 and abs(across - down) <= 1e-6 * across):
        raise SatIntervalsError(
            f"{path} has pixels of {across:g} x {down:g} m: give a north-up raster with square pixels"
        )
    code = place.crs.to_epsg()
    crs = f"EPSG:{code}" if code else place.crs.to_wkt()
    return Cells(place.transform.c, place.transform.f, across, rows, columns), crs


def _clouds(
    runs: Sequence[Run], projection: Projection, choices: SurfaceChoices, progress: Progress
) -> list[PointCloud]:
    clouds = []
    for done, run in enumerate(runs):
        progress("extent", done, len(runs))
        clouds.append(PointCloud(run, projection, choices))
    return clouds


def _cells(clouds: Sequence[PointCloud], resolution: float, radius: float, grid: Cells | None) -> Cells:
    extents = [cloud.extent for cloud in clouds if cloud.extent is not None]
    if not extents:
        raise SatIntervalsError("all points were left out as outliers or open intervals: leave out fewer")
    if grid is not None:
        window = Window(0, 0, grid.rows, grid.columns)
        if not any(extent.grown(radius).intersects(grid.extent(window)) for extent in extents):
            raise SatIntervalsError("no point reaches the grid of the given raster: give one of the same place")
        return grid
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
    writer: OutputWriter,
    strips: Iterator[tuple[int, np.ndarray]],
    rows: int,
    choices: SurfaceChoices,
    progress: Progress,
) -> "_Tally":
    """Write and publish strips without poor cells; return their figures."""
    tally = _Tally()
    for row, strip in strips:
        tally.poor += without_poor_cells(strip, choices.max_width, choices.min_confidence)
        writer.write(row, strip)
        tally.add(strip)
        progress("cells", row + strip.shape[1], rows)
    progress("files", 0, 1)
    writer.publish()
    progress("files", 1, 1)
    return tally


class _Tally:
    """Count the cells of a surface, and their widths."""

    def __init__(self) -> None:
        self.poor = self._filled = self._shared = self._disagreeing = 0
        self._widths = np.zeros(50 * _WIDEST + 1, np.int64)

    def add(self, strip: np.ndarray) -> None:
        height, lower, upper, *_, agreement = strip
        self._filled += int(np.isfinite(height).sum())
        self._shared += int(np.isfinite(agreement).sum())
        self._disagreeing += int((agreement == 0).sum())
        width = upper - lower
        steps = np.minimum(50 * width[np.isfinite(width)], 50 * _WIDEST).astype(np.int64)
        self._widths += np.bincount(steps, minlength=self._widths.size)

    def report(self, cells: int) -> dict[str, Any]:
        count = int(self._widths.sum())
        middle = int(np.searchsorted(np.cumsum(self._widths), (count + 1) // 2))
        return {
            "filled": self._filled / cells,
            "disagreeing": self._disagreeing / self._shared if self._shared else None,
            "median_half_width": (middle + 0.5) / 100 if count else None,
            "wide": int(self._widths[int(100 * WIDE) :].sum()) / count if count else None,
            "poor_cells": self.poor,
        }


def _strips(
    threads: ThreadPoolExecutor, clouds: Sequence[PointCloud], cells: Cells, radius: float, bounds: str
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield first row and bands of full-width strips from the top; an error stops the running tiles."""
    ended = threading.Event()

    def tile(window: Window) -> np.ndarray:
        return fused([cells_of_run(cloud.splat(cells, window, radius, ended), bounds) for cloud in clouds])

    rows, columns = min(_TILE_ROWS, max(_LOWEST, _STRIP_CELLS // cells.columns)), _TILE_COLUMNS
    if bounds in LISTED:
        reaching = max(1.0, math.pi * (radius / cells.resolution) ** 2)
        of_cell = reaching * max(cloud.points_per_cell(cells.resolution) for cloud in clouds)
        rows, columns = _smaller(rows, columns, _LISTED_POINTS / of_cell)
    for row in range(0, cells.rows, rows):
        height = min(rows, cells.rows - row)
        windows = (
            Window(row, column, height, min(columns, cells.columns - column))
            for column in range(0, cells.columns, columns)
        )
        try:
            tiles = list(threads.map(tile, windows))
        except BaseException:
            ended.set()
            raise
        yield row, np.concatenate(tiles, axis=2)


def _smaller(rows: int, columns: int, cells: float) -> tuple[int, int]:
    """Return rows and columns of a tile of at most so many cells, halving the longer side."""
    while rows * columns > max(cells, 1):
        rows, columns = (rows, -(-columns // 2)) if columns >= rows else (-(-rows // 2), columns)
    return rows, columns
