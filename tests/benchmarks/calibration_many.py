"""Make the built-in calibration of the preset many, ``configs/calibrations/many.yaml``; ten minutes.

Scenes with exact truth and three to twelve views, and the north half of the LiDAR of ten WorldView-3 images in
SAT_INTERVALS_SHARED. Usage: python calibration_many.py
"""

import os
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from sat_intervals.cli.tables import show_calibration
from sat_intervals.config import Config, key_of, load_config
from sat_intervals.heights.views import sensors_of
from sat_intervals.match.gauge import Gauge, at_levels, pairs_of
from sat_intervals.match.levels import calibration_of_parts
from sat_intervals.match.matching_cost import Given
from sat_intervals.match.measurement import Measured, threshold_sweep
from sat_intervals.match.patch import PatchFrame, match_patch, patch_areas
from sat_intervals.match.postprocess import RawRows
from sat_intervals.match.sweep import SweepCost
from sat_intervals.match.whole import scale_of_rows
from sat_intervals.raster import Projection, open_image, read_layers, read_place, read_reduced_views
from sat_intervals.tiling import Window
from sat_intervals.workflows.calibrate import write_calibration
from sat_intervals.workflows.demo import CRS, write_views
from sat_intervals.workflows.ground import GroundPlan, found_ground

OUT = Path(__file__).parents[2] / "configs" / "calibrations" / "many.yaml"
DATA = Path(os.environ["SAT_INTERVALS_SHARED"]) / "data" / "jax_068"
# Views, seeds and further arguments of the scenes, and their sides in pixels.
SCENES = ((3, 11, {}), (3, 12, {"snr": 60}), (5, 13, {"snr": 60}), (8, 14, {}), (12, 15, {"snr": 60}))
SIDE = 420
CELL = 0.5
BORDER = 8  # cells along the borders of a truth that do not count


def each(function, arguments, stage=""):
    """Call a function with each of some arguments on two threads."""
    with ThreadPoolExecutor(2) as threads:
        yield from enumerate(list(threads.map(lambda one: function(*one), arguments)))


def truth_on(plan: GroundPlan, path: Path, half: slice) -> np.ndarray:
    """Return true heights on the grid of a plan, NaN where unknown; ``half`` of the rows of the file count."""
    heights, (_, place) = read_layers(path)[0].astype(float), read_place(path)
    known = np.full(heights.shape, np.nan)
    inner = np.s_[BORDER:-BORDER, BORDER:-BORDER]
    known[half] = heights[half]
    heights = np.full(heights.shape, np.nan)
    heights[inner] = known[inner]
    cells, transform = plan.cells, place.transform
    row = round((cells.top - transform.f) / CELL)
    column = round((transform.c - cells.left) / CELL)
    found = np.full((cells.rows, cells.columns), np.nan)
    rows, columns = np.indices(heights.shape)
    rows, columns = rows + row, columns + column
    inside = (rows >= 0) & (rows < cells.rows) & (columns >= 0) & (columns < cells.columns)
    found[rows[inside], columns[inside]] = heights[inside]
    return found


def registered(truth: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the truth moved by whole cells and a constant onto a surface."""
    best = (np.inf, truth)
    for down, across in np.ndindex(7, 7):
        moved = np.roll(truth, (down - 3, across - 3), (0, 1))
        away = height - moved
        middle = np.nanmedian(away)
        loss = float(np.nanmean(np.minimum(np.abs(away - middle), 3)))
        best = min(best, (loss, moved + middle), key=lambda one: one[0])
    return best[1]


def measured(
    name: str, paths: list[Path], band: int, crs: str, truth: Path, half: slice
) -> tuple[list[Measured], Config]:
    """Match a scene at all thresholds, and measure its intervals."""
    images = [open_image(path, band=band) for path in paths]
    config = load_config({"preset": "many", "interval": {"alpha": 0.9}})
    plan = found_ground(sensors_of(images, []), Projection(crs), CELL, config, each)
    config, ground = plan.config, plan.ground
    frame = PatchFrame.of_whole(Window(0, 0, *ground.shape))
    cost, areas = SweepCost(config, Given(ground=ground, ranges=plan.ranges)), patch_areas(frame, config, plan.ranges)
    costs = cost.of_areas(read_reduced_views(images, cost.windows(areas), ground.reductions), areas)
    thresholds = threshold_sweep(config)
    gauge, true = Gauge(thresholds, name, 0.0, in_blocks=False), None
    for pair in pairs_of(thresholds):
        high, low = (float(thresholds.low[threshold]) for threshold in pair)
        chosen = at_levels(config, high, low, None)
        patch = match_patch(frame, costs, chosen, ranges=plan.ranges)
        rows = RawRows.of(patch.raw, patch.right)
        scale = scale_of_rows(rows, chosen)
        if true is None:
            height = ground.base + ground.step * rows.disparity.astype(float)
            height[rows.ambiguity > scale.most] = np.nan
            true = (registered(truth_on(plan, truth, half), height) - ground.base) / ground.step
        gauge.add(rows, slice(0, len(true)), scale, (true, np.zeros(true.shape, np.int64)), pair, chosen)
    parts = gauge.measured()
    print(name, f"step {ground.step:.2f} m", [part.kept for part in parts], flush=True)
    return parts, chosen


def main() -> None:
    """Measure all scenes and write the calibration."""
    parts, described = [], []
    files = sorted(DATA.glob("0*.tif"))
    found, config = measured("jax_068", files, 2, "EPSG:32617", DATA / "lidar_west.tif", np.s_[:256])
    parts += found
    described.append({"name": "jax_068", "views": len(files), "half": "north"})
    with tempfile.TemporaryDirectory() as folder:
        for views, seed, more in SCENES:
            name = f"demo, {views} views, seed {seed}"
            paths, truth = write_views(Path(folder) / name, SIDE, SIDE, views, seed, **more)
            parts += measured(name, paths, 1, CRS, truth, np.s_[:])[0]
            described.append({"name": name, "views": views})
    calibration, expected = calibration_of_parts(parts, config, "many", described, key_of(config))
    write_calibration(OUT, calibration)
    show_calibration(calibration, expected)


if __name__ == "__main__":
    sys.exit(main())
