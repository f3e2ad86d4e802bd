"""Make a procedural satellite scene with exact truth: two epipolar views of one surface, from a seed.

The surface has image rows, ground columns `u` (px of 0.5 m) and heights (m). Each row is a polyline with four nodes per
pixel. At a jump (houses, cars, edges of trees) two nodes share one position and form a vertical wall. A view projects
the polyline to columns `x = u + a (height - DATUM)` and shows the highest point of each ray.

The truth is exact: the point at a pixel centre is the intersection of a ray with the polyline, in closed form. Its
disparity is `(a_right - a_left) (height - DATUM)`, `x_right = x_left + d`. The same polyline decides whether the right
view shows the point. Beside a step, blur mixes both sides; the truth is that of the pixel centre.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Arrays = Sequence[Array]
Profile = tuple[int, Array, Array, Array]  # row; ground column (px), height (m) and radiance of its nodes
# What is new at a later date: row, column and half side (px) of squares, and metres by which they rise.
Blocks = Sequence[tuple[float, float, float, float]]

VIEWS = (-0.4, 0.6)  # a of the left and the right view, px per metre
DATUM, PIXEL = 12.0, 0.5  # m: the height of disparity 0, the size of a pixel
OVER, FRACTIONS = 4, np.arange(4) / 4  # nodes (and samples) per pixel; their positions
MARGIN = 64  # px of ground around a scene without mountain: more than a parallax (20 px) or a shadow (60 rows, 45 px)
BANK = 18  # px, half the width of the river
SAMPLES = 96  # positions along a side at which a mountain is measured
STEP = 0.8  # m between adjacent nodes that form a wall
SLOPE_LIGHT = (0.5, 0.65)  # shading of slopes along columns and rows: sun in the upper left, 50 degrees high
LIGHTS = (0.3, 1.8)  # least and largest shading of slopes
SHADOW_SHIFT = 3  # nodes a row
SHADOW_DROP = 0.75  # m a row
AMBIENT = 0.25  # share of light in a shadow
OFFSET, GAIN = np.array([[90, 62], [2400, 2570]])  # DN = offset + gain * radiance; left, right
MID_LEVEL, SATURATION = 600.0, 4095  # DN at which the signal to noise ratio is defined; 12 bits
CORNER = (0.32, 0.13)  # legs of the empty corner as shares of rows and columns
SPARE = 3  # px between the truth and the ends of the search range

QUARTER = 230  # px between the roads around a quarter
HOUSES, BLOCKS, HALLS, FIELD, WOOD, PARK = range(6)  # kinds of quarter; the next arrays have one value for each
ALBEDO = np.array([0.24, 0.22, 0.26, 0.30, 0.12, 0.25])
CONTRAST = np.array([0.25, 0.15, 0.08, 0.04, 0.30, 0.12])
STREET = np.array([42, 46, 70, 130, 190, 96])  # px between streets
PLAN = np.array([[1, 1, 0, 3], [1, 2, 0, 4], [5, 1, 1, 3], [0, 1, 4, 2]])  # kinds of adjacent quarters, repeated
FLAT, GABLE, TREE, FOREST, ROOFTOP = range(5)
# Kinds of quarter; cell length along a street (px), rows of cells per street, their shift, random offset across (px);
# half length, half width (px); least and largest height (m); least and largest albedo; share of used cells; shape.
OBJECTS = (
    ((HOUSES,), 30, 1, 0, 4, 11, 8, 5, 8.5, 0.2, 0.6, 0.95, GABLE),
    ((BLOCKS,), 44, 1, 0, 2, 21, 12.5, 8, 31, 0.2, 0.7, 0.6, FLAT),
    ((BLOCKS,), 44, 1, 0, 3, 21, 11, 8, 20, 0.2, 0.45, 0.7, GABLE),
    ((HALLS,), 84, 1, 0, 3, 38, 23, 6, 11, 0.25, 0.8, 0.95, FLAT),
    ((HOUSES, BLOCKS, HALLS), 12, 4, 0, 2, 2.5, 1.8, 1, 2, 0.1, 0.7, 0.4, ROOFTOP),
    ((HOUSES, BLOCKS, HALLS), 14, 1, 0.5, 3, 4.2, 1.7, 1.5, 1.6, 0.05, 0.7, 0.5, FLAT),  # cars
    ((HOUSES, BLOCKS, PARK), 17, 2, 0, 5, 5, 5, 3, 9, 0.14, 0.32, 0.4, TREE),
    ((FIELD, PARK), 40, 3, 0, 9, 6, 6, 4, 10, 0.14, 0.32, 0.2, FOREST),
    ((WOOD, PARK), 20, 9, 0, 3, 7, 7, 7, 14, 0.14, 0.32, 0.6, FOREST),
    ((WOOD,), 17, 11, 0, 3, 6.5, 6.5, 7, 14, 0.14, 0.32, 1, FOREST),
    ((WOOD,), 16, 12, 0, 3, 6, 6, 6, 12, 0.14, 0.32, 1, FOREST),
    ((WOOD,), 15, 13, 0, 3, 5, 5, 6, 11, 0.14, 0.32, 1, FOREST),
)


@dataclass(frozen=True)
class Scene:
    """Two views and their truth, arrays (rows, columns); pixel centres are integers."""

    left: Array  # uint16, 12 bits, 0 = no data
    right: Array  # the same
    truth: Array  # float32 px, x_right = x_left + truth; also at hidden pixels, NaN where left has no data
    visible: Array  # bool, whether the right image shows the same point
    minimum: int  # px; the search range [minimum, maximum] contains the truth
    maximum: int


@dataclass(frozen=True)
class Ground:
    """What the ground is made of: random numbers, and a mountain of `relief` m in a scene of `size` px."""

    lattice: Array
    relief: float
    size: float
    low: float  # noise at the foot of the mountain, and at its top
    high: float
    blocks: Blocks

    @property
    def margin(self) -> int:
        """Return the px of ground around the image: more than a parallax."""
        return MARGIN + int(np.ceil(max(map(abs, VIEWS)) * self.relief))

    def mountain(self, r: Array, c: Array) -> Array:
        """Return noise, about -1 to 1, that is high where the mountain is."""
        return _noise(self.lattice, r + 0.37 * self.size, c, self.size, 3)

    def height(self, r: Array, c: Array) -> Array:
        """Return the height (m) that the mountain adds: 0 on the river, all of it a quarter of the scene away."""
        share = ((self.mountain(r, c) - self.low) / (self.high - self.low)).clip(0, 1)
        valley = np.exp(-((np.maximum(_from_river(self.lattice, r, c) - BANK, 0) / (self.size / 4)) ** 2))
        return np.asarray(self.relief * share * (1 - valley))


def _ground_of(rows: int, columns: int, seed: int, relief: float, blocks: Blocks) -> Ground:
    """Return the ground of a scene, whose mountain is `relief` m high within the image."""
    lattice = np.pad(np.random.default_rng([seed, 0]).uniform(-1, 1, (256, 256)), (0, 1), mode="wrap")
    ground = Ground(lattice, relief, max(rows, columns), 0, 1, blocks)
    if not relief:
        return ground
    r, c = np.linspace(0, rows, SAMPLES)[:, None], np.linspace(0, columns, SAMPLES)[None]
    noise = ground.mountain(r, c)
    ground = replace(ground, low=float(noise.min()), high=float(noise.max()))
    return replace(ground, relief=relief * relief / float(ground.height(r, c).max()))


def make_scene(
    rows: int = 600,
    columns: int = 800,
    seed: int = 0,
    *,
    relief: float = 0,
    psf: float = 0.6,
    snr: float = 95,
    block: int = 64,
    date: int = 0,
    blocks: Blocks = (),
) -> Scene:
    """Make a scene, `block` rows at a time, with blur `psf` (sigma, px) and signal to noise `snr` (inf: no noise).

    `relief` is the height of a mountain (m) under the city; 1 m is a disparity of 1 px. Images of another `date` have
    other noise.
    """
    blur = _Blur.of(psf, columns)
    truth, visible = np.full((rows, columns), np.nan, np.float32), np.zeros((rows, columns), bool)
    starts = np.ceil(CORNER[1] * columns * (1 - np.arange(rows) / (CORNER[0] * rows))).clip(0).astype(int)

    def lines() -> Iterator[tuple[int, Array]]:
        for profile in profiles(rows, columns, seed, blur.halo, block, relief, blocks):
            (height, left, seen), (_, right, _) = (look(profile, view, blur.at) for view in (0, 1))
            if 0 <= (row := profile[0]) < rows:
                truth[row] = (VIEWS[1] - VIEWS[0]) * (height[blur.centres] - DATUM)
                truth[row, : starts[row]] = np.nan  # NaN makes the comparisons below false
                partner = np.arange(columns) + truth[row]
                visible[row] = seen[blur.centres] & (partner >= starts[row]) & (partner <= columns - 1)
            yield row, np.stack([left, right])

    images = np.zeros((2, rows, columns), np.uint16)
    for row, level in _exposed(lines(), blur, OFFSET, GAIN, snr, np.random.default_rng([seed, 1, date])):
        images[:, row, starts[row] :] = level[:, starts[row] :]
    minimum, maximum = int(np.floor(np.nanmin(truth))) - SPARE, int(np.ceil(np.nanmax(truth))) + SPARE
    return Scene(images[0], images[1], truth, visible, minimum, maximum)


def make_views(
    rows: int,
    columns: int,
    slants: Sequence[float],
    seed: int = 0,
    *,
    relief: float = 0,
    psf: float = 0.6,
    snr: float = 95,
    change: float = 0.1,
    block: int = 64,
    date: int = 0,
    blocks: Blocks = (),
) -> tuple[Array, Array]:
    """Return raw images of many views, `(views, rows, columns)` uint16, and the heights (m) of the ground below them.

    A view shows `x = u + slant * (height - DATUM)`, in px per metre; it has its own contrast, noise, and a smooth
    change of the ground's brightness by up to `change`, as between dates; another `date` has others. Heights, `(rows,
    columns)` float32, are those of the highest points above pixel centres.
    """
    random = np.random.default_rng([seed, 2, date])
    blur, count = _Blur.of(psf, columns), len(slants)
    lattices = random.uniform(-1, 1, (count, 256, 256))
    heights = np.zeros((rows, columns), np.float32)

    def lines() -> Iterator[tuple[int, Array]]:
        for profile in profiles(rows, columns, seed, blur.halo, block, relief, blocks):
            row = profile[0]
            if 0 <= row < rows:
                heights[row] = shown(profile, 0.0, np.arange(columns, dtype=float))[0]
            seen = [shown(profile, slant, blur.at)[1] for slant in slants]
            changes = [_noise(np.pad(one, (0, 1), mode="wrap"), np.array(row), blur.at, 60, 1) for one in lattices]
            yield row, np.stack(seen) * (1 + change * np.stack(changes))

    images = np.zeros((count, rows, columns), np.uint16)
    offset, gain = random.uniform(60, 90, count), random.uniform(2300, 2600, count)
    for row, level in _exposed(lines(), blur, offset, gain, snr, random):
        images[:, row] = level
    return images, heights


@dataclass(frozen=True)
class _Blur:
    """Weights of a Gaussian blur along and across rows, rows around, positions of samples, and the pixel centres."""

    across: Array
    down: Array
    halo: int
    at: Array
    centres: slice

    @classmethod
    def of(cls, psf: float, columns: int) -> "_Blur":
        halo = int(np.ceil(3 * psf))
        kernel = np.exp(-0.5 * (np.arange(-halo * OVER, halo * OVER + 1) / OVER / max(psf, 0.01)) ** 2)
        at = np.arange(-halo * OVER, (columns + halo) * OVER) / OVER
        centres = slice(halo * OVER, (halo + columns) * OVER, OVER)
        return cls(kernel / kernel.sum(), kernel[::OVER] / kernel[::OVER].sum(), halo, at, centres)


def _exposed(
    lines: Iterator[tuple[int, Array]], blur: _Blur, offset: Array, gain: Array, snr: float, random: np.random.Generator
) -> Iterator[tuple[int, Array]]:
    """Yield rows of images with their numbers: radiances of fine lines `(views, samples)`, blurred, with noise."""
    held = deque[Array](maxlen=blur.down.size)
    for line, fine in lines:
        stop = fine.shape[1] - blur.across.size + 1
        held.append(sum(w * fine[:, k : k + stop : OVER] for k, w in enumerate(blur.across)))
        if (row := line - blur.halo) >= 0:
            light = sum(w * one for w, one in zip(blur.down, held, strict=True))
            level = offset[:, None] + gain[:, None] * light
            level += random.standard_normal(level.shape) * np.sqrt(level * MID_LEVEL) / snr
            yield row, np.rint(level).clip(1, SATURATION)


def look(profile: Profile, view: int, x: Array) -> tuple[Array, Array, Array]:
    """Return height (m), radiance and visibility in the other view, at columns `x` of view 0 (left) or 1 (right)."""
    high, shine, k, share = shown(profile, VIEWS[view], x)
    there = profile[1] + VIEWS[1 - view] * (profile[2] - DATUM)
    other = there[k] + share * (there[k + 1] - there[k])
    if VIEWS[1 - view] > 0:
        seen = other > np.maximum.accumulate(there)[k] - 1e-6
    else:
        seen = other < np.minimum.accumulate(there[::-1])[::-1][k + 1] + 1e-6
    return high, shine, seen


def shown(profile: Profile, slant: float, x: Array) -> tuple[Array, Array, Array, Array]:
    """Return height (m) and radiance at columns `x` of a view, and node k and share of the way to k + 1 shown there."""
    row, u, height, radiance = profile
    k, share = _highest_crossing(u + slant * (height - DATUM), x, slant)
    high, shine = (v[k] + share * (v[k + 1] - v[k]) for v in (height, radiance))
    wall = np.flatnonzero(np.abs(height[k + 1] - height[k]) > STEP)
    at = k[wall]
    floor = (high[wall] - np.minimum(height[at], height[at + 1])) % 3
    window = np.where((floor > 1.3) & (row % 6 > 2), 0.6, 1)
    shine[wall] = window * np.where(height[at + 1] > height[at], 0.8 * radiance[at + 1], 0.35 * radiance[at])
    return high, shine, k, share


def _highest_crossing(x: Array, at: Array, slant: float) -> tuple[Array, Array]:
    """Return node k and share of the way to node k + 1 where the rays at columns `at` cross polyline `x`."""
    # Rays are slanted: the highest crossing is the first from the left if the slant is positive, else from the right.
    if slant < 0:
        k, share = _highest_crossing(-x[::-1], -at, -slant)
        return x.size - 2 - k, 1 - share
    k = np.searchsorted(np.maximum.accumulate(x), at) - 1
    return k, (at - x[k]) / (x[k + 1] - x[k])


def profiles(
    rows: int, columns: int, seed: int = 0, halo: int = 0, block: int = 64, relief: float = 0, blocks: Blocks = ()
) -> Iterator[Profile]:
    """Yield the lit surface of rows -halo to rows + halo - 1, with a margin of MARGIN px or more on either side."""
    ground = _ground_of(rows, columns, seed, relief, blocks)
    grid = np.arange((columns + 2 * ground.margin) * OVER) / OVER - ground.margin
    shade = np.full(grid.size, -np.inf)  # m, the height of the shadow of the rows above
    for first in range(-MARGIN, rows + halo, block):
        surface = _surface(ground, np.arange(first, min(first + block, rows + halo)), columns)
        for row, (height, albedo) in enumerate(np.moveaxis(surface, 1, 0), first):
            lit = np.clip(1 - (shade - height) / 0.4, 0, 1)
            shade[SHADOW_SHIFT:] = np.maximum(shade, height)[:-SHADOW_SHIFT] - SHADOW_DROP
            half = (np.abs(np.diff(height)) > STEP) / (2 * OVER)
            if row >= -halo:
                u = grid + np.append(half, 0) - np.append(0, half)
                yield row, u, height, albedo * (AMBIENT + (1 - AMBIENT) * lit)


def _surface(ground: Ground, rows: Array, columns: int) -> Array:
    """Return height (m) and albedo (shaded by slope) of the nodes of some rows: (2, rows, nodes)."""
    lattice, margin = ground.lattice, ground.margin
    r, c = np.append(rows, rows[-1] + 1.0)[:, None], np.arange(-margin, columns + margin + 2.0)[None]
    height = _terrain(ground, r, c)
    grain = _noise(lattice, r, c, 4, 2)
    quarter = _quarter(lattice, r, c)
    albedo = np.where(height > 0, _ground(lattice, r, c, grain, quarter), 0.07 + 0.0015 * grain)
    along, down = np.diff(height)[:-1] / PIXEL, np.diff(height, axis=0)[:, :-1] / PIXEL
    albedo[:-1, :-1] *= np.clip(1 + SLOPE_LIGHT[0] * along + SLOPE_LIGHT[1] * down, *LIGHTS)
    pixels = np.stack([height, albedo, grain])[:, :-1, :-1, None]
    nodes = pixels[:, :, :-1] + np.diff(pixels, axis=2) * FRACTIONS
    for salt, (kinds, *item) in enumerate(OBJECTS):
        y, x = np.nonzero(np.isin(quarter[0][:-1, :-2], kinds))
        near, frame = _place(ground, r[y, 0], c[0, x], [v[y, x] for v in quarter], salt, item)
        y, x = y[near], x[near]
        nodes[:2, y, x] = _draw(nodes[:, y, x], frame, item)
    surface = nodes[:2].reshape(2, rows.size, -1)
    columns_of = np.arange(surface.shape[2]) / OVER - margin
    for row, column, half, rise in ground.blocks:
        inside = (np.abs(rows - row + 0.5) < half)[:, None] & (np.abs(columns_of - column + 0.5) < half)
        surface[0] += rise * inside
    return np.asarray(surface)


def _ground(lattice: Array, r: Array, c: Array, grain: Array, quarter: Arrays) -> Array:
    """Return the albedo of gardens, fields, streets and roads; `grain` is their finest texture."""
    kind, border, angle, number = quarter
    p, q = _turned(r, c, angle)
    parcel = lattice[(number + np.floor(p / 75).astype(int)) & 255, np.floor(q / 130).astype(int) & 255]
    crop = np.where(kind == FIELD, 0.3 * parcel + 0.025 * np.sin(0.9 * p), 0)
    soil = ALBEDO[kind] * (1 + CONTRAST[kind] * grain + 0.1 * _noise(lattice, r, c, 36, 2) + crop)
    street = np.abs(q - STREET[kind] * np.round(q / STREET[kind]))
    kerb = np.maximum(5 - street, 7 - border)  # px inside a street or a road; pavements are 2 px wide
    return np.where(kerb > -2, np.where(kerb > 0, 0.15, 0.26) * (1 + 0.08 * grain), soil)


def _place(ground: Ground, r: Array, c: Array, quarter: Arrays, salt: int, item: Sequence[float]) -> Arrays:
    """Return which of the positions (n,) are near an object, and the frame (6, m) of those.

    Frame: px along and across from the object's centre, its angle, its base (m), two random numbers (0 to 1).
    """
    lattice = ground.lattice
    along, lanes, shift, stray, length, width, *_, share, shape = item
    kind, _, angle, number = quarter
    angle, across = angle + salt * (shape == FOREST), STREET[kind] / lanes
    p, q = _turned(r, c, angle)
    i, j = np.floor(p / along).astype(int), np.floor(q / across - shift).astype(int)
    dice = [lattice[(i + number + 17 * n) & 255, (j + 29 * salt + 7 * n) & 255] for n in range(5)]
    p0, q0 = (i + 0.5) * along + (along / 2 - length) * dice[0], (j + 0.5 + shift) * across + stray * dice[1]
    near = (np.hypot(p - p0, q - q0) < np.hypot(length, width) + 1) & (dice[2] < 2 * share - 1)
    frame = np.stack([p - p0, q - q0, angle, 0 * p, dice[3] / 2 + 0.5, dice[4] / 2 + 0.5])[:, near]
    column, row = _turned(q0[near], p0[near], -frame[2])
    _, border, _, home = _quarter(lattice, row, column)
    frame[3] = _terrain(ground, row, column)
    free = (home == number[near]) & (border > 7 + length) & (frame[3] > 1)
    return np.flatnonzero(near)[free], frame[:, free]


def _draw(nodes: Array, frame: Array, item: Sequence[float]) -> Array:
    """Return height and albedo (2, m, OVER) of nodes (height, albedo, grain) and an object, whichever is higher."""
    *_, length, width, low, high, dark, bright, _, shape = item
    (p, q, angle, base, size, tone), (ground, _, grain) = frame[..., None], nodes
    sun_p, sun_q = _turned(np.array(SLOPE_LIGHT[1]), np.array(SLOPE_LIGHT[0]), angle)
    p = (p + FRACTIONS * np.cos(angle)) / (length * (0.7 + 0.3 * size))
    q = (q - FRACTIONS * np.sin(angle)) / (width * (0.7 + 0.3 * size))
    top, color = base + low + (high - low) * size**1.5, (dark + (bright - dark) * tone**2) * (1 + 0.1 * grain)
    inside = np.maximum(np.abs(p), np.abs(q)) < 1
    if shape == GABLE:
        top, color = top - 0.5 * PIXEL * width * np.abs(q), color * (1 - 0.5 * sun_q * np.sign(q))
    elif shape == ROOFTOP:
        top, inside = ground + low, inside & (ground > base + 4)
    elif shape != FLAT:
        bulge = 1 - p * p - q * q - 0.4 * grain  # a ragged crown
        inside, color = bulge > 0, color * np.maximum(1 + 0.5 * grain - 0.9 * (sun_p * p + sun_q * q), 0.2)
        top = base + (top - base) * np.sqrt(np.clip(bulge, 0, 1)) * (1 + 0.15 * grain)
    return np.where(inside & (top > ground), np.broadcast_arrays(top, color), nodes[:2])


def _quarter(lattice: Array, r: Array, c: Array) -> Arrays:
    """Return the quarter at some rows and columns: kind, px to its border, angle of its streets, number."""
    y = (0.9 * r + 0.44 * c) / QUARTER + 0.25 * _noise(lattice, r, c, 500, 2)
    x = (0.9 * c - 0.44 * r) / QUARTER + 0.25 * _noise(lattice, c, r, 500, 2)
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    border = QUARTER * (0.5 - np.maximum(np.abs(y - i - 0.5), np.abs(x - j - 0.5)))
    return PLAN[i & 3, j & 3], border, 1.5 * lattice[i & 255, j & 255], 137 * i + 1009 * j


def _turned(r: Array, c: Array, angle: Array) -> tuple[Array, Array]:
    """Return coordinates (px) along and across a direction."""
    return c * np.cos(angle) + r * np.sin(angle), r * np.cos(angle) - c * np.sin(angle)


def _terrain(ground: Ground, r: Array, c: Array) -> Array:
    """Return the height (m) of the ground: hills, a mountain if there is one, and 0 on a river through the image."""
    rise = np.clip((_from_river(ground.lattice, r, c) - BANK) / 150, 0, 1)
    hills = rise * (2 - rise) * np.maximum(7 + 5 * _noise(ground.lattice, r, c, 280, 4), 1)
    return np.asarray(hills + ground.height(r, c) if ground.relief else hills)


def _from_river(lattice: Array, r: Array, c: Array) -> Array:
    """Return the px to the middle of the river."""
    return np.asarray(np.abs(0.95 * r - 0.3 * c - 380 + 110 * _noise(lattice, r, c, 400, 3)))


def _noise(lattice: Array, r: Array, c: Array, spacing: float, octaves: int) -> Array:
    """Return smooth noise, about -1 to 1: lattice nodes `spacing` px apart, then finer and weaker octaves."""
    total = np.zeros(())
    for scale in 0.5 ** np.arange(octaves):
        y, x = r / (spacing * scale) + 31.7 / scale, c / (spacing * scale) + 17.1 / scale
        i, j = np.floor(y).astype(int), np.floor(x).astype(int)
        fy, fx = (f * f * (3 - 2 * f) for f in (y - i, x - j))
        i, j = i & 255, j & 255
        top = lattice[i, j] * (1 - fx) + lattice[i, j + 1] * fx
        bottom = lattice[i + 1, j] * (1 - fx) + lattice[i + 1, j + 1] * fx
        total = total + scale * (top + (bottom - top) * fy)
    return total
