"""Estimate the constant shift between heights at points and a surface of heights.

The shift has the least robust loss: the mean of ``min((d - median d)^2, cap^2)`` over differences ``d`` of height.
It counts relief and, in towns, walls; of what changed or was matched wrongly, only the share. The surface is moved by
whole cells only, so all shifts average its noise alike; a parabola through the losses finds fractions of a cell. Nuth
and Kaab (2011), as in xdem, solve the shift from slopes, which towns do not have.

The surface is cut into blocks. Differences within a block are correlated, so uncertainties come from what differs
between blocks, and a shift counts only where both halves of the blocks find it.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sat_intervals.kernels.relief import losses, sampled
from sat_intervals.tiling import Grid, Window

REACH = 48
"""Cells: largest shift that is searched; surfaces reach as far beyond the points."""
LEAST = 30
"""Points on known heights that an estimate needs."""
ACROSS, POINTS = 8, 8192
"""Blocks along each side of the ground, at most, and points of a block."""
# Largest side of a block in cells or pixels.
_LARGEST = 256
# Step of the first search in cells, on so many points; cells at the end of the reach that no shift may have.
_STEP, _SEARCHED, _END = 2, 16_000, 4
# Differences count up to so many standard deviations, which are so many cells at least.
_CAP, _FLOOR = 1.25, 2.0
# Losses are smoothed: between walls without noise they are pointed, and a parabola is drawn to whole cells.
_SMOOTH = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
# Cells around the best one whose losses are needed, and fewest blocks that give a deviation.
_AROUND, _LEAST_BLOCKS = 1 + len(_SMOOTH) // 2, 4
# Cells of standard deviation: a horizontal shift has less; what the parabola adds, which no block shows.
_UNSURE, _BETWEEN = 1.0, 0.01
# A shift is made from so many standard deviations on.
_CERTAIN = 2.0
# Makes a median of absolute values a standard deviation.
_NORMAL = 1.4826


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
    return min(_LARGEST, max(smallest, math.ceil(max(height, width) / ACROSS)))


def spread_blocks(region: Window, smallest: int) -> list[Window]:
    """Return blocks of a region, spread evenly, about `ACROSS` along each side."""
    grid = Grid(region, block_side(region.height, region.width, smallest))
    rows, columns = (range(0, count, max(1, math.ceil(count / ACROSS))) for count in (grid.rows, grid.columns))
    return [grid.tile(row, column).core for row in rows for column in columns]


def every_nth(count: int) -> slice:
    """Return which of the points of a block to take: `POINTS` at most."""
    return slice(None, None, max(1, math.ceil(count / POINTS)))


def part_of(surface: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return a surface, and columns, rows and heights of points on it, for `put_together`.

    The points are known heights of a block, ``(rows, columns)``; the surface has as many cells more on all sides.
    """
    row, column = np.nonzero(np.isfinite(height))
    chosen = every_nth(row.size)
    row, column, margin = row[chosen], column[chosen], (surface.shape[0] - height.shape[0]) / 2
    return surface, column + margin, row + margin, height[row, column]


def put_together(parts: Sequence[tuple[np.ndarray, ...]], cell: float, moves: int) -> Blocks | None:
    """Make blocks of surfaces, each with x, y and height of its points; None if no height of a surface is known."""
    parts = [part for part in parts if part[1].size and np.isfinite(part[0]).any()]
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
    place, across = _horizontal(blocks)
    if not (np.abs(place) > _CERTAIN * across).any():
        place = np.zeros(2)
    after = _differences(blocks, place)
    up, deviation = _vertical(blocks, after)
    leaked = [_median(_differences(blocks, place + move)) - up for move in np.diag(across) if np.isfinite(move).all()]
    deviation = float(np.linalg.norm([deviation, *leaked]))
    up = up if abs(up) > _CERTAIN * deviation else 0.0
    known = np.isfinite(before) & np.isfinite(after)
    shift, deviations = np.array([*place, up]), np.array([*across, deviation])
    is_horizontal = bool(np.isfinite(across).all())
    return Registration(shift, deviations, is_horizontal, int(known.sum()), before[known], after[known] - up)


def _differences(blocks: Blocks, shift: np.ndarray) -> np.ndarray:
    """Return differences at all points for a horizontal shift in metres."""
    east, north = blocks.moves * shift / blocks.cell
    height = sampled(blocks.surface, blocks.block, blocks.x - east, blocks.y + north)
    return np.asarray(blocks.moves * (blocks.height - height))


