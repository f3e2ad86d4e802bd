"""Histograms of numbers, for medians of any number of pixels."""

import numpy as np

_BIAS, _LARGEST_BIAS = 1000, 1000  # steps a pixel, and pixels


class Histogram:
    """Counts of values from ``first`` to ``last``, ``steps`` per unit; values beyond are clipped."""

    def __init__(self, first: int, last: int, steps: int) -> None:
        self._first, self._steps = first, steps
        self._counts = np.zeros((last - first) * steps + 1, np.int64)

    def add(self, values: np.ndarray) -> None:
        """Count values; none may be NaN."""
        places = np.rint((values - self._first) * self._steps)
        places = np.clip(places, 0, self._counts.size - 1).astype(np.int64)
        if places.size:
            least = int(places.min())
            counts = np.bincount(places - least)
            self._counts[least : least + counts.size] += counts

    def median(self) -> float | None:
        """Return the median (the mean of both middle values of an even number); None without values."""
        upto = np.cumsum(self._counts)
        if upto[-1] == 0:
            return None
        middle = np.searchsorted(upto, [(upto[-1] - 1) // 2, upto[-1] // 2], side="right")
        return float(self._first + middle.sum() / (2 * self._steps))

    def quantile(self, share: float) -> float | None:
        """Return a quantile, linear between values; None without values."""
        present = np.flatnonzero(self._counts)
        return _quantile(self._first + present / self._steps, self._counts[present], share)

    def quantile_of_absolutes(self, share: float) -> float | None:
        """Return a quantile of the absolute values, linear between values; None without values."""
        present = np.flatnonzero(self._counts)
        values = np.abs(self._first + present / self._steps)
        order = np.argsort(values, kind="stable")
        return _quantile(values[order], self._counts[present][order], share)

    def deviation(self) -> float | None:
        """Return the median absolute deviation from the median; None without values."""
        median = self.median()
        if median is None:
            return None
        present = np.flatnonzero(self._counts)
        distance = np.abs(self._first + present / self._steps - median)
        nearest_first = np.argsort(distance, kind="stable")
        upto = np.cumsum(self._counts[present][nearest_first])
        return float(distance[nearest_first[np.searchsorted(upto, (upto[-1] - 1) // 2, side="right")]])


def _quantile(values: np.ndarray, counts: np.ndarray, share: float) -> float | None:
    """Return a quantile of sorted values that occur several times, as `numpy.quantile`."""
    upto = np.cumsum(counts)
    if not upto.size:
        return None
    place = share * (upto[-1] - 1)
    low, high = values[np.searchsorted(upto, [np.floor(place), np.ceil(place)], side="right")]
    return float(low + (place - np.floor(place)) * (high - low))


def bias_histogram() -> Histogram:
    """Return an empty histogram for differences of disparity and truth: steps of 0.001 px within 1000 px."""
    return Histogram(-_LARGEST_BIAS, _LARGEST_BIAS, _BIAS)
