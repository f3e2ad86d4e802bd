"""Accumulate figures of merit of intervals (paper section 4.1; METHOD.md, section 10).

Medians come from histograms with these steps: widths 0.01, overestimation 0.001 (at least -99), confidence 0.001.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sat_intervals.match.histogram import Histogram
from sat_intervals.products import Bands

# Steps a unit.
_WIDTH = 100
_RATIO = 1000
_CONFIDENCE = 1000
_LARGEST_RATIO = 100


@dataclass(frozen=True)
class Criteria:
    """Parameters of an evaluation.

    Low confidence and its areas are defined by ``threshold``, ``kernel`` and ``depth`` of regularisation. A truth up to
    ``tolerance`` pixels outside an interval counts as inside; ``bias`` is added to the truth first. ``nominal`` is the
    coverage that the intervals are to reach, or alpha; None: no interval scores.
    """

    minimum: int
    maximum: int
    threshold: float
    kernel: int
    depth: int
    tolerance: float = 0.0
    bias: float = 0.0
    nominal: float | None = None


class Intervals:
    """Coverage, widths and interval score (Gneiting and Raftery 2007) of a group of pixels or cells."""

    def __init__(self, widest: int, nominal: float | None) -> None:
        self._of_misses = None if nominal is None or nominal >= 1 else 2 / (1 - nominal)
        self._sums = np.zeros(4)  # intervals, those that contain the truth, widths, distances of missed truths
        self._widths = Histogram(0, widest, _WIDTH)

    def add(self, missed: np.ndarray, width: np.ndarray) -> None:
        """Add intervals, with the distance of a missed truth from each; 0 if it is inside."""
        self._sums += missed.size, (missed == 0).sum(), width.sum(), missed.sum()
        self._widths.add(width)

    def report(self) -> dict[str, Any]:
        """Return all figures, None without intervals."""
        weight, (count, inside, widths, missed) = self._of_misses, self._sums.tolist()
        return {
            "count": int(count),
            "accuracy": share(inside, count),
            "mean_width": share(widths, count),
            "median_width": self._widths.median(),
            "interval_score": None if weight is None else share(widths + weight * missed, count),
        }


class _Deciles:
    """Coverage by decile of confidence; pixels of equal confidence stay in one decile."""

    def __init__(self) -> None:
        self._count, self._inside, self._width = np.zeros((3, _CONFIDENCE + 1))

    def add(self, confidence: np.ndarray, inside: np.ndarray, width: np.ndarray) -> None:
        known = np.isfinite(confidence)
        step = np.rint(confidence[known] * _CONFIDENCE).astype(np.int64)
        for total, weights in ((self._count, None), (self._inside, inside[known]), (self._width, width[known])):
            total += np.bincount(step, weights, minlength=total.size)

    def report(self) -> list[dict[str, Any]]:
        """Return the deciles, lowest confidence first; a confidence belongs to the decile of its mean rank."""
        present = np.flatnonzero(self._count)
        counts = self._count[present]
        middle = np.cumsum(counts) - counts / 2
        decile = (10 * middle // max(counts.sum(), 1)).astype(np.int64)
        groups = [present[decile == number] for number in np.unique(decile)]
        return [
            {
                "confidence": [group[0] / _CONFIDENCE, group[-1] / _CONFIDENCE],
                "count": int(self._count[group].sum()),
                "accuracy": share(self._inside[group].sum(), self._count[group].sum()),
                "mean_width": share(self._width[group].sum(), self._count[group].sum()),
            }
            for group in groups
        ]


class _Locking:
    """How much more often disparities are near whole pixels than truths: 0 alike, 1 whole pixels only."""

    def __init__(self) -> None:
        self._sums = np.zeros(3)

    def add(self, disparity: np.ndarray, truth: np.ndarray) -> None:
        near = np.abs(disparity - truth) <= 1
        self._sums += near.sum(), *(np.cos(2 * np.pi * values[near]).sum() for values in (disparity, truth))

    def report(self) -> float | None:
        """Return the difference of the mean cosines of the fractions; None if all truths are whole."""
        count, of_disparity, of_truth = self._sums.tolist()
        return (of_disparity - of_truth) / count if of_truth < count else None


class Metrics:
    """Figures of merit of a set of pixels."""

    def __init__(self, criteria: Criteria) -> None:
        self._criteria = criteria
        self._areas = {
            name: Intervals(criteria.maximum - criteria.minimum, criteria.nominal) for name in ("all", "high", "low")
        }
        self._ratios = Histogram(0, _LARGEST_RATIO, _RATIO)
        self._deciles, self._locking = _Deciles(), _Locking()
        self._wrong = {"bad1": 0, "bad3": 0, "truth_outside_range": 0}

    def add(self, bands: Bands, low: np.ndarray, area_error: np.ndarray) -> None:
        """Add pixels with an interval and a known truth: bands of one float64 per pixel.

        ``low`` is low confidence (paper eq. 13), ``area_error`` the largest ``|truth - disparity|`` over the evaluated
        pixels of its area, NaN if not low.
        """
        disparity, lower, upper, confidence, _, truth, *_ = bands
        criteria = self._criteria
        lowest = lower - criteria.tolerance
        highest = upper + criteria.tolerance
        width = upper - lower
        missed = np.maximum(np.maximum(lowest - truth, truth - highest), 0)
        for name, chosen in (("all", np.ones_like(low)), ("high", ~low), ("low", low)):
            self._areas[name].add(missed[chosen], width[chosen])
        wide = low & (width > 0)
        self._ratios.add(area_error[wide] / width[wide])
        self._deciles.add(confidence, missed == 0, width)
        error = np.abs(disparity - truth)
        self._locking.add(disparity, truth)
        self._wrong["bad1"] += int((error > 1).sum())
        self._wrong["bad3"] += int((error > 3).sum())
        self._wrong["truth_outside_range"] += int(((truth < criteria.minimum) | (truth > criteria.maximum)).sum())

    def report(self) -> dict[str, Any]:
        """Return all figures, None without pixels; shares are of the evaluated pixels."""
        report: dict[str, Any] = {name: area.report() for name, area in self._areas.items()}
        search = max(self._criteria.maximum - self._criteria.minimum, 1)
        for area in report.values():
            width = area["median_width"]
            area["relative_size"] = None if width is None else width / search  # paper eq. 15
        ratio = self._ratios.median()
        report["low"]["relative_overestimation"] = None if ratio is None else 1 - ratio  # paper eq. 16
        for name, count in self._wrong.items():
            report[name] = share(count, report["all"]["count"])
        return report | {"locking": self._locking.report(), "deciles": self._deciles.report()}


def share(part: float, whole: float) -> float | None:
    """Return a part of a whole, None without one."""
    return float(part / whole) if whole else None
