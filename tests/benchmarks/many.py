"""The table of docs/many.md (`make many-bench`): surfaces of many images and of pairs of them; five minutes.

Images of jax_068 in SAT_INTERVALS_SHARED against LiDAR of the west half, whose north half the calibration has seen, and
views of towns with exact truth, which it has not. Surfaces are made anew, in `build/many`, and registered;
seconds are those of matching, the first ones with compilation.
"""

import os
from pathlib import Path

import numpy as np

from sat_intervals import open_image, surface
from sat_intervals.demo import PIXEL
from sat_intervals.evaluate.comparison import compared, open_comparison, registered
from sat_intervals.raster import read_heights
from sat_intervals.tiling import Window
from sat_intervals.workflows.demo import write_views

BUILD = Path("build/many")
DATA = Path(os.environ.get("SAT_INTERVALS_SHARED", "shared")) / "data" / "jax_068"
PAIRS = "001 002", "003 004", "005 006", "007 011", "013 018"
OF_THREE = "003 004", "004 005", "003 005"
THREE, TEN = "003 004 005", " ".join(PAIRS)
CLASSES = {"ground": 2, "roofs": 6, "trees": 5}
# Views, seeds and noise of towns, and their side in pixels.
TOWNS = [(views, seed, {"snr": 60} if seed % 2 else {}) for views in (3, 5, 8) for seed in (21, 22, 31, 32)]
SIDE = 420


def figures(out, truth, classes=None):
    """Share of the truth in cells with a height, median and mean error, NMAD; coverage and half width of parts."""
    comparison, _ = registered(open_comparison(out / "dsm.tif", truth))
    window = Window(0, 0, *comparison.shape)
    cells, known, missing = compared(comparison, window)
    height, lower, upper, reference = (np.asarray(values) for values in cells[:4])
    away, inside = np.abs(height - reference), (lower <= reference) & (reference <= upper)
    rows = known[0]
    parts = {"all": inside >= 0, "south": rows > (rows.min() + rows.max()) // 2}
    if classes:
        place, shape = comparison.cells(window, comparison.finer)
        kinds = read_heights(classes, place, shape, Window(0, 0, *shape))[known]
        parts |= {name: kinds == kind for name, kind in CLASSES.items()}
        parts |= {f"south {name}": parts[name] & parts["south"] for name in CLASSES}
    nmad = 1.4826 * np.median(np.abs(height - reference - np.median(height - reference)))
    covered = "  ".join(
        f"{name} {inside[part].mean():.3f} +-{np.median((upper - lower)[part]) / 2:.2f}" for name, part in parts.items()
    )
    return away.size / (away.size + missing[0].size), np.median(away), away.mean(), nmad, covered


def jacksonville(images):
    """Print the line of some images of jax_068, by their numbers."""
    out = BUILD / images.replace(" ", "_")
    opened = [open_image(DATA / f"{one}.tif", band=2) for one in images.split()]
    report = surface(opened, out, resolution=PIXEL, overwrite=True)
    seconds = report["seconds"]["total"] if "seconds" in report else report["run"]["seconds"]["total"]
    show(images, figures(out, DATA / "lidar_west.tif", DATA / "classes_west.tif"), seconds)


def town(views, seed, more):
    """Print the line of a scene of our own."""
    paths, truth = write_views(BUILD / f"{views}_{seed}", SIDE, SIDE, views, seed, **more)
    report = surface(paths, BUILD / "town", resolution=PIXEL, overwrite=True)
    found = figures(BUILD / "town", truth)
    show(f"{views} views, seed {seed}", found, report["seconds"]["total"])


def show(name, found, seconds):
    """Print a line."""
    share, median, mean, nmad, covered = found
    errors = f"median {median:.3f}  mean {mean:.3f}  NMAD {nmad:.3f}"
    print(f"{name:40} cells {share:.3f}  {errors}  {covered}  {seconds:.0f} s", flush=True)


for images in (TEN, THREE, *PAIRS, *OF_THREE):
    jacksonville(images)
for views, seed, more in TOWNS:
    town(views, seed, more)
