"""Row offsets between two images: a polynomial of the place, resampling along columns, and least-squares shifts.

Letters: v, u row and column from the middle of the image, in halves of its longer side; t part of a
pixel. Between pixels values are cubic (Keys 1981, a = -1/2).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count, islice
from typing import Any

import numpy as np

from sat_intervals.kernels.compiled import cached, inlined

# Pixels that a cubic needs around a position, before and after it.
BEFORE, AFTER = 1, 2


@dataclass(frozen=True)
class RowOffsets:
    """Rows by which the right image lies lower, at rows of the left image and columns of the right one, of this size.

    ``coefficients`` are those of ``1, v, u, v^2, v u, u^2, v^3, ...``, in pixels.
    """

    coefficients: tuple[float, ...]
    rows: int
    columns: int

    @classmethod
    def of_report(cls, report: Mapping[str, Any]) -> "RowOffsets":
        """Read the mapping that `dataclasses.asdict` makes."""
        return cls(tuple(report["coefficients"]), report["rows"], report["columns"])

    def at(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return the offsets in pixels at rows of the left and columns of the right image; centres are integers."""
        v, u = self._scaled(row, column)
        return np.asarray(sum(k * term for k, term in zip(self.coefficients, _terms(v, u), strict=False)))

    def read(self, row: int, column: int, rows: int, columns: int) -> tuple[int, int, np.ndarray, np.ndarray]:
        """Return the first row and the number of rows that a window is made of, and the arguments of `shift_rows`."""
        offset = self.at(np.arange(row, row + rows)[:, np.newaxis], np.arange(column, column + columns))
        whole = np.broadcast_to(np.floor(offset), (rows, columns))
        first, last = int(whole.min()) - BEFORE, int(whole.max()) + AFTER
        # the part first: with `first` subtracted before, it would depend on the window in its last bits
        part = np.broadcast_to(offset - np.floor(offset), (rows, columns))
        return row + first, rows + last - first, (whole - first).astype(np.int64), part

    def _scaled(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        half = max(self.rows, self.columns) / 2
        return (row - (self.rows - 1) / 2) / half, (column - (self.columns - 1) / 2) / half

    def design(self, row: np.ndarray, column: np.ndarray, number: int) -> np.ndarray:
        """Return the first terms at places ``(n,)``: ``(n, number)``."""
        v, u = self._scaled(row, column)
        return np.stack(list(islice(_terms(v, u), number)), axis=-1)


def _terms(v: np.ndarray, u: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the terms of a polynomial, from the lowest degree."""
    return (v ** (degree - across) * u**across for degree in count() for across in range(degree + 1))


@inlined
def cubic_weights(t):
    """Weights of the four pixels around a position, and their derivatives; ``t`` is from the second one."""
    values = (
        ((-0.5 * t + 1) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1,
        ((-1.5 * t + 2) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )
    slopes = ((-1.5 * t + 2) * t - 0.5, (4.5 * t - 5) * t, (-4.5 * t + 4) * t + 0.5, (1.5 * t - 1) * t)
    return values, slopes


@cached
def shift_rows(pixels, state, whole, part):
    """Read an image at rows moved by an offset; a pixel is usable if the pixels that it is made of are.

    pixels, state: ``(rows + n, columns)``, float and uint8.
    whole, part: ``(rows, columns)`` int64 and float64: rows from the result's row to the position in ``pixels``, from
        BEFORE on, and part of a pixel beyond.
    Returns pixels of the same type and states ``(rows, columns)``; pixels are 0 where not usable.
    """
    rows, columns = whole.shape
    result, states = np.zeros((rows, columns), pixels.dtype), np.zeros((rows, columns), np.uint8)
    for r in range(rows):
        for c in range(columns):
            weights, _ = cubic_weights(part[r, c])
            value = 0.0
            for k in range(4):
                if weights[k] != 0:
                    value += weights[k] * pixels[r + whole[r, c] + k - BEFORE, c]
                    states[r, c] |= state[r + whole[r, c] + k - BEFORE, c]
            if states[r, c] == 0:
                result[r, c] = value
    return result, states


@cached
def shift_equations(left, right, disparity, known, offset, step, radius):
    """Normal equations of a fit of right values to left ones in windows: a gain, a constant, and a shift.

    ``left = gain (right + x right_c + y right_r) + constant``, where subscripts are derivatives along columns and rows.
    Each pixel is at its own disparity, so that slanted ground does not bend the fit (Gauss-Newton step of least-squares
    matching, Gruen 1985).

    left: ``(rows, columns)`` float64.
    right: float64 with 4 more rows and columns on all sides; ``right[r + 4, c + 4 + d]`` faces ``left[r, c]``.
    disparity, known: ``(rows, columns)``, pixels from 0 on, and which pixels are matched.
    offset: rows that right positions lie lower, between -2 and 2.
    step, radius: pixels between centres of windows, and from their centre to their sides.
    Returns ``(n, 4, 5)``: the matrix and the right side for gain, constant, gain x, gain y; and the pixels ``(n,)``.
    """
    rows, columns = disparity.shape
    values = np.zeros((rows, columns, 4))
    told = known.copy()
    for r in range(rows):
        for c in range(columns):
            if not known[r, c]:
                continue
            y, x = r + offset + 4, c + disparity[r, c] + 4
            i, j = int(np.floor(y)), int(np.floor(x))
            if i < 1 or j < 1 or i + 3 > right.shape[0] or j + 3 > right.shape[1]:
                told[r, c] = False
                continue
            (down, down_slope), (across, across_slope) = cubic_weights(y - i), cubic_weights(x - j)
            value = along_columns = along_rows = 0.0
            for a in range(4):
                line = slope = 0.0
                for b in range(4):
                    pixel = right[i - 1 + a, j - 1 + b]
                    line += across[b] * pixel
                    slope += across_slope[b] * pixel
                value += down[a] * line
                along_columns += down[a] * slope
                along_rows += down_slope[a] * line
            values[r, c, 0], values[r, c, 1] = value, 1.0  # a tuple in one go would take seconds longer to compile
            values[r, c, 2], values[r, c, 3] = along_columns, along_rows
    count = len(range(radius, rows - radius, step)) * len(range(radius, columns - radius, step))
    equations, pixels = np.zeros((count, 4, 5)), np.zeros(count)
    n = 0
    for r in range(radius, rows - radius, step):
        for c in range(radius, columns - radius, step):
            for i in range(r - radius, r + radius + 1):
                for j in range(c - radius, c + radius + 1):
                    if told[i, j]:
                        pixels[n] += 1
                        for p in range(4):
                            equations[n, p, 4] += values[i, j, p] * left[i, j]
                            for q in range(4):
                                equations[n, p, q] += values[i, j, p] * values[i, j, q]
            n += 1
    return equations, pixels
