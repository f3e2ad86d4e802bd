"""The tables of docs/heights.md (`make surface-bounds`): coverage and width of the bounds of cells, on exact scenes.

Towns, slopes and rough ground, at three base-to-height ratios, are matched with a coverage of .90, as four pairs each,
which see the ground from other sides. Points come from the analytic cameras of the scenes. The envelope keeps open
intervals, as without a coverage; quantiles leave them out. The truth of a cell is the height of the surface, seen
from above, at its centre. Cells near a wall are apart: heights within one cell of the centre differ by more than 2.2 px
of disparity, and more than the side of the cell. Matched pairs are kept in `build/surfaces`.
"""

import sys
from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np
import rasterio
from pyproj import Transformer

from sat_intervals import demo, match_pair
from sat_intervals.demo import PIXEL
from sat_intervals.evaluate.accuracy import Heights
from sat_intervals.evaluate.surface_calibration import fitted, held_out
from sat_intervals.heights.choices import BOUNDS, SurfaceChoices
from sat_intervals.heights.geometry import set_geometry
from sat_intervals.kernels.conformal import relief_of, widened
from sat_intervals.raster import north_up, write_layer
from sat_intervals.workflows.dsm import make_surface

sys.path.append(str(Path(__file__).parents[1]))
from cameras import EAST, LATITUDE, LONGITUDE, NORTH, cameras

BUILD = Path("build/surfaces")
SIZE, SEED = 300, 5
VIEWS = {0.3: (-0.2, 0.4), 0.5: (-0.4, 0.6), 0.8: (-0.6, 1.0)}
# Left views of the further pairs, as shares of the distance between both views.
FURTHER = (-0.6, -0.1, -0.85)
KINDS = {"town": 0, "slope": 60, "rough": 10}  # metres of relief
CRS = "EPSG:32631"
OBJECTS, TERRAIN, RANDOM = demo.OBJECTS, demo._terrain, np.random.default_rng


def rough(ground, r, c):
    """The terrain with bumps of some metres, 14 px apart."""
    return TERRAIN(ground, r, c) + 4 + 3 * demo._noise(ground.lattice, r, c, 14, 3)


def views_of(ratio):
    """Views of the four pairs of a base-to-height ratio."""
    left, right = VIEWS[ratio]
    return [(left, right), *((share * (right - left), (1 + share) * (right - left)) for share in FURTHER)]


def make_pair(folder, kind, views, number):
    """Write and match a pair with noise of its own and cameras, unless done before; return profiles of its rows."""

    def random(seed):
        return RANDOM([*seed, number] if number and seed[1] == 1 else seed)

    demo.VIEWS = views
    demo.OBJECTS = OBJECTS if kind == "town" else ()
    demo._terrain = rough if kind == "rough" else TERRAIN
    if not (folder / "out" / "geometry.json").exists():
        with mock.patch.object(np.random, "default_rng", random):
            scene = demo.make_scene(SIZE, SIZE, SEED, relief=KINDS[kind])
        place = north_up(32631, x=370_000, y=4_830_000, pixel=PIXEL)
        folder.mkdir(parents=True, exist_ok=True)
        for name, image in (("left", scene.left), ("right", scene.right)):
            write_layer(folder / f"{name}.tif", image, 0, place)
        search = {"minimum": scene.minimum, "maximum": scene.maximum}
        settings = {"preset": "satellite", "disparity": search, "interval": {"coverage": 0.9}}
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
        set_geometry(folder / "out", *cameras(folder, SIZE, SIZE, views=views))
    return list(demo.profiles(SIZE, SIZE, SEED, 0, 64, KINDS[kind]))


@cache
def truth_of(place, shape, kind):
    """Height at the centres of cells, and the range of heights within one cell of them; NaN outside the scene."""
    back = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)

    def at(down, across):
        row, column = np.indices(shape)
        longitude, latitude = back.transform(*(place @ (column + 0.5 + across, row + 0.5 + down)))
        u, v = (longitude - LONGITUDE) * EAST / PIXEL, np.rint((LATITUDE - latitude) * NORTH / PIXEL).astype(int)
        height = np.full(shape, np.nan)
        for row in range(SIZE):
            here = (v == row) & (u >= 0) & (u < SIZE)
            height[here] = np.interp(u[here], *PROFILES[kind][row][1:3])
        return height

    steps = np.linspace(-1, 1, 5)
    return at(0, 0), np.ptp([at(down, across) for down in steps for across in steps], axis=0)


