"""The tables of docs/change.md (`make change-bench`): false alarms, power, volumes, and a moved surface.

usage: python tests/benchmarks/change.py [stable] [power] [volumes] [moved]

stable: surfaces of disjoint images of jax_068: five pairs with each other, and two groups of five images. Ground that
did not change, but for cars and trees. power: blocks of 1 to 10 m and of 10 x 10 and 20 x 20 m that were put into the
second of two synthetic pairs, which see the ground from other sides; truth is exact. volumes: of these. moved: the
surface of a Pleiades pair and a moved copy of it with known changes. Surfaces are kept in `build/change`.
"""

import itertools
import os
import sys
from functools import cache
from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer
from scipy.ndimage import gaussian_filter

import sat_intervals
from sat_intervals import demo, match_pair
from sat_intervals.demo import PIXEL
from sat_intervals.evaluate.change import open_pair
from sat_intervals.evaluate.change_areas import ChangedAreas, signs_of
from sat_intervals.heights.geometry import set_geometry
from sat_intervals.kernels.components import components
from sat_intervals.raster import north_up, write_layer
from sat_intervals.tiling import Window
from sat_intervals.workflows.dsm import make_surface

sys.path.append(str(Path(__file__).parents[1]))
from cameras import EAST, LATITUDE, LONGITUDE, NORTH, cameras

BUILD = Path("build/change")
DATA = Path(os.environ.get("SAT_INTERVALS_SHARED", "shared")) / "data"
PAIRS = "001 002", "003 004", "005 006", "007 011", "013 018"
GROUPS = "001 003 005 007 013", "002 004 006 011 018"
RATES = 0.1, 0.05, 0.01, 0.001
SMALLEST = 50.0  # m2
CRS = "EPSG:32631"
SIZE, APART, MOST = 600, 52, 30  # px of a scene, and between blocks, and blocks of a scene
OPEN = 3.0  # metres: range of heights around a block
SCENES = {0.3: (-0.2, 0.4), 0.5: (-0.4, 0.6), 0.8: (-0.6, 1.0)}
SHIFTED = -0.6  # left view of the second pair, as a share of the distance between both
SEEDS = range(10)


def surface_of(images):
    """Surface of images of jax_068, by their numbers."""
    out = BUILD / images.replace(" ", "_")
    if not (out / "dsm.tif").exists():
        opened = [sat_intervals.open_image(DATA / "jax_068" / f"{one}.tif", band=2) for one in images.split()]
        sat_intervals.surface(opened, out, resolution=0.5)
    return out


def blobs(changed, height, smallest):
    """Areas of at least so many cells, their numbers from 1."""
    labels = components(np.sign(np.nan_to_num(height)), changed)
    sizes = np.bincount(labels.ravel())
    kept = np.flatnonzero(sizes[1:] >= smallest) + 1
    numbers = np.zeros(sizes.size, np.int32)
    numbers[kept] = 1 + np.arange(kept.size)
    return numbers[labels]


def compared(one, other):
    """Pair of two surfaces, its differences and their bands."""
    pair, *_ = open_pair(one, other, None, registers=True)
    found = pair.read(Window(0, 0, *pair.before.shape))
    return pair, found, pair.bands(found)


def stable():
    """Print shares of cells beyond rates, coverage of 0, and areas on ground that did not change."""
    print("| surfaces | .1 | .05 | .01 | .001 | coverage | areas | \\|dh\\| > 3 m |")
    print("|---|---|---|---|---|---|---|---|")
    for first, second in [*itertools.combinations(PAIRS, 2), GROUPS]:
        pair, found, bands = compared(surface_of(first), surface_of(second))
        known, smallest = np.isfinite(bands[3]), round(SMALLEST / pair.before.place.pixel_size[0] ** 2)
        shares = [(bands[3][known] <= rate).mean() for rate in RATES]
        inside = ((bands[1] <= 0) & (bands[2] >= 0))[known].mean()
        counts = [areas_of(pair)[0].max(), blobs(np.abs(found.height) > 3, found.height, smallest).max()]
        figures = [*(f"{share:.4f}" for share in shares), f"{inside:.3f}", *map(str, counts)]
        print(f"| {first}, {second} | {' | '.join(figures)} |", flush=True)


