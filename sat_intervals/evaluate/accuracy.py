"""Figures of merit of heights and their intervals against a reference, gathered part by part.

Quantiles come from histograms with steps of 1 mm (errors) and 1 cm (widths). LE90 is one-sided, the value that 90 % of
the absolute errors do not exceed (STANAG 2215, ISO 19157). The distance between the percentiles 5 and 95, which others
call LE90 too, has its own name.
"""

from typing import Any, NamedTuple

import numpy as np

from sat_intervals.match.histogram import Histogram

# Errors and widths are counted up to this many metres.
LARGEST = 500
# Factor of the NMAD, a robust standard deviation: sigma of a normal distribution (Hoehle and Hoehle 2009).
_NORMAL = 1.4826


class Errors(NamedTuple):
    """Errors (height - reference), interval widths, and distances of a missed reference from the interval, in metres.

    Widths and distances are NaN without an interval.
    """

    error: np.ndarray
    width: np.ndarray
    missed: np.ndarray

    def of(self, chosen: np.ndarray) -> "Errors":
        """Return a part."""
        return Errors(*(values[chosen] for values in self))


class Accuracy:
    """Figures of a class of cells; ``nominal`` is the coverage that intervals are to reach, None if unknown."""

    def __init__(self, nominal: float | None) -> None:
        self._nominal = nominal
        self._count = self._bounded = self._inside = 0
        self._sum = self._squares = self._width = self._missed = 0.0
        self._errors, self._widths = Histogram(-LARGEST, LARGEST, 1000), Histogram(0, LARGEST, 100)

    def add(self, errors: Errors) -> None:
        """Add cells."""
        self._count += errors.error.size
        self._sum += float(errors.error.sum())
        self._squares += float(np.square(errors.error).sum())
        self._errors.add(errors.error)
        bounded = errors.of(np.isfinite(errors.width))
        self._bounded += bounded.error.size
        self._inside += int((bounded.missed == 0).sum())
        self._width += float(bounded.width.sum())
        self._missed += float(bounded.missed.sum())
        self._widths.add(bounded.width)

    def report(self) -> dict[str, Any]:
        """Return all figures, None without cells: metres, and shares of cells with an interval."""
        deviation, low, high = self._errors.deviation(), self._errors.quantile(0.05), self._errors.quantile(0.95)
        median = self._widths.median()
        is_scored = self._nominal is not None and self._nominal < 1
        return {
            "count": self._count,
            "bias": _mean(self._sum, self._count),
            "median": self._errors.median(),
            "nmad": None if deviation is None else _NORMAL * deviation,
            "rmse": None if not self._count else float(np.sqrt(self._squares / self._count)),
            "le90": self._errors.quantile_of_absolutes(0.9),
            "p95_p5": None if low is None or high is None else high - low,
            "with_interval": self._bounded,
            "coverage": _mean(self._inside, self._bounded),
            "mean_half_width": _mean(self._width / 2, self._bounded),
            "median_half_width": None if median is None else median / 2,
            "interval_score": _mean(self._width + 2 / (1 - self._nominal) * self._missed, self._bounded)
            if is_scored and self._nominal is not None
            else None,
            "needed_half_width": None if self._nominal is None else self._errors.quantile_of_absolutes(self._nominal),
        }


def _mean(total: float, count: int) -> float | None:
    return total / count if count else None
