"""Estimate the constant shift between heights at points and a surface of heights.

The shift is that of Nuth and Kaab (2011), easting, northing and height. A place near it is found by a search in ever
smaller steps for the least mean clipped difference, since in towns the horizontal part shows at walls only; from there
it is solved from slopes. xdem registers whole rasters in memory, and states no uncertainty.

The surface is cut into blocks. Differences within a block are correlated, so uncertainties come from what differs
between blocks.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.kernels.relief import interpolated, sampled, slopes
from sat_intervals.tiling import Grid, Window

REACH = 48
"""Cells: largest shift that is searched; surfaces reach as far beyond the points."""
LEAST = 30
"""Points on known heights that an estimate needs."""
ACROSS, POINTS = 8, 1000
"""Blocks along each side of the ground, about, and points of a block."""
# Largest side of a block in cells or pixels.
_LARGEST = 256
# Steps of the search in cells: on some points, then on all.
_COARSE, _FINE = (4.0, 2.0, 1.0), (0.5, 0.2, 0.1, 0.05, 0.02)
_SEARCHED, _LEAST_BLOCKS = 8_000, 4
# Differences count up to this many standard deviations, and those to this many cells at least.
_CLIP, _FLOOR = 3.0, 1.0
# Cells of the shift that must raise the loss: by so many cells, and by so many standard errors.
_PROBE, _LEAST_RISE, _CLEARLY = 4.0, 0.02, 3.0
# A shift is made from so many standard deviations on.
_CERTAIN = 2.0
# Makes a median of absolute values a standard deviation.
_NORMAL = 1.4826
# Cells to either side that slopes are taken from, and whether walls count, in the order of trial: the noise of slopes
# over 6 or 4 cells is not that of the narrow ones, also if it is as wide as three cells; houses may be narrower.
_NARROW, _WIDE, _SOLVED = 1, ((6, False), (4, False), (6, True), (4, True), (2, True)), 10
# Cells of standard deviation: the first solution below is taken; interpolation between cells adds, and no spread shows.
_SURE, _BETWEEN = 0.3, 0.01
_DIRECTIONS = np.array([[1.0, 0.0], [0.0, 1.0], [0.7071, 0.7071], [0.7071, -0.7071]])


class Blocks(NamedTuple):
    """Heights at points, and surfaces of blocks of the ground.

    surface: ``(blocks, rows, columns)`` heights, NaN where unknown; north up.
    cell: side of a cell in metres.
    block, x, y: ``(n,)``: the block of each point, and its column and row there; cell centres are integers.
    height: ``(n,)`` metres.
    moves: +1 if the surface is to be moved, -1 if the points are.
    """

    surface: np.ndarray
    cell: float
    block: np.ndarray
    x: np.ndarray
    y: np.ndarray
    height: np.ndarray
    moves: int


def block_side(height: int, width: int, smallest: int) -> int:
    """Return the side of blocks of a region of so many rows and columns."""
    return min(_LARGEST, max(smallest, min(height, width) // ACROSS))


def spread_blocks(region: Window, smallest: int) -> list[Window]:
    """Return blocks of a region, spread evenly, about `ACROSS` along each side."""
    grid = Grid(region, block_side(region.height, region.width, smallest))
    rows, columns = (range(0, count, max(1, math.ceil(count / ACROSS))) for count in (grid.rows, grid.columns))
    return [grid.tile(row, column).core for row in rows for column in columns]


def every_nth(count: int) -> slice:
    """Return which of the points of a block to take: `POINTS` at most."""
    return slice(None, None, max(1, math.ceil(count / POINTS)))


def put_together(parts: Sequence[tuple[np.ndarray, ...]], cell: float, moves: int) -> Blocks | None:
    """Make blocks of surfaces, each with x, y and height of its points; None if no height of a surface is known."""
    parts = [part for part in parts if np.isfinite(part[0]).any()]
    if not parts:
        return None
    surfaces = [part[0] for part in parts]
    whole = np.full((len(parts), *np.max([surface.shape for surface in surfaces], axis=0)), np.nan, np.float32)
    for filled, surface in zip(whole, surfaces, strict=True):
        filled[: surface.shape[0], : surface.shape[1]] = surface
    block = np.repeat(np.arange(len(parts)), [part[1].size for part in parts])
    x, y, height = (np.concatenate([part[index] for part in parts]) for index in (1, 2, 3))
    return Blocks(whole, cell, block, x, y, height, moves)


class Registration(NamedTuple):
    """A shift in metres, easting, northing and height, to be added to what moves.

    shift, deviation: ``(3,)``, with the standard deviation; a shift of less than two of them is 0. Without a horizontal
        part, 0 with deviation NaN.
    used: number of points used.
    before, after: differences of what stands still - what moves, of the same points, without and with the shift.
    """

    shift: np.ndarray
    deviation: np.ndarray
    is_horizontal: bool
    used: int
    before: np.ndarray
    after: np.ndarray

    def report(self) -> dict[str, Any]:
        """Return plain values, None for a deviation that is unknown; `summary` of differences before and after."""
        return {
            "shift": self.shift.tolist(),
            "deviation": [float(value) if np.isfinite(value) else None for value in self.deviation],
            "is_horizontal": self.is_horizontal,
            "used": self.used,
            "before": summary(self.before),
            "after": summary(self.after),
        }


def register(blocks: Blocks | None) -> Registration | None:
    """Estimate the shift; None with fewer than `LEAST` points on known heights."""
    if blocks is None:
        return None
    before = _differences(blocks, np.zeros(2))
    if np.isfinite(before).sum() < LEAST:
        return None
    place = _searched(blocks)
    found = None if place is None else _with_deviation(blocks, place)
    if found is None:
        found = _vertical(blocks, before)
    shift, deviation = found
    if (np.abs(shift[:2]) <= _CERTAIN * deviation[:2]).all():
        shift = np.array([0.0, 0.0, _median(before)])
    if abs(shift[2]) <= _CERTAIN * deviation[2]:
        shift[2] = 0.0
    after = _differences(blocks, shift[:2])
    known = np.isfinite(before) & np.isfinite(after)
    is_horizontal = bool(np.isfinite(deviation[0]))
    return Registration(shift, deviation, is_horizontal, int(known.sum()), before[known], after[known] - shift[2])


def _differences(blocks: Blocks, shift: np.ndarray) -> np.ndarray:
    """Return differences at all points for a horizontal shift in metres."""
    east, north = blocks.moves * shift / blocks.cell
    height = sampled(blocks.surface, blocks.block, blocks.x - east, blocks.y + north)
    return np.asarray(blocks.moves * (blocks.height - height))


def _solved(
    blocks: Blocks, place: np.ndarray, most: float, wide: int, *, walls: bool
) -> tuple[np.ndarray, np.ndarray] | None:
    """Solve the horizontal shift from slopes (Nuth and Kaab 2011), from a place near it; also its standard deviation.

    Wide slopes weigh the equations: the noise of the cells that heights are interpolated from is not in them, else it
    would count as slopes of the ground and draw the shift to whole cells. With ``walls``, all cells count that may be
    walls moved by a cell: between cells, they count in proportion to the shift. Without, only ground that is about
    plane: surfaces of stereo have walls that are moved to one side. None if there is no solution near the place.
    """
    start = place
    for _ in range(_SOLVED):
        east, north = blocks.moves * place / blocks.cell
        at = blocks.surface, blocks.block, blocks.x - east, blocks.y + north
        height, lowest, highest, bend = interpolated(*at).T
        differences = blocks.moves * (blocks.height - height)
        differences -= _median(differences)
        weights, design = (slopes(*at, reach)[:, ::-1] * (-1.0, 1.0) / blocks.cell for reach in (wide, _NARROW))
        if walls:
            expected = height + blocks.moves * differences
            used = (expected >= lowest - most) & (expected <= highest + most)
        else:
            used = (bend <= most) & (np.abs(differences) <= most)
        used &= np.isfinite(weights + design).all(axis=1)
        if used.sum() < LEAST:
            return None
        weights, design, differences, block = weights[used], design[used], differences[used], blocks.block[used]
        weights, design, differences = (values - values.mean(axis=0) for values in (weights, design, differences))
        matrix = weights.T @ design
        if not np.linalg.eigvalsh(matrix + matrix.T)[0] > 0:
            return None
        move = np.linalg.solve(matrix, weights.T @ differences)
        if np.abs(place + move - start).max() > 3 * blocks.cell:
            return None
        place = place + move
    return place, _left_out(block, weights, design, differences)


def _left_out(block: np.ndarray, weights: np.ndarray, design: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the solution, from solutions without one block each (the jackknife).

    Infinite where too few blocks are left, or one decides alone.
    """
    numbers, block = np.unique(block, return_inverse=True)
    matrices, sums = np.zeros((len(numbers), 2, 2)), np.zeros((len(numbers), 2))
    np.add.at(matrices, block, weights[:, :, np.newaxis] * design[:, np.newaxis])
    np.add.at(sums, block, weights * values[:, np.newaxis])
    rest = matrices.sum(axis=0) - matrices
    if len(numbers) < _LEAST_BLOCKS or not (np.linalg.eigvalsh(rest + rest.transpose(0, 2, 1)) > 0).all():
        return np.full(2, np.inf)
    moves = np.linalg.solve(rest, (sums.sum(axis=0) - sums)[:, :, np.newaxis])[:, :, 0]
    return np.asarray(np.sqrt(len(moves) - 1) * moves.std(axis=0))