def _horizontal(blocks: Blocks) -> tuple[np.ndarray, np.ndarray]:
    """Return the horizontal shift in metres and its standard deviation: 0 and NaN where none can be determined."""
    place, agreed = _searched(blocks)
    for _ in range(REACH):
        sums, counts = _losses(blocks, place, np.arange(-_AROUND, _AROUND + 1))
        whole = _smoothed(_mean(sums.sum(axis=0), counts.sum(axis=0)))
        moves = np.subtract(np.unravel_index(whole.argmin(), whole.shape), 1)
        if not moves.any():
            break
        place = place + moves
    if not agreed or moves.any() or np.abs(place).max() > REACH - _END or len(sums) < _LEAST_BLOCKS:
        return np.zeros(2), np.full(2, np.nan)
    rest = _lowest(_smoothed(_mean(sums.sum(axis=0) - sums, counts.sum(axis=0) - counts)))
    # the jackknife; as of few blocks it is itself uncertain, the deviation of Student's distribution
    across = (len(rest) - 1) / np.sqrt(len(rest) - 3) * rest.std(axis=0)
    if not (across < _UNSURE).all():
        return np.zeros(2), np.full(2, np.nan)
    return blocks.moves * blocks.cell * (place + _lowest(whole)), blocks.cell * np.hypot(across, _BETWEEN)


def _searched(blocks: Blocks) -> tuple[np.ndarray, bool]:
    """Return the whole cells of the least loss, east and north; and whether both halves of the blocks find them."""
    every = slice(None, None, math.ceil(blocks.x.size / _SEARCHED))
    points = blocks.block, blocks.x, blocks.y, blocks.height
    block, x, y, height = (np.ascontiguousarray(part[every]) for part in points)
    thin = blocks._replace(block=block, x=x, y=y, height=height)
    steps = np.arange(-REACH, REACH + 1, _STEP)
    sums, counts = _losses(thin, np.zeros(2, np.int64), steps)
    parts = slice(0, None, 2), slice(1, None, 2), slice(None)
    means = [_mean(sums[part].sum(axis=0), counts[part].sum(axis=0)) for part in parts]
    places = np.array([steps[list(np.unravel_index(mean.argmin(), mean.shape))] for mean in means])
    return places[2], bool(np.ptp(places, axis=0).max() <= _STEP)


def _losses(blocks: Blocks, place: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sums of losses and numbers of points of blocks, ``(blocks, steps, steps)``, whole cells east and north."""
    differences = _differences(blocks, blocks.moves * blocks.cell * place)
    spread = _NORMAL * _median(np.abs(differences - _median(differences)))
    cap = _CAP * max(spread, _FLOOR * blocks.cell)
    points = blocks.block, blocks.x, blocks.y, blocks.height
    found: tuple[np.ndarray, np.ndarray] = losses(blocks.surface, *points, place[0] + steps, place[1] + steps, cap)
    return found


def _mean(sums: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return means, ``(..., east, north)``; infinite at shifts with less than half as many points as others."""
    enough = 2 * counts > counts.max(axis=(-2, -1), keepdims=True)
    return np.where(enough, sums / np.maximum(counts, 1), np.inf)


def _smoothed(mean: np.ndarray) -> np.ndarray:
    """Return losses, ``(..., 3, 3)``, smoothed from those of more cells around."""
    around = sliding_window_view(mean, (len(_SMOOTH),) * 2, axis=(-2, -1))
    return np.asarray(around @ _SMOOTH @ _SMOOTH)


def _lowest(mean: np.ndarray) -> np.ndarray:
    """Return where the parabolas through ``(..., 3, 3)`` losses are least, from the middle; NaN where nowhere."""
    mean = np.where(np.isfinite(mean).all(axis=(-2, -1), keepdims=True), mean, 0.0)
    lines = [[mean.take(at, axis).mean(axis=-1) for at in range(3)] for axis in (-2, -1)]
    east, north = ((last - first) / 2 for first, _, last in lines)
    bends = [first + last - 2 * middle for first, middle, last in lines]
    cross = (mean[..., 2, 2] + mean[..., 0, 0] - mean[..., 0, 2] - mean[..., 2, 0]) / 4
    bent = bends[0] * bends[1] - cross**2
    bent = np.where((bent > 0) & (bends[0] > 0), bent, np.nan)
    return np.stack([cross * north - bends[1] * east, cross * east - bends[0] * north], axis=-1) / bent[..., np.newaxis]


def _median(values: np.ndarray) -> float:
    """Return the median of the known values; NaN without."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else np.nan


def _vertical(blocks: Blocks, differences: np.ndarray) -> tuple[float, float]:
    """Return the median difference, and its standard deviation by what differs between blocks; infinite for one."""
    up = _median(differences)
    scale = max(_NORMAL * _median(np.abs(differences - up)), 1e-6)
    known = np.isfinite(differences)
    values = np.clip(differences[known] - up, -1.5 * scale, 1.5 * scale)
    sums, counts = (np.bincount(blocks.block[known], weights, len(blocks.surface)) for weights in (values, None))
    sums, counts = sums[counts > 0], counts[counts > 0]
    if len(counts) < 2:
        return up, np.inf
    mean = float(sums.sum() / counts.sum())
    spread = ((sums - mean * counts) ** 2).sum() * len(counts) / (len(counts) - 1)
    return up, 1.2 * (float(np.sqrt(spread)) / float(counts.sum()))


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
