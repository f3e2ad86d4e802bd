"""Resample an image at positions that a grid gives: linear between its nodes, cubic (Keys) between pixels; reduce it.

Letters: r row, c column of the result; i, j node; y, x part of the way to the next node; v, u position in the image.
"""

import math
from typing import NamedTuple

import numpy as np

from sat_intervals.kernels.compiled import cached, inlined
from sat_intervals.kernels.row_offsets import AFTER, BEFORE, cubic_weights


def reach(scale: float) -> tuple[int, int]:
    """Return the pixels that the result needs around a position, before and after it; see `resample_reduced`."""
    return (BEFORE, AFTER) if scale == 1 else (math.ceil(2 * scale) - 1, math.ceil(2 * scale))


@inlined
def _keys(distance):
    """Weight of a pixel at a distance from the position, in pixels."""
    d = abs(distance)
    return ((1.5 * d - 2.5) * d * d + 1 if d < 1 else ((-0.5 * d + 2.5) * d - 4) * d + 2) if d < 2 else 0.0


@inlined
def _line(nodes, y):
    """Positions of the nodes of a line of the result, y lines of nodes from the first."""
    i = int(y)
    return nodes[i] + (y - i) * (nodes[i + 1] - nodes[i])


@inlined
def _place(line, x):
    """Position in the image of a pixel of a line, x nodes from the first."""
    j = int(x)
    x -= j
    return line[j, 0] + x * (line[j + 1, 0] - line[j, 0]), line[j, 1] + x * (line[j + 1, 1] - line[j, 1])


@cached
def resample(pixels, origin, nodes, step, first, rows, columns):
    """Resample a window of an image.

    pixels: ``(height, width)`` float, NaN where not usable: all that is around the positions, see `reach`.
    origin: row and column of its first pixel in the image.
    nodes: ``(n, m, 2)`` float64: rows and columns in the image, pixel centres are integers; NaN where unknown.
    step: pixels of the result between nodes.
    first: row and column of the first pixel of the result, from the first node.
    rows, columns: size of the result.
    Returns ``(rows, columns)`` of the type of ``pixels``, NaN where a pixel around the position is not usable. A pixel
    is the same in any window.
    """
    result = np.empty((rows, columns), pixels.dtype)
    for r in range(rows):
        line = _line(nodes, (r + first[0]) / step)
        for c in range(columns):
            v, u = _place(line, (c + first[1]) / step)
            if np.isnan(v + u):
                result[r, c] = np.nan
                continue
            down, _ = cubic_weights(v - np.floor(v))
            across, _ = cubic_weights(u - np.floor(u))
            # numba tests signed indices for negative ones, which takes half of the time
            above = np.uint64(int(np.floor(v)) - BEFORE - origin[0])
            before = np.uint64(int(np.floor(u)) - BEFORE - origin[1])
            value = 0.0
            for a in range(4):
                around = pixels[above + np.uint64(a)]
                value += down[a] * (
                    across[0] * around[before]
                    + across[1] * around[before + np.uint64(1)]
                    + across[2] * around[before + np.uint64(2)]
                    + across[3] * around[before + np.uint64(3)]
                )
            result[r, c] = value
    return result


@cached
def resample_reduced(pixels, origin, nodes, step, first, rows, columns, scale):
    """Resample as `resample` does, with ``scale`` > 1 pixels of the image to one of the result."""
    # The cubic is as much wider, so that finer detail than that of the result leaves no pattern.
    result = np.empty((rows, columns), pixels.dtype)
    after = math.ceil(2 * scale)
    down, across = np.empty(2 * after), np.empty(2 * after)
    for r in range(rows):
        line = _line(nodes, (r + first[0]) / step)
        for c in range(columns):
            v, u = _place(line, (c + first[1]) / step)
            if np.isnan(v + u):
                result[r, c] = np.nan
                continue
            above, before = int(np.floor(v)) - after + 1, int(np.floor(u)) - after + 1
            for a in range(2 * after):
                down[a], across[a] = _keys((above + a - v) / scale), _keys((before + a - u) / scale)
            value = 0.0
            for a in range(2 * after):
                part = 0.0
                for b in range(2 * after):
                    part += across[b] * pixels[above + a - origin[0], before + b - origin[1]]
                value += down[a] * part
            result[r, c] = value / (down.sum() * across.sum())
    return result


class Step(NamedTuple):
    """Rows and columns of an image that a reduced pixel averages."""

    rows: int
    columns: int


def reduced(pixels: np.ndarray, state: np.ndarray, step: Step) -> np.ndarray:
    """Means of the usable pixels, state 0, of blocks of ``step`` pixels.

    pixels, state: ``(rows, columns)``; unusable pixels are 0. Rows and columns that fill no block are dropped.
    Returns float32, NaN where less than half of a block is usable.
    """
    sums, counts = pixels, (state == 0).astype(np.min_scalar_type(step.rows * step.columns))
    with np.errstate(over="ignore"):  # undeclared no data may be as large as a float32 can be
        for axis, size in enumerate(step):
            sums, counts = _added(sums, axis, size), _added(counts, axis, size)
    return np.where(counts >= step.rows * step.columns / 2, sums / np.maximum(counts, 1), np.nan).astype(np.float32)


def _added(array: np.ndarray, axis: int, size: int) -> np.ndarray:
    """Sums of ``size`` rows (axis 0) or columns (1); adding whole arrays is faster than a sum over an axis."""
    if size == 1:
        return array
    turned = array.swapaxes(0, axis)
    stop = len(turned) // size * size
    total = turned[:stop:size].copy(order="K")
    for first in range(1, size):
        total += turned[first:stop:size]
    return total.swapaxes(0, axis)