@cache
def blocks_of(seed):
    """Blocks on open ground of a scene: row, column and half side in px, and height in m."""
    columns = np.arange(SIZE, dtype=float)
    heights = np.stack([demo.shown(one, 0.0, columns)[0] for one in demo.profiles(SIZE, SIZE, seed)])
    random, found = np.random.default_rng(seed), []
    for row, column in random.integers(APART, SIZE - APART, (3000, 2)).tolist():
        half = (10, 20)[len(found) % 2]
        around = heights[row - half - 8 : row + half + 8, column - half - 8 : column + half + 8]
        near = any(max(abs(row - one[0]), abs(column - one[1])) < APART for one in found)
        if np.ptp(around) < OPEN and not near and len(found) < MOST:
            found.append((row, column, half))
    return [(*one, 1 + rise % 10) for one, rise in zip(found, random.permutation(len(found)).tolist(), strict=True)]


def scene_pair(ratio, seed, is_after):
    """Surface of a scene of a date."""
    out = BUILD / f"scene_{ratio}_{seed}_{'after' if is_after else 'before'}"
    left, right = SCENES[ratio]
    views = (SHIFTED * (right - left), (1 + SHIFTED) * (right - left)) if is_after else (left, right)
    if (out / "out" / "dsm.tif").exists():
        return out / "out"
    demo.VIEWS = views
    scene = demo.make_scene(SIZE, SIZE, seed, date=int(is_after), blocks=blocks_of(seed) if is_after else ())
    place = north_up(32631, x=370_000, y=4_830_000, pixel=PIXEL)
    out.mkdir(parents=True, exist_ok=True)
    for name, image in (("left", scene.left), ("right", scene.right)):
        write_layer(out / f"{name}.tif", image, 0, place)
    search = {"minimum": scene.minimum, "maximum": scene.maximum}
    match_pair(out / "left.tif", out / "right.tif", out / "out", {"disparity": search}, overwrite=True)
    set_geometry(out / "out", *cameras(out, SIZE, SIZE, views=views))
    make_surface([out / "out"], out / "out" / "dsm.tif", resolution=PIXEL, crs=CRS)
    return out / "out"


def truth_of(place, shape, seed):
    """Height of the block and its number at the centres of cells, 0 elsewhere."""
    row, column = np.indices(shape)
    back = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)
    longitude, latitude = back.transform(*(place @ (column + 0.5, row + 0.5)))
    u, v = (longitude - LONGITUDE) * EAST / PIXEL, np.rint((LATITUDE - latitude) * NORTH / PIXEL)
    rise, numbers = np.zeros((2, *shape))
    for number, (middle, centre, half, height) in enumerate(blocks_of(seed), 1):
        inside = (np.abs(v - middle + 0.5) < half) & (np.abs(u - centre + 0.5) < half)
        rise[inside], numbers[inside] = height, number
    return rise, numbers.astype(int)


@cache
def scenes():
    """Seeds of scenes, differences, labels of areas, their figures, true rise, and numbers of blocks."""
    found = []
    for ratio, seed in itertools.product(SCENES, SEEDS):
        pair, difference, _ = compared(scene_pair(ratio, seed, False), scene_pair(ratio, seed, True))
        labels, figures = areas_of(pair)
        truth = truth_of(pair.before.place.transform, pair.before.shape, seed)
        found.append((seed, difference.height, labels, figures, *truth))
    return found


def areas_of(pair):
    """Labels of the areas of change of a pair, and their figures."""
    signs, _ = signs_of(pair, RATES[2], None)
    areas = ChangedAreas(pair, signs, SMALLEST)
    areas.add(Window(0, 0, *pair.before.shape))
    return areas.labels, areas.report()[0]


