"""Winners and intervals from a whole aggregated volume (METHOD.md, sections 4 to 6 and 10).

A run stores no finished volume: it reads each curve while it is in the cache (`matching`). These functions compare
several methods on one volume in memory, ``(rows, columns, count)`` uint16, IMPOSSIBLE_COST at impossible candidates.
They work row by row, because their temporary arrays are as large as the costs.

Letters: r row, c column, k disparity index (disparity = minimum + k).
"""

import numpy as np

from sat_intervals.products import IMPOSSIBLE_COST, NO_DISPARITY


def read_winners(
    volume: np.ndarray, minimum: int, weights: np.ndarray, refine: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Winner, refined disparity and ambiguity of every curve.

    ``weights`` is the table of `ambiguity`; ``refine`` turns V-fit on. Returns ``(rows, columns)`` arrays: int16
    winners, NO_DISPARITY for none; float32 disparities in pixels, NaN for none; uint32 ambiguities.
    """
    winner = np.full(volume.shape[:2], NO_DISPARITY, np.int16)
    disparity = np.full(winner.shape, np.nan, np.float32)
    ambiguity = np.zeros(winner.shape, np.uint32)
    for r, row in enumerate(volume):
        k = row.argmin(axis=1)
        lowest = np.take_along_axis(row, k[:, np.newaxis], axis=1)
        found = lowest[:, 0] != IMPOSSIBLE_COST
        winner[r, found] = minimum + k[found]
        disparity[r, found] = (minimum + k + (_vfit(row, k) if refine else 0))[found]
        if weights.size:
            above = np.where(row == IMPOSSIBLE_COST, 0, row - lowest)
            ambiguity[r, found] = weights.take(above).sum(axis=1, dtype=np.uint32)[found]
    return winner, disparity, ambiguity


def _vfit(curves: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Sub-pixel shifts of winners, as by `disparity.vfit`."""
    pixels, last = np.arange(k.size), curves.shape[1] - 1
    before, here, after = (curves[pixels, np.clip(k + step, 0, last)].astype(np.int64) for step in (-1, 0, 1))
    steepest = np.maximum(before, after)
    possible = (k > 0) & (k < last) & (steepest != IMPOSSIBLE_COST)
    return np.divide(before - after, 2 * (steepest - here), out=np.zeros(k.size), where=possible)


def read_right_winners(volume: np.ndarray, minimum: int) -> np.ndarray:
    """The right view's winners along the diagonals of the left volume; the largest disparity at ties.

    Returns ``(rows, columns + count - 1)`` int16 as `cross_check` takes it.
    """
    rows, columns, count = volume.shape
    width = columns + count - 1
    winner = np.full((rows, width), NO_DISPARITY, np.int16)
    for r in range(rows):
        # Each line is one longer than the right image: read as lines of its width, each begins one column later.
        sheared = np.full((count, width + 1), IMPOSSIBLE_COST, np.uint16)
        sheared[:, :columns] = volume[r].T
        facing = sheared.ravel()[: count * width].reshape(count, width)[::-1]
        found = (facing != IMPOSSIBLE_COST).any(axis=0)
        winner[r, found] = minimum + count - 1 - facing.argmin(axis=0)[found]
    return winner


def read_alpha_cuts(volume: np.ndarray, minimum: int, cut_level: int, refine: bool) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the alpha-cut of every curve (paper eq. 5 to 9), extended for refinement.

    Returns ``(lower, upper)``, ``(rows, columns)`` int16 disparities, NO_DISPARITY for none; ``cut_level`` is
    ``floor((1 - alpha) * span)``.
    """
    lower = np.full(volume.shape[:2], NO_DISPARITY, np.int16)
    upper = lower.copy()
    last = volume.shape[2] - 1
    for r, row in enumerate(volume):
        lowest = row.min(axis=1, keepdims=True).astype(np.int64)
        found = lowest[:, 0] != IMPOSSIBLE_COST
        inside = row <= np.minimum(lowest + cut_level, IMPOSSIBLE_COST - 1).astype(np.uint16)
        if refine:
            winners = row == lowest.astype(np.uint16)
            inside[:, :-1] |= winners[:, 1:]
            inside[:, 1:] |= winners[:, :-1]
        lower[r, found] = (minimum + inside.argmax(axis=1))[found]
        upper[r, found] = (minimum + last - inside[:, ::-1].argmax(axis=1))[found]
    return lower, upper


def read_subpixel_cut(
    curve: np.ndarray, minimum: int, level: float, steps: int, disparity: float
) -> tuple[float, float]:
    """Bounds in pixels of the cut of one curve at a level above its lowest cost (METHOD.md, section 16).

    ``curve`` is ``(count,)``; bounds are rounded outwards to ``1 / steps`` px and contain ``disparity``.
    """
    costs = np.where(curve == IMPOSSIBLE_COST, np.inf, curve.astype(np.float64))
    limit = costs.min() + level
    inside = np.flatnonzero(costs <= limit)
    ends = []
    for k, step in ((inside[0], -1), (inside[-1], 1)):
        is_cut = 0 <= k + step < costs.size and np.isfinite(costs[k + step])
        share = (limit - costs[k]) / (costs[k + step] - costs[k]) if is_cut else 0.0
        ends.append(k * steps + step * np.ceil(steps * share))
    winner = steps * (disparity - minimum)
    lower, upper = min(ends[0], np.floor(winner)), max(ends[1], np.ceil(winner))
    return float(minimum + lower / steps), float(minimum + upper / steps)