def surface_of(outs, path, cell, bounds, kind, pixel, like=None):
    """Cells of a surface with interval and truth, and which of them are near walls.

    With ``like``, another surface, on its grid: cells with an interval there, too.
    """
    choices = SurfaceChoices(bounds, keeps_open=bounds == "envelope")
    make_surface(outs, path, resolution=like or cell * PIXEL, crs=None if like else CRS, choices=choices)
    with rasterio.open(path) as dataset, rasterio.open(like or path) as first:
        height, lower, upper = dataset.read((1, 2, 3)).astype(np.float64)
        truth, range_ = truth_of(dataset.transform, dataset.shape, kind)
        known = np.isfinite(truth) & np.isfinite(first.read(2)) & np.isfinite(lower)
    row, column = (4 * np.arange(size) // size for size in known.shape)
    block = 4 * row[:, np.newaxis] + column
    walls = range_[known] > max(2.2 * pixel, cell * PIXEL)
    return Heights(height, lower, upper, truth, relief_of(height), 0 * height, block).of(known), walls


def figures(sample, walls, pixel):
    """Coverage of all cells, outside walls and near them; median and mean width in pixels."""
    inside, width = sample.outside <= 0, 2 * sample.half_width / pixel
    near = inside[walls].mean() if walls.any() else np.nan
    return inside.mean(), inside[~walls].mean(), near, np.median(width), width.mean()


def calibrated(sample, others):
    """A sample with the margins of other samples together."""
    fit = fitted(Heights(*(np.concatenate(values) for values in zip(*others, strict=True))), 1.0, 0.9)
    lower, upper = widened(*sample[:3], fit.margins.of(sample.half_width, sample.relief))
    return sample._replace(lower=lower, upper=upper)


class Table:
    """Lines as they come, and their means at the end."""

    def __init__(self, *columns):
        self._means = {}
        head = ["scene", "base-to-height", "cell", *columns, "coverage", "without walls", "walls"]
        head += ["median width", "mean width"]
        print(f"\n| {' | '.join(head)} |\n|{'---|' * len(head)}")

    def add(self, kind, ratio, cell, label, row):
        self._means.setdefault((cell, label), []).append(row)
        print(f"| {kind} | {ratio} | {cell} px | {label} | {written(row)} |", flush=True)

    def end(self):
        for (cell, label), rows in self._means.items():
            lowest, highest = (end(row[0] for row in rows) for end in (min, max))
            ends = f"{lowest:.3f} to {highest:.3f}"
            print(f"| mean | coverage {ends} | {cell} px | {label} | {written(np.nanmean(rows, axis=0))} |")


def written(row):
    """The figures of a line of a table."""
    return " | ".join([*(f"{share:.3f}" for share in row[:3]), *(f"{width:.2f}" for width in row[3:5])])


def cells_of(kind, ratio, cell, pairs, bounds):
    """Cells of a scene, from some of its pairs, on the grid of the first one."""
    outs = [BUILD / f"{kind}_{ratio}_{number}" / "out" for number in range(pairs)]
    path, like = (BUILD / "several.tif", BUILD / "one.tif") if pairs > 1 else (BUILD / "one.tif", None)
    return surface_of(outs, path, cell, bounds, kind, 0.5 / ratio, like)


def compare_bounds(scenes):
    table = Table("bounds")
    for kind, ratio, cell in scenes:
        for bounds in BOUNDS:
            sample, walls = cells_of(kind, ratio, cell, 1, bounds)
            table.add(kind, ratio, cell, bounds, figures(sample, walls, 0.5 / ratio))
    table.end()


def compare_calibrations(scenes):
    table = Table("calibrated on")
    samples = {scene: cells_of(*scene, 1, "quantiles") for scene in scenes}
    for (kind, ratio, cell), (sample, walls) in samples.items():
        others = [samples[other, ratio, cell][0] for other in KINDS if other != kind]
        by_blocks, by_scenes = held_out(sample, 1.0, 0.9), calibrated(sample, others)
        for label, one in {"nothing": sample, "other blocks": by_blocks, "other scenes": by_scenes}.items():
            table.add(kind, ratio, cell, label, figures(one, walls, 0.5 / ratio))
    table.end()


def compare_pairs(scenes):
    table = Table("pairs")
    for kind, ratio, cell in scenes:
        for pairs in (1, 2, 4):
            sample, walls = cells_of(kind, ratio, cell, pairs, "quantiles")
            for label, one in ((f"{pairs}", sample), (f"{pairs}, calibrated", held_out(sample, 1.0, 0.9))):
                table.add(kind, ratio, cell, label, figures(one, walls, 0.5 / ratio))
    table.end()


TABLES = {"bounds": compare_bounds, "calibrations": compare_calibrations, "pairs": compare_pairs}
PROFILES = {}
for kind in KINDS:
    for ratio in VIEWS:
        for number, views in enumerate(views_of(ratio)):
            PROFILES[kind] = make_pair(BUILD / f"{kind}_{ratio}_{number}", kind, views, number)
for name in sys.argv[1:] or TABLES:
    TABLES[name]([(kind, ratio, cell) for kind in KINDS for ratio in VIEWS for cell in (1, 2, 4)])