def power():
    """Print shares of blocks found, and of their area, beside thresholds of the difference."""

    def rule(limit):
        """Number of false areas; side, height, and share of the area that is found, of each block."""
        false, blocks = 0, []
        for seed, height, labels, _, rise, numbers in scenes():
            if limit:
                labels = blobs(np.abs(height) > limit, height, round(SMALLEST / PIXEL**2))
            false += len(set(np.unique(labels)) - set(np.unique(labels[rise > 0])) - {0})
            for number, (_, _, half, block) in enumerate(blocks_of(seed), 1):
                inside = numbers == number
                if np.isfinite(height[inside]).mean() > 0.5:
                    blocks.append((2 * half * PIXEL, block, (labels[inside] > 0).mean()))
        return false, np.array(blocks)

    rules = {"intervals, .01": rule(None), "\\|dh\\| > 3 m": rule(3)}
    for limit in itertools.count(4):
        false, blocks = rule(limit)
        if false <= rules["intervals, .01"][0]:
            rules[f"\\|dh\\| > {limit} m"] = false, blocks
            break
    heights = (1, 1), (2, 2), (3, 3), (4, 5), (6, 7), (8, 10)
    named = " | ".join(f"{low} to {high} m" if low < high else f"{low} m" for low, high in heights)
    print(f"| rule | false areas | blocks | {named} |\n|---|---|---|{'---|' * len(heights)}")
    for (name, (false, blocks)), side in itertools.product(rules.items(), (10, 20)):
        own = [
            blocks[(blocks[:, 0] == side) & (blocks[:, 1] >= low) & (blocks[:, 1] <= high), 2] for low, high in heights
        ]
        figures = (f"{(one >= 0.5).mean():.2f}, {one.mean():.2f}" for one in own)
        print(f"| {name} | {false} | {side} x {side} m | {' | '.join(figures)} |", flush=True)


def volumes():
    """Print how often the true volume of areas on blocks is inside the interval of .9."""
    found = []
    for _, _, labels, figures, rise, numbers in scenes():
        for area in range(1, labels.max() + 1):
            inside = labels == area
            block = np.bincount(numbers[inside], minlength=2)[1:].argmax() + 1
            if rise[inside].any():
                whole = rise[numbers == block].sum()
                truth = np.array([rise[inside].sum(), whole]) * PIXEL**2
                found.append((figures["volume"][area - 1], figures["volume_deviation"][area - 1], *truth))
    volume, deviation, truth, whole = np.transpose(found)
    inside = (np.abs(volume - truth) <= 1.645 * deviation).mean()
    share, size = np.median(volume / whole), np.median(deviation / volume)
    print(f"{len(found)} areas on blocks: true volume of the area inside the interval of .9 in {inside:.3f}; median")
    print(f"deviation {size:.3f} of the volume; median volume of the area {share:.2f} of that of the block")


def moved():
    """Print what is found of a moved copy of the surface of a Pleiades pair, with known changes."""
    out, raw = BUILD / "picanteo", DATA / "raw_picanteo_pre"
    if not (out / "dsm.tif").exists():
        sat_intervals.surface([raw / "left.tif", raw / "right.tif"], out, resolution=1)
    with rasterio.open(out / "dsm.tif") as dataset:
        bands, kind, tags = dataset.read(), dataset.profile, dataset.tags()
        names = dataset.descriptions
    shift = 3.4, -2.2, 1.7
    random, half = np.random.default_rng(0), (bands[2] - bands[1]) / 2
    centres = [(row, column) for row in range(60, 460, 80) for column in range(60, 480, 80)]
    truth = np.zeros(half.shape)
    for number, (row, column) in enumerate(centres):
        truth[row - 10 : row + 10, column - 10 : column + 10] = (6, -8, 12, -5)[number % 4]
    noise = gaussian_filter(random.normal(size=half.shape), 2)
    bands[:3] += truth + 0.3 * half * noise / noise.std() + shift[2]
    place = kind["transform"]
    kind["transform"] = rasterio.transform.Affine(place.a, 0, place.c + shift[0], 0, place.e, place.f + shift[1])
    with rasterio.open(BUILD / "moved.tif", "w", **kind) as dataset:
        dataset.write(bands)
        dataset.update_tags(**tags)
        dataset.descriptions = names
    pair, difference, _ = compared(out, BUILD / "moved.tif")
    labels, _ = areas_of(pair)
    known = [np.s_[row - 10 : row + 10, column - 10 : column + 10] for row, column in centres]
    known = [part for part in known if np.isfinite(difference.height[part]).mean() > 0.5]
    shares = np.array([(labels[part] > 0).mean() for part in known])
    false = len(set(np.unique(labels)) - set(np.unique(labels[truth != 0])) - {0})
    print(f"shift {shift} found as {np.round(pair.shift, 2).tolist()}; {(shares > 0.5).sum()} of {len(known)} changes")
    print(f"found, {shares.mean():.2f} of their area; {false} false areas")


if __name__ == "__main__":
    for name in sys.argv[1:] or ("stable", "power", "volumes", "moved"):
        {"stable": stable, "power": power, "volumes": volumes, "moved": moved}[name]()
