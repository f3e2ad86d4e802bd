"""Open the points of runs, which `triangulate` wrote, and read them by windows."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import POINTS
from sat_intervals.raster import read_layers, read_shape, read_tags
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import Grid, Window

POINT = {band.name: index for index, band in enumerate(POINTS)}
# Side of a window of points in pixels: some tens of megabytes.
WINDOW = 512


def triangulated(outs: Sequence[str | Path | Run]) -> list[Run]:
    """Open runs, unless they are open; raise if one is given twice, or has no points or those of an earlier run."""
    runs: list[Run] = []
    for given in outs:
        run = given if isinstance(given, Run) else open_run(given)
        out, path = run.out, run.out / "points.tif"
        if not path.exists():
            raise SatIntervalsError(f"{out} has no points.tif: run sat-intervals triangulate on it first")
        if read_tags(path).get("RUN") != run.report["finished"] or read_shape(path) != (len(POINTS), *run.shape):
            raise SatIntervalsError(f"{path} belongs to an earlier run in {out}: triangulate again")
        if known := [one.out for one in runs if one.report["finished"] == run.report["finished"]]:
            raise SatIntervalsError(f"{known[0]} and {out} are the same run: give each run once")
        runs.append(run)
    return runs


def read_points(path: Path, window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Read the bands of ``points.tif`` in a window, and the mask of its points ``(rows, columns)``."""
    bands = read_layers(path, window)
    return bands, np.isfinite(bands[POINT["height"]])


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
