"""Figures of merit of heights and their intervals against a reference, gathered part by part.

Quantiles come from histograms with steps of 1 mm (errors) and 1 cm (widths). LE90 is one-sided, the value that 90 % of
the absolute errors do not exceed (STANAG 2215, ISO 19157). The distance between the percentiles 5 and 95, which others
call LE90 too, has its own name.
"""

from typing import Any, NamedTuple

import numpy as np

from sat_intervals.evaluate.metrics import Intervals, share
from sat_intervals.kernels.label_noise import MOST, TrueErrors, true_errors
from sat_intervals.match.histogram import Histogram

BLOCKS = 4  # parts of the ground along each of its sides: errors within one are correlated
LARGEST = 500  # errors and widths are counted up to this many metres
# Factor of the NMAD, a robust standard deviation: sigma of a normal distribution (Hoehle and Hoehle 2009).
_NORMAL = 1.4826
NARROWEST = 0.01  # metres: half widths in which errors are measured are at least that
_FEWEST = 30  # noisy errors that give a coverage
_RANKED = 500  # steps a metre in which values are ranked


class Heights(NamedTuple):
    """Heights of cells, their bounds, reference heights and relief, see `relief_of`: ``(n,)`` metres.

    Bounds are NaN without an interval. ``sigma`` is the standard deviation of errors of the reference, 0 where it is
    exact; ``block`` the part of the ground, see `Comparison.block_of`.
    """

    height: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    reference: np.ndarray
    relief: np.ndarray
    sigma: np.ndarray
    block: np.ndarray

    @property
    def half_width(self) -> np.ndarray:
        """Return half the widths of the intervals."""
        return np.asarray((self.upper - self.lower) / 2)

    @property
    def outside(self) -> np.ndarray:
        """Return how far the reference is outside the intervals, negative inside."""
        return np.asarray(np.maximum(self.lower - self.reference, self.reference - self.upper))

    def true_errors(self) -> TrueErrors:
        """Return the distribution of true errors, from the middle of intervals and in half widths."""
        half = np.maximum(self.half_width, NARROWEST)
        return true_errors(((self.lower + self.upper) / 2 - self.reference) / half, self.sigma / half)

    def of(self, chosen: np.ndarray) -> "Heights":
        """Return a part."""
        return Heights(*(values[chosen] for values in self))


class Accuracy:
    """Figures of a class of cells; ``nominal`` is the coverage that intervals are to reach, None if unknown.

    ``within``: metres of error up to which a height counts as found; ``is_noisy``: whether references have errors.
    """

    def __init__(self, nominal: float | None, within: float, *, is_noisy: bool = False) -> None:
        self._nominal, self._within, self._is_noisy = nominal, within, is_noisy
        self._sums = np.zeros(5)  # heights, missing ones, near ones, errors, their squares
        self._blocks = np.zeros((2, BLOCKS**2))  # intervals, and those that contain their reference
        self._noisy: list[Heights] = []
        self._errors, self._intervals = Histogram(-LARGEST, LARGEST, 1000), Intervals(LARGEST, nominal)

    def add(self, cells: Heights, missing: int) -> None:
        """Add cells, and a number of reference heights whose cells have no height."""
        error = cells.height - cells.reference
        near = np.abs(error) <= self._within
        self._sums += error.size, missing, near.sum(), error.sum(), np.square(error).sum()
        self._errors.add(error)
        bounded = cells.of(np.isfinite(cells.half_width))
        self._intervals.add(np.maximum(bounded.outside, 0), 2 * bounded.half_width)
        for total, blocks in zip(self._blocks, (bounded.block, bounded.block[bounded.outside <= 0]), strict=True):
            total += np.bincount(blocks, minlength=total.size)
        if self._is_noisy:
            self._noisy.append(bounded)

    def report(self) -> dict[str, Any]:
        """Return all figures, None without cells: metres, and shares of cells with an interval."""
        deviation, low, high = self._errors.deviation(), self._errors.quantile(0.05), self._errors.quantile(0.95)
        intervals, (count, missing, near, total, squares) = self._intervals.report(), self._sums.tolist()
        coverage, of_coverage = intervals["accuracy"], coverage_deviation(*self._blocks)
        if self._noisy:
            coverage, of_coverage = coverage_of(Heights(*map(np.concatenate, zip(*self._noisy, strict=True))))
        halves = {
            name: None if (width := intervals[f"{name}_width"]) is None else width / 2 for name in ("mean", "median")
        }
        return {
            "count": int(count),
            "completeness": share(count, count + missing),
            "within": share(near, count + missing),
            "bias": share(total, count),
            "median": self._errors.median(),
            "nmad": None if deviation is None else _NORMAL * deviation,
            "rmse": float(np.sqrt(squares / count)) if count else None,
            "le90": self._errors.quantile_of_absolutes(0.9),
            "p95_p5": None if low is None or high is None else high - low,
            "with_interval": intervals["count"],
            "coverage": coverage,
            "coverage_deviation": of_coverage,
            "mean_half_width": halves["mean"],
            "median_half_width": halves["median"],
            "interval_score": None if self._noisy else intervals["interval_score"],
            "needed_half_width": None if self._nominal is None else self._errors.quantile_of_absolutes(self._nominal),
        }


