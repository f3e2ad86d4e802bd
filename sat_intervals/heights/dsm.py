"""Make a surface model with height intervals from runs; cells without a point are no data."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.config import Calibration, Interval
from sat_intervals.errors import SatIntervalsError, check_absent
from sat_intervals.heights.alignment import aligned
from sat_intervals.heights.cells import Gridding, report_of, rows_of_cells
from sat_intervals.heights.choices import SurfaceChoices, completion_of
from sat_intervals.heights.geometry import FILE, Geometry, geometry_of
from sat_intervals.heights.lattice import Extent, Ground, joined, on_map
from sat_intervals.heights.ortho import write_ortho_of
from sat_intervals.heights.point_cloud import Cells, PointCloud
from sat_intervals.heights.rectify import raw_inputs
from sat_intervals.prepare.pair import Each, Pool
from sat_intervals.products import ORTHO
from sat_intervals.progress import Progress
from sat_intervals.raster import (
    OutputWriter,
    Projection,
    files_of,
    north_up,
    path_of,
    read_place,
    read_tags,
    run_files,
    surface_file,
    utm_of,
)
from sat_intervals.raster.completion import Completion, complete
from sat_intervals.raster.georeferencing import horizontal_name
from sat_intervals.raster.heightfield import warn_of_no_data
from sat_intervals.raster.identity import check_not_replaced, identities
from sat_intervals.raster.surfaces import check_level
from sat_intervals.results import Run
from sat_intervals.tiling import Window

_CELLS_PER_PIXEL = 1000  # more cells per pixel mean a wrong resolution or runs of different places
_REACH = 32  # largest radius in cells: the work grows with its square
_LARGEST = 10_000.0  # metres: largest cell and largest radius


def surface_of_runs(
    runs: Sequence[Run],
    path: Path,
    pool: Pool,
    *,
    resolution: float | Path | None = None,
    crs: str | None = None,
    radius: float | None = None,
    geoid: Path | None = None,
    choices: SurfaceChoices,
) -> dict[str, Any]:
    """Make a surface model of runs, see `make_surface`."""
    progress = pool.progress
    if len(runs) == 1 and runs[0].is_sweep:
        check_absent({"resolution": resolution, "crs": crs, "radius": radius, "geoid": geoid}, "runs of two images")
        return _completed(runs[0], path, choices, progress)
    given = [geoid, choices.flatten, choices.mask, *_files_of(choices.reference), *_files_of(resolution)]
    grid, resolution, crs, radius = checked_cells(resolution, crs, radius, geoid)
    completion = completion_of(resolution, choices)
    level = f"above {geoid or 'the WGS 84 ellipsoid'}"
    _check_reference(choices.reference, path, level)
    geometries = _geometries(runs, [path, path.with_name(ORTHO)][: 1 + choices.ortho], given, progress)
    intervals = [run.config.interval for run in runs]
    choices = choices.for_intervals(intervals)
    tags = surface_tags([run.report["finished"] for run in runs], intervals, choices, resolution, radius)
    tags["HEIGHTS"] = level
    projection = Projection(crs or utm_of(*geometries[0].lattice.middle), geoid)
    projection.check(*geometries[0].lattice.middle)
    clouds = [PointCloud(one.run, on_map(one.lattice, projection, str(one.run.out)), choices) for one in geometries]
    cells, shifts = _cells(pool, clouds, resolution, radius, grid), list[dict[str, Any]]()
    if choices.reference or (choices.aligns and len(clouds) > 1):
        clouds, shifts = aligned(pool, clouds, cells, projection.crs, radius, choices.reference)
        cells = _cells(pool, clouds, resolution, radius, grid)
    figures = _write(path, Gridding(clouds, cells, radius, choices), projection.crs, tags, completion, pool)
    if choices.ortho:
        write_ortho_of(runs[0], path, projection, shifts[0]["shift"] if shifts else (0, 0, 0), progress)
    return {"crs": projection.crs, "rows": cells.rows, "columns": cells.columns, **figures} | {
        "bounds": choices.bounds,
        "calibration": choices.calibration and choices.calibration.name,
        "shifts": shifts,
        "without_intervals": [str(run.out) for run in runs if run.config.interval is None],
        "geometry": {str(one.run.out): one.report for one in geometries},
    }


def _completed(run: Run, path: Path, choices: SurfaceChoices, progress: Progress) -> dict[str, Any]:
    """Write the surface of a run of many images, completed; return its grid, and the numbers of `complete`."""
    measured = run.out / "dsm.tif"
    (rows, columns), place = read_place(measured)
    completion = completion_of(place.pixel_size[0], choices)
    if completion is None or replace(choices, fill=None, flatten=None, mask=None) != SurfaceChoices():
        raise SatIntervalsError(f"{run.out} has the surface of many images: give fill, flatten or mask, and no more")
    if done := {"FILLED", "FLATTENED", "MASKED"} & read_tags(measured).keys():
        raise SatIntervalsError(f"{measured} is {' and '.join(sorted(done)).lower()} already: complete one that is not")
    run.check_kept([path], [measured, choices.flatten, choices.mask])
    file, _ = run_files(run.config.products.compression, of_heights=True)
    completed = complete(measured, path, file, completion.on(place, (rows, columns)), progress)
    assert place.crs is not None
    return {"crs": horizontal_name(place.crs), "rows": rows, "columns": columns, "completed": completed}


def _check_reference(reference: Path | None, surface: Path, level: str) -> None:
    """Raise for a raster that is no reference of a surface above ``level``; warn of one without no data."""
    if reference:
        read_place(reference)
        check_level(reference, str(surface), level)
        warn_of_no_data(reference)


def _files_of(raster: float | Path | None) -> Sequence[str]:
    """Return the files of a raster, if there is one."""
    return files_of(str(raster)) if isinstance(raster, Path) and raster.exists() else ()


def _write(
    path: Path,
    gridding: Gridding,
    crs: str,
    tags: dict[str, str],
    completion: Completion | None,
    pool: Pool,
) -> dict[str, Any]:
    """Write the cells of a surface and complete it; return what cells have, and the numbers of `complete`."""
    cells = gridding.cells
    place = north_up(crs, cells.left, cells.top, cells.resolution)
    file, completed = surface_file(path.name), None
    completion = completion and completion.on(place, (cells.rows, cells.columns))
    with OutputWriter(path.parent, [file], cells.rows, cells.columns, place, tags) as writer:
        noted = pool.write_rows(writer, rows_of_cells, gridding.arguments, "cells")
        if completion:
            made = writer.build()[file.name]
            completed = complete(made, made, file, completion, pool.progress)
        writer.publish()
    return report_of(noted, cells.rows * cells.columns) | {"completed": completed}


def _geometries(
    runs: Sequence[Run], written: Sequence[Path], given: Iterable[str | Path | None], progress: Progress
) -> list[Geometry]:
    """Return the geometry of each run; raise if one is given twice, or its files or given ones would be replaced.

    Of two files that are written, the second is an ortho-image of the raw image of the first run.
    """
    if len(written) > 1:
        pair = (runs[0].report["inputs"][side]["path"] for side in ("left", "right"))
        check_not_replaced(identities(raw_inputs(*pair)), written)
    known: dict[str, Path] = {}
    for run in runs:
        other = known.setdefault(run.report["finished"], run.out)
        if run is not runs[len(known) - 1]:
            raise SatIntervalsError(f"{other} and {run.out} are the same run: give each run once")
    geometries = []
    for run in runs:
        geometries.append(geometry_of(run, progress))
        run.check_kept(written, [run.out / FILE, *geometries[-1].files, *given])
    return geometries


def checked_cells(
    resolution: float | Path | None, crs: str | None, radius: float | None, geoid: Path | None = None
) -> tuple[Cells | None, float, str | None, float]:
    """Check the arguments of `make_surface` that need no run; return grid of a raster, resolution, CRS and radius."""
    grid = None
    if resolution is None:
        raise SatIntervalsError("give either --resolution, the side of a cell, or --grid-like, a raster with the grid")
    if isinstance(resolution, Path):
        grid, crs = _grid_of(resolution, crs)
        resolution = grid.resolution
    Projection(crs or utm_of(0, 0), geoid)
    radius = resolution if radius is None else radius
    for name, value in (("resolution", resolution), ("radius", radius)):
        if not 0 < value <= _LARGEST:
            raise SatIntervalsError(f"{name} is {value:g} m: give one above 0, up to {_LARGEST:g}")
    if radius > _REACH * resolution:
        raise SatIntervalsError(
            f"radius is {radius:g} m, {radius / resolution:.0f} cells of {resolution:g} m: choose at most "
            f"{_REACH * resolution:g} m, or a coarser resolution"
        )
    return grid, resolution, crs, radius


def check_sensors(
    files: Sequence[str | Path], resolution: float | Path, crs: str | None, choices: SurfaceChoices
) -> None:
    """Raise before hours of matching if models or grids cannot be read, or pixels have too many cells.

    Check, too, that areas of the ``choices`` are on the map, and warn of those of other places.
    """
    from sat_intervals.heights.sensors import Sensors, lattice_of

    sensors = Sensors.load(*map(path_of, files))
    columns, rows = sensors.left_grid.points
    lattice = lattice_of(sensors, Window(int(rows[rows.size // 2]), int(columns[columns.size // 2]), 2, 2), 0, 1)
    if isinstance(resolution, Path) or not np.isfinite(lattice.nodes).all():
        return
    projection = Projection(crs or utm_of(*lattice.middle))
    count = Ground(on_map(lattice, projection, "pair")).pixel_area / resolution**2
    if 2 * count > _CELLS_PER_PIXEL:  # the box around all cells may be twice as large as the image
        raise SatIntervalsError(f"{count:.0f} cells of {resolution:g} m for each pixel: choose a coarser resolution")
    if completion := completion_of(resolution, choices):
        ends = (nodes[[0, nodes.size // 2, -1]] for nodes in (rows, columns))
        row, column = (axis.ravel() for axis in np.meshgrid(*ends))
        points = sensors.triangulate(row, column, np.zeros(9))
        x, y = projection.place(*points[np.isfinite(points).all(axis=1), :2].T)
        wide, high = np.ptp(x), np.ptp(y)  # heights move the ground: only other places are far from it
        cells = Cells.over(Extent(x.min() - wide, y.min() - high, x.max() + wide, y.max() + high), resolution)
        completion.on(north_up(projection.crs, cells.left, cells.top, resolution), (cells.rows, cells.columns))


def surface_tags(
    runs: Sequence[str], intervals: Sequence[Interval | None], choices: SurfaceChoices, cell: float, radius: float
) -> dict[str, str]:
    """Return tags: when runs finished, how intervals are made, their coverage; ``cell`` and ``radius`` are metres."""
    levels = {("COVERAGE", one.coverage) if one.coverage else ("ALPHA", one.alpha) for one in intervals if one}
    tags = {"RUNS": " ".join(runs), **choices.tags(), "RADIUS": f"{radius:g} m"}
    if choices.reference or len(runs) > 1:
        tags["ALIGNED"] = f"to {choices.reference}" if choices.reference else "yes" if choices.aligns else "no"
    tags |= {name: str(level) for name, level in levels} if len(levels) == 1 else {}
    matched = [one.calibration for one in intervals if one and isinstance(one.calibration, Calibration)]
    if matched:
        tags["DISPARITY_CALIBRATION"] = ", ".join(sorted({f"{one.name} {one.sha256}" for one in matched}))
    return choices.calibration.tagged(tags, cell) if choices.calibration else tags


def _grid_of(path: Path, given: str | None) -> tuple[Cells, str]:
    """Return the grid of a raster as cells of a surface, and its CRS, beside which none may be given."""
    if given is not None:
        raise SatIntervalsError(f"the CRS is that of {path}, but {given} is given too: leave it out")
    (rows, columns), place = read_place(path)
    assert place.crs is not None
    across, down = place.affine.a, -place.affine.e
    if not (across > 0 and abs(across - down) <= 1e-6 * across):
        raise SatIntervalsError(
            f"{path} has pixels of {across:g} x {down:g} m: give a north-up raster with square pixels"
        )
    return Cells(place.affine.c, place.affine.f, across, rows, columns), horizontal_name(place.crs)


def _cells(each: Each, clouds: Sequence[PointCloud], resolution: float, radius: float, grid: Cells | None) -> Cells:
    """Return the cells that the points of all runs reach, or those of a given raster."""
    extent = joined(cloud.extent(each) for cloud in clouds)
    if extent is None:
        raise SatIntervalsError(
            f"no valid pixel in {', '.join(str(cloud.run.out) for cloud in clouds)}, or all points are left out as "
            "outliers or open intervals: give runs with valid pixels, or leave out fewer"
        )
    extent = extent.grown(radius)
    if grid is not None:
        if not extent.intersects(grid.extent(Window(0, 0, grid.rows, grid.columns))):
            raise SatIntervalsError("no point reaches the grid of the given raster: give one of the same place")
        return grid
    cells = Cells.over(extent, resolution)
    pixels = sum(cloud.run.region.height * cloud.run.region.width for cloud in clouds)
    if cells.rows * cells.columns > _CELLS_PER_PIXEL * pixels:
        raise SatIntervalsError(
            f"{cells.rows} x {cells.columns} cells of {resolution:g} m for {pixels} pixels: "
            "choose a coarser resolution, or runs of one place"
        )
    return cells
