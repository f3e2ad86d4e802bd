"""Margins that make intervals reach a coverage: split-conformal prediction by class (Vovk et al. 2005)."""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

AROUND = 2
"""Cells on each side of a cell whose heights make its relief."""


class Margins(NamedTuple):
    """Margins in metres of classes of relief, and in each of them of half width.

    relief: ``(classes - 1,)`` limits.
    half_widths, margins: of each class of relief limits ``(n - 1,)`` and margins ``(n,)``.
    factor: half widths are multiplied by it first.
    """

    relief: np.ndarray
    half_widths: tuple[np.ndarray, ...]
    margins: tuple[np.ndarray, ...]
    factor: float = 1.0

    @classmethod
    def of_factor(cls, factor: float) -> "Margins":
        """Return the margins of one class, which is widened by a factor alone."""
        return cls(np.empty(0), (np.empty(0),), (np.zeros(1),), factor)

    def of(self, half_width: np.ndarray, relief: np.ndarray) -> np.ndarray:
        """Return the margin of each cell; any shape."""
        kinds, found = np.searchsorted(self.relief, relief, side="right"), np.empty(half_width.shape)
        for kind, (limits, margins) in enumerate(zip(self.half_widths, self.margins, strict=True)):
            own = kinds == kind
            found[own] = margins[np.searchsorted(limits, half_width[own], side="right")]
        return found + (self.factor - 1) * half_width

    def widened(
        self, height: np.ndarray, lower: np.ndarray, upper: np.ndarray, relief: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds, moved by the margins of their cells and rounded outwards to float32; any shape."""
        ends = (end.astype(np.float64) for end in (height, lower, upper))
        height, lower, upper = ends
        lower, upper = widened(height, lower, upper, self.of((upper - lower) / 2, relief))
        return outwards(lower, -np.inf), outwards(upper, np.inf)


def relief_of(height: np.ndarray) -> np.ndarray:
    """Return the range of the known heights in 5 x 5 cells around each: ``(rows, columns)``, NaN without any."""
    return highest_around(height, AROUND) + highest_around(-height, AROUND)


def highest_around(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the highest known value up to ``reach`` cells around each: ``(rows, columns)`` floats, NaN without any."""
    for axis in (0, 1):
        padded = np.pad(values, [(reach, reach) if axis == one else (0, 0) for one in (0, 1)], constant_values=np.nan)
        values = np.fmax.reduce(sliding_window_view(padded, 2 * reach + 1, axis), axis=-1)
    return values


def least_number(coverage: float, misses: int = 10) -> int:
    """Return the number of values that a margin of a class needs, for so many misses; 30 at least."""
    return int(np.ceil(max(30, misses / (1 - coverage)) - 1e-9))


def limits_between(values: np.ndarray, most: int, least: float) -> np.ndarray:
    """Return limits of at most so many classes of values: about as many in each, at least ``least``."""
    for count in range(most, 1, -1):
        # between centimetres, so that rounding does not part equal values
        limits = np.unique(np.round(np.round(np.quantile(values, np.arange(1, count) / count), 2) + 0.005, 3))
        limits = limits[limits < values.max()]
        if np.bincount(np.searchsorted(limits, values, side="right"), minlength=limits.size + 1).min() >= least:
            return np.asarray(limits)
    return np.empty(0)


def margin_of(scores: np.ndarray, coverage: float) -> float:
    """Return the margin with which a share of the truths is inside, once both bounds are moved outwards by it.

    scores: ``(n,)``: how far a truth is outside its interval, negative inside: ``max(lower - truth, truth - upper)``.
    """
    rank = int(np.ceil((scores.size + 1) * coverage - 1e-9)) - 1
    return float(np.partition(scores, rank)[rank])


def widened(
    height: np.ndarray, lower: np.ndarray, upper: np.ndarray, margin: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Move both bounds outwards by margins, or inwards by negative ones, never past the height; any shape."""
    return np.minimum(lower - margin, height), np.maximum(upper + margin, height)


def outwards(bound: np.ndarray, end: float) -> np.ndarray:
    """Round a bound to float32, towards ``end``."""
    single = bound.astype(np.float32)
    inside = single > bound if end < 0 else single < bound
    return np.where(inside, np.nextafter(single, np.float32(end)), single)
