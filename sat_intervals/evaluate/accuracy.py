"""Figures of merit of heights and their intervals against a reference, gathered part by part.

Quantiles come from histograms with steps of 1 mm (errors) and 1 cm (widths). LE90 is one-sided, the value that 90 % of
the absolute errors do not exceed (STANAG 2215, ISO 19157). The distance between the percentiles 5 and 95, which others
call LE90 too, has its own name.
"""

from typing import Any, NamedTuple

import numpy as np

from sat_intervals.evaluate.metrics import Intervals, share
from sat_intervals.match.histogram import Histogram

LARGEST = 500  # errors and widths are counted up to this many metres
# Factor of the NMAD, a robust standard deviation: sigma of a normal distribution (Hoehle and Hoehle 2009).
_NORMAL = 1.4826


class Heights(NamedTuple):
    """Heights of cells, their bounds, reference heights and relief, see `relief_of`: ``(n,)`` metres.

    Bounds are NaN without an interval.
    """

    height: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    reference: np.ndarray
    relief: np.ndarray

    @property
    def half_width(self) -> np.ndarray:
        """Return half the widths of the intervals."""
        return np.asarray((self.upper - self.lower) / 2)

    @property
    def outside(self) -> np.ndarray:
        """Return how far the reference is outside the intervals, negative inside."""
        return np.asarray(np.maximum(self.lower - self.reference, self.reference - self.upper))

    def of(self, chosen: np.ndarray) -> "Heights":
        """Return a part."""
        return Heights(*(values[chosen] for values in self))


class Accuracy:
    """Figures of a class of cells; ``nominal`` is the coverage that intervals are to reach, None if unknown."""

    def __init__(self, nominal: float | None) -> None:
        self._nominal = nominal
        self._count = 0
        self._sum = self._squares = 0.0
        self._errors, self._intervals = Histogram(-LARGEST, LARGEST, 1000), Intervals(LARGEST, nominal)

    def add(self, cells: Heights) -> None:
        """Add cells."""
        error = cells.height - cells.reference
        self._count += error.size
        self._sum += float(error.sum())
        self._squares += float(np.square(error).sum())
        self._errors.add(error)
        bounded = cells.of(np.isfinite(cells.half_width))
        self._intervals.add(np.maximum(bounded.outside, 0), 2 * bounded.half_width)

    def report(self) -> dict[str, Any]:
        """Return all figures, None without cells: metres, and shares of cells with an interval."""
        deviation, low, high = self._errors.deviation(), self._errors.quantile(0.05), self._errors.quantile(0.95)
        intervals = self._intervals.report()
        halves = {
            name: None if (width := intervals[f"{name}_width"]) is None else width / 2 for name in ("mean", "median")
        }
        return {
            "count": self._count,
            "bias": share(self._sum, self._count),
            "median": self._errors.median(),
            "nmad": None if deviation is None else _NORMAL * deviation,
            "rmse": float(np.sqrt(self._squares / self._count)) if self._count else None,
            "le90": self._errors.quantile_of_absolutes(0.9),
            "p95_p5": None if low is None or high is None else high - low,
            "with_interval": intervals["count"],
            "coverage": intervals["accuracy"],
            "mean_half_width": halves["mean"],
            "median_half_width": halves["median"],
            "interval_score": intervals["interval_score"],
            "needed_half_width": None if self._nominal is None else self._errors.quantile_of_absolutes(self._nominal),
        }
