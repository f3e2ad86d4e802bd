"""Costs of many images on the ground against a slow twin."""

import numpy as np
import pytest

from sat_intervals.kernels.plane_sweep import BITS, FINE, RADIUS, planes_of, sweep

STEPS = 10
PAIRS = np.array([[0, 1], [0, 2], [1, 2], [2, 3]])
ROWS, COLUMNS, HEIGHTS = 9, 11, 5


def keys(t):
    """Weights of the four pixels around a position ``t`` beyond the second one (Keys 1981)."""
    away = np.abs(np.arange(-1, 3) - t)
    return np.where(away <= 1, 1.5 * away**3 - 2.5 * away**2 + 1, -0.5 * away**3 + 2.5 * away**2 - 4 * away + 2)


def at(fine, down, across):
    i, j = int(np.floor(down)), int(np.floor(across))
    return keys(down - i) @ fine[i - 1 : i + 3, j - 1 : j + 3] @ keys(across - j)


def slow_words(fine, move):
    """Census words of the cells, booleans ``(rows, columns, bits)``, and whether all of a window is known."""
    side = 2 * RADIUS + 1
    grey = [
        [at(fine, move[0] + FINE * r, move[1] + FINE * c) for c in range(COLUMNS + side - 1)]
        for r in range(ROWS + side - 1)
    ]
    windows = np.lib.stride_tricks.sliding_window_view(np.array(grey), (side, side)).reshape(ROWS, COLUMNS, -1)
    centre = windows[..., BITS // 2 : BITS // 2 + 1]
    return np.delete(windows < centre, BITS // 2, axis=-1), np.isfinite(windows).all(axis=-1)


def slow_sweep(fines, moves, share):
    costs, seen = np.full((ROWS, COLUMNS, HEIGHTS), STEPS * BITS), []
    for h in range(HEIGHTS):
        words, usable = zip(*(slow_words(fine, move) for fine, move in zip(fines, moves[h], strict=True)), strict=True)
        seen.append(usable)
        for r, c in np.ndindex(ROWS, COLUMNS):
            pairs = [(a, b) for a, b in PAIRS if usable[a][r, c] and usable[b][r, c]]
            count = int(np.ceil(share * len(pairs)))
            lowest = sorted((words[a][r, c] != words[b][r, c]).sum() for a, b in pairs)[:count]
            if count:
                costs[r, c, h] = int(STEPS * sum(lowest) / count + 0.5)
    return costs, np.array(seen[HEIGHTS // 2])


def swept(fines, moves, share):
    sizes = np.array([np.array(fine.shape) // FINE for fine in fines])
    planes = [planes_of(fine).ravel() for fine in fines]
    starts = np.cumsum([0, *(plane.size for plane in planes[:-1])])
    costs, seen = np.zeros((ROWS, COLUMNS, HEIGHTS), np.uint8), np.full((len(fines), ROWS, COLUMNS), 9, np.uint8)
    sweep(np.concatenate(planes), starts, sizes, moves, PAIRS, share, STEPS, costs, seen)
    return costs, seen


def scene(seed):
    """Fine grids of four images of different sizes, two of them with gaps, and moves."""
    random = np.random.default_rng(seed)
    need = FINE * (np.array([ROWS, COLUMNS]) + 2 * RADIUS + 4)
    fines = [random.uniform(1, 1000, need + FINE * random.integers(0, 3, 2)).astype(np.float32) for _ in range(4)]
    fines[0][:, :9] = fines[3][12] = fines[2][20, 7] = np.nan
    return fines, random.uniform(1, 5, (HEIGHTS, 4, 2))


@pytest.mark.parametrize("share", [0.3, 0.5, 1.0])
def test_sweep__equals_a_slow_twin_without_votes_of_nan(share):
    fines, moves = scene(3)
    moves[1] = np.floor(moves[1])  # whole positions have a weight of 0: NaN is no vote there, too
    costs, seen = swept(fines, moves, share)
    expected, expected_seen = slow_sweep([fine.astype(float) for fine in fines], moves, share)
    np.testing.assert_array_equal(costs, expected)
    np.testing.assert_array_equal(seen, expected_seen)
    assert 0 < seen.mean() < 1
    assert (costs == STEPS * BITS).any()  # no pair