def _thinned(blocks: Blocks) -> Blocks:
    every = slice(None, None, max(1, blocks.x.size // _SEARCHED))
    thin = [np.ascontiguousarray(values[every]) for values in (blocks.block, blocks.x, blocks.y, blocks.height)]
    return blocks._replace(block=thin[0], x=thin[1], y=thin[2], height=thin[3])


def _clipped(blocks: Blocks, shift: np.ndarray, most: float) -> np.ndarray:
    """Return distances of differences from their median, up to ``most``; NaN where unknown."""
    differences = _differences(blocks, shift)
    return np.minimum(np.abs(differences - _median(differences)), most)


def _median(values: np.ndarray) -> float:
    """Return the median of the known values; NaN without."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else np.nan


def _spread(blocks: Blocks, shift: np.ndarray) -> float:
    """Return the NMAD of differences."""
    return _NORMAL * _median(_clipped(blocks, shift, np.inf))


def _most(blocks: Blocks, shift: np.ndarray) -> float:
    """Return the distance from the median up to which differences count."""
    return _CLIP * max(_spread(blocks, shift), _FLOOR * blocks.cell)


def _searched(blocks: Blocks) -> np.ndarray | None:
    """Return the horizontal shift with the least mean clipped difference; None if it is at the end of the reach."""
    thin, place = _thinned(blocks), np.zeros(2)
    enough = 0.5 * np.isfinite(_differences(thin, place)).sum()
    reach = float(REACH)
    for step in (*_COARSE, *_FINE):
        sample = thin if step in _COARSE else blocks
        most = _most(sample, place)
        steps = np.arange(-reach, reach + step / 2, step) * blocks.cell
        losses = {}
        for move in sorted(((x, y) for x in steps for y in steps), key=lambda move: np.hypot(*move)):
            clipped = _clipped(sample, place + move, most)
            if np.isfinite(clipped).sum() > (enough if sample is thin else 0):
                losses[move] = float(np.nanmean(clipped))
        place = place + min(losses, key=lambda move: losses[move])
        reach = 2 * step
    return None if np.abs(place).max() >= (REACH - _COARSE[0]) * blocks.cell else place


def _with_deviation(blocks: Blocks, place: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the whole shift and its standard deviation; None if shifts further on do not fit clearly worse.

    Noise has slopes too, but no place where they fit.
    """
    most, step = _most(blocks, place), _PROBE * blocks.cell
    here = _clipped(blocks, place, most)
    sides = [[_clipped(blocks, place + side * step * way, most) for side in (-1, 1)] for way in _DIRECTIONS]
    for before, after in sides:
        rise, error = _mean_of_blocks(blocks, before + after - 2 * here)
        if not rise > max(_CLEARLY * error, _LEAST_RISE * blocks.cell):
            return None
    outlier = _CLIP * _spread(blocks, place)
    tried = (_solved(blocks, place, outlier, wide, walls=walls) for wide, walls in _WIDE)
    solved = next((found for found in tried if found is not None and found[1].max() < _SURE * blocks.cell), None)
    if solved is None:
        return None
    place, across = solved[0], np.hypot(solved[1], _BETWEEN * blocks.cell)
    up, deviation = _vertical(blocks, _differences(blocks, place))
    leaked = [_median(_differences(blocks, place + move)) - up[2] for move in np.diag(across)]
    return np.array([*place, up[2]]), np.array([*across, np.linalg.norm([deviation[2], *leaked])])


def _mean_of_blocks(blocks: Blocks, values: np.ndarray) -> tuple[float, float]:
    """Return the mean over points and its standard error, from what differs between blocks; NaN without points."""
    known = np.isfinite(values)
    if not known.any():
        return np.nan, np.inf
    sums, counts = (np.bincount(blocks.block[known], weights, len(blocks.surface)) for weights in (values[known], None))
    sums, counts = sums[counts > 0], counts[counts > 0]
    mean = float(sums.sum() / counts.sum())
    if len(counts) < 2:
        return mean, np.inf
    spread = ((sums - mean * counts) ** 2).sum() * len(counts) / (len(counts) - 1)
    return mean, float(np.sqrt(spread)) / float(counts.sum())


def _vertical(blocks: Blocks, differences: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the median difference as shift, with its standard deviation."""
    known = np.isfinite(differences)
    up = float(np.median(differences[known]))
    far = np.abs(differences - up)
    scale = max(_NORMAL * float(np.median(far[known])), 1e-6)
    _, error = _mean_of_blocks(blocks, np.clip(differences - up, -1.5 * scale, 1.5 * scale))
    return np.array([0.0, 0.0, up]), np.array([np.nan, np.nan, 1.2 * error])


def summary(differences: np.ndarray) -> dict[str, float]:
    """Return ``count``, ``bias`` (mean), ``median``, ``nmad``, ``rmse`` and ``le90`` (90 % of the absolute values)."""
    median = float(np.median(differences))
    return {
        "count": differences.size,
        "bias": float(np.mean(differences)),
        "median": median,
        "nmad": _NORMAL * float(np.median(np.abs(differences - median))),
        "rmse": float(np.sqrt(np.mean(np.square(differences)))),
        "le90": float(np.percentile(np.abs(differences), 90)),
    }
