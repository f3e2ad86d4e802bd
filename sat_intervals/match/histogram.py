"""Histograms of numbers, for medians and quantiles of any number of pixels."""

from math import floor, nan

import numpy as np

_BIAS, _LARGEST_BIAS = 1000, 1000  # steps a pixel, and pixels


def quantile(values: np.ndarray, counts: np.ndarray, share: float) -> float:
    """Quantile of values that occur ``counts`` times each, rounded as by `numpy.quantile`; NaN without values."""
    order = np.argsort(values, kind="stable")
    upto = np.cumsum(counts[order])
    if not upto.size or upto[-1] == 0:
        return nan
    rank = share * float(upto[-1] - 1)
    below = floor(rank)
    places = np.searchsorted(upto, [below, min(below + 1, int(upto[-1]) - 1)], side="right")
    low, high = (float(value) for value in values[order][places])
    part = rank - below
    return low + (high - low) * part if part < 0.5 else high - (high - low) * (1.0 - part)


class Histogram:
    """Counts of values from ``first`` to ``last``, ``steps`` per unit; values beyond are clipped."""

    def __init__(self, first: int, last: int, steps: int) -> None:
        self._first, self._steps = first, steps
        self._counts = np.zeros((last - first) * steps + 1, np.int64)
        self._ends = self._counts.size, 0  # of the part with counts: the whole takes long to look through

    def add(self, values: np.ndarray) -> None:
        """Count values; none may be NaN."""
        places = np.rint((values - self._first) * self._steps)
        places = np.clip(places, 0, self._counts.size - 1).astype(np.int64)
        if places.size:
            least = int(places.min())
            counts = np.bincount(places - least)
            self._counts[least : least + counts.size] += counts
            self._ends = min(self._ends[0], least), max(self._ends[1], least + counts.size)

    def _present(self) -> tuple[np.ndarray, np.ndarray]:
        """Values that occur, ascending, and their counts."""
        places = self._ends[0] + np.flatnonzero(self._counts[slice(*self._ends)])
        return self._first + places / self._steps, self._counts[places]

    def median(self) -> float | None:
        """Return the median (the mean of both middle values of an even number); None without values."""
        return self.quantile(0.5)

    def quantile(self, share: float) -> float | None:
        """Return a quantile, linear between values; None without values."""
        values, counts = self._present()
        return quantile(values, counts, share) if values.size else None

    def quantile_of_absolutes(self, share: float) -> float | None:
        """Return a quantile of the absolute values, linear between values; None without values."""
        values, counts = self._present()
        return quantile(np.abs(values), counts, share) if values.size else None

    def deviation(self) -> float | None:
        """Return the median absolute deviation from the median, the lower of two middle ones; None without values."""
        median, (values, counts) = self.median(), self._present()
        if median is None:
            return None
        number = counts.sum()
        share = (number - 1) // 2 / max(1, number - 1)  # of the lower
        return quantile(np.abs(values - median), counts, share)


def bias_histogram() -> Histogram:
    """Return an empty histogram for differences of disparity and truth: steps of 0.001 px within 1000 px."""
    return Histogram(-_LARGEST_BIAS, _LARGEST_BIAS, _BIAS)
