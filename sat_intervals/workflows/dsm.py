"""Make a surface model of finished runs, on workers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sat_intervals.config import load_config
from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.dsm import surface_of_runs
from sat_intervals.progress import Progress
from sat_intervals.raster import path_of
from sat_intervals.results import Run, open_run
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import pool_of


def make_surface(
    outs: Sequence[str | Path | Run],
    path: str | Path,
    *,
    resolution: float | Path | None = None,
    crs: str | None = None,
    radius: float | None = None,
    geoid: str | Path | None = None,
    choices: SurfaceChoices | None = None,
    config: Any = None,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Make a surface model from one or several runs, or complete that of a run of many images.

    Parameters
    ----------
    outs
        Folders of finished runs of the same place, or runs as they were opened; `set_geometry` has named models and
        grids of each. Or a run of three images or more alone: its surface is completed by ``choices``, which have
        ``fill``, ``flatten`` or ``mask``.
    path
        The Cloud-Optimized GeoTIFF to write; an existing file is replaced.
    resolution
        Side of a cell in metres; or a north-up raster with square pixels, whose grid and CRS are used. None of many
        images: their surface keeps its grid.
    crs
        A projected CRS in metres; by default the UTM zone of a point near the middle, or that of the raster.
    radius
        A point also contributes to cells whose centre is within this distance (metres); by default the side of a cell.
    geoid
        Grid of geoid heights; heights then refer to the geoid, by default to the WGS 84 ellipsoid.
    choices
        The cell's interval, and what is left out: by default nothing but, with a coverage, points whose interval is
        open. The intervals of several runs are averaged where they meet; else their hull is taken.
    config
        Settings, or a source for `load_config`, by default those of satellite images; their ``cluster`` says where the
        cells are filled.
    progress
        Callback, see `Progress`.

    Returns
    -------
    ``crs``, ``rows``, ``columns``, ``points``, ``filled`` (share of cells with a measured height), ``disagreeing``
    (share of the cells of several runs whose intervals do not overlap, None if there are none), ``shifts`` (of each run
    in metres, with its standard deviation, None if unknown; empty if nothing was aligned), ``without_intervals``
    (folders of runs without intervals); ``bounds``; ``calibration`` (its name, None without one);
    ``median_half_width`` (metres) and ``wide``, the share of cells with bounds whose half width exceeds 20 m, both None
    without bounds; ``outliers``, ``open``, ``border`` and ``poor_cells``, the numbers of points and cells left out;
    ``completed``, numbers of cells ``filled``, ``flattened``, ``masked``, and ``voids`` that stay, of ``areas`` of one
    height, and of those ``without_rim``, which are voids, None of a surface as it was measured; ``geometry``, for each
    folder, how models and grids fit, see `set_geometry`, and ``lost``, the share of the region where they have no
    values. Of many images only ``crs``, ``rows``, ``columns`` and ``completed``.

    Raises
    ------
    SatIntervalsError
        A run has no models and grids, or none that fit, no cell has a height, the CRS or the grid cannot be used, or
        the file cannot be written.
    """
    runs, path = [out if isinstance(out, Run) else open_run(out) for out in outs], path_of(path)
    cells: dict[str, Any] = {"resolution": resolution, "crs": crs, "radius": radius}
    cells |= {"geoid": None if geoid is None else path_of(geoid), "choices": choices or SurfaceChoices()}
    with Connection(load_config(config).cluster, path.parent) as connection:
        pool = pool_of(connection, path.parent, progress)
        return surface_of_runs(runs, path, pool, **cells)