def coverage_of(cells: Heights) -> tuple[float | None, float | None]:
    """Return the share of true heights inside intervals, and its standard error; None of few noisy heights."""
    if not cells.sigma.any():
        counts, inside = (
            np.bincount(cells.block[chosen].astype(np.int64), minlength=BLOCKS**2)
            for chosen in (slice(None), cells.outside <= 0)
        )
        return share(inside.sum(), counts.sum()), coverage_deviation(counts, inside)
    if cells.height.size < _FEWEST:
        return None, None
    coverage = cells.true_errors().within(1)
    variance = _binomial(coverage * cells.height.size, cells.height.size)
    cells = cells.of(np.arange(0, cells.height.size, -(-cells.height.size // MOST)))  # the same for each block
    blocks = np.unique(cells.block)
    if blocks.size > 1:  # the jackknife
        others = [cells.of(cells.block != block).true_errors().within(1) for block in blocks]
        variance = max(variance, (len(others) - 1) * float(np.var(others)))
    return coverage, float(np.sqrt(variance))


def coverage_deviation(counts: np.ndarray, inside: np.ndarray) -> float | None:
    """Return the standard error of a coverage: by what differs between blocks, at least that of a binomial share."""
    counts, inside = counts[counts > 0], inside[counts > 0]
    if not counts.size:
        return None
    coverage = inside.sum() / counts.sum()
    variance = _binomial(inside.sum(), counts.sum())
    if counts.size > 1:
        between = np.square(inside - coverage * counts).sum() / counts.sum() ** 2
        variance = max(variance, between * counts.size / (counts.size - 1))
    return float(np.sqrt(variance))


def _binomial(inside: float, count: float) -> float:
    """Return the variance of a share; that of few cases, all inside, is not 0."""
    middle = (inside + 1) / (count + 2)
    return float(middle * (1 - middle) / count)


class Ranking:
    """How well widths, and relief alone, rank errors: areas under sparsification error curves (AUSE)."""

    # The curve: mean absolute error of the share of cells that is left, from those of the smallest value on, in units
    # of the mean of all. Its area, less that of the curve by the errors themselves, is 0 for a perfect ranking.

    def __init__(self) -> None:
        self._sums = np.zeros((3, 2, LARGEST * _RANKED + 1))

    def add(self, cells: Heights) -> None:
        """Add cells; those without an interval do not count."""
        cells = cells.of(np.isfinite(cells.half_width))
        error = np.abs(cells.height - cells.reference)
        for sums, values in zip(self._sums, (error, cells.half_width, cells.relief), strict=True):
            place = np.clip(np.rint(values * _RANKED), 0, sums.shape[1] - 1).astype(np.int64)
            for total, weights in zip(sums, (None, error), strict=True):
                total += np.bincount(place, weights, total.size)

    def report(self) -> dict[str, float | None]:
        """Return the areas of half widths and of relief; None without errors."""
        if not self._sums[0, 1].sum():
            return {"half_width": None, "relief": None}
        best, half_width, relief = map(_area, self._sums)
        return {"half_width": half_width - best, "relief": relief - best}


def _area(sums: np.ndarray) -> float:
    """Return the area under a curve, from numbers of cells and sums of their errors by rising value."""
    counts, errors = np.cumsum(sums[:, sums[0] > 0], axis=1)
    kept, mean = counts / counts[-1], errors / counts * counts[-1] / errors[-1]
    return float(mean[0] * kept[0] + np.trapezoid(mean, kept))
