"""Accumulate figures of merit of intervals (paper section 4.1; METHOD.md, section 10).

Medians come from histograms with these steps: widths 0.01 px, overestimation 0.001 (at least -99), confidence 0.001.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.match.histogram import Histogram
from sat_intervals.products import Bands

_WIDTH, _RATIO, _CONFIDENCE = 100, 1000, 1000  # steps a unit
_LARGEST_RATIO = 100


@dataclass(frozen=True)
class Criteria:
    """Parameters of an evaluation.

    Low confidence and its areas are defined by ``threshold``, ``kernel`` and ``depth`` of regularisation. A truth up to
    ``tolerance`` pixels outside an interval counts as inside; ``bias`` is added to the truth first. ``nominal`` is the
    coverage, or alpha, that the intervals are to reach; None: no interval scores.
    """

    minimum: int
    maximum: int
    threshold: float
    kernel: int
    depth: int
    tolerance: float = 0.0
    bias: float = 0.0
    nominal: float | None = None


class Evaluated(NamedTuple):
    """Pixels with an interval and a known truth, one element per pixel; bands are float64 but the flags.

    ``low`` is low confidence (paper eq. 13), ``area_error`` the largest ``|truth - disparity|`` over the evaluated
    pixels of its area, NaN if not low.
    """

    bands: Bands
    low: np.ndarray
    area_error: np.ndarray


class _Intervals:
    """Accuracy and size of the intervals of a group of pixels (paper eq. 14 and 15), and their score.

    The interval score (Gneiting and Raftery 2007) is ``width + 2 / (1 - nominal) * distance of a missed truth``.
    """

    def __init__(self, search: int, nominal: float | None) -> None:
        self._search = search
        self._of_misses = None if nominal is None or nominal >= 1 else 2 / (1 - nominal)
        self._count = self._inside = 0
        self._width = self._missed = 0.0
        self._widths = Histogram(0, search, _WIDTH)

    def add(self, missed: np.ndarray, width: np.ndarray) -> None:
        """Add pixels, with the distance of a missed truth from the interval; 0 if it is inside."""
        self._count += missed.size
        self._inside += int((missed == 0).sum())
        self._missed += float(missed.sum())
        self._width += float(width.sum())
        self._widths.add(width)

    def report(self) -> dict[str, Any]:
        median = self._widths.median()
        return {
            "count": self._count,
            "accuracy": _share(self._inside, self._count),
            "relative_size": None if median is None else median / max(self._search, 1),
            "mean_width": _share(self._width, self._count),
            "median_width": median,
            "interval_score": None
            if self._of_misses is None
            else _share(self._width + self._of_misses * self._missed, self._count),
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
                "accuracy": _share(self._inside[group].sum(), self._count[group].sum()),
                "mean_width": _share(self._width[group].sum(), self._count[group].sum()),
            }
            for group in groups
        ]


class Metrics:
    """Figures of merit of a set of pixels."""

    def __init__(self, criteria: Criteria) -> None:
        self._criteria = criteria
        self._areas = {
            name: _Intervals(criteria.maximum - criteria.minimum, criteria.nominal) for name in ("all", "high", "low")
        }
        self._ratios = Histogram(0, _LARGEST_RATIO, _RATIO)
        self._deciles = _Deciles()
        self._wrong = {"bad1": 0, "bad3": 0, "truth_outside_range": 0}

    def add(self, pixels: Evaluated) -> None:
        """Add pixels."""
        disparity, lower, upper, confidence, _, truth, _ = pixels.bands
        low, criteria = pixels.low, self._criteria
        inside = (lower - criteria.tolerance <= truth) & (truth <= upper + criteria.tolerance)
        outside = np.maximum(lower - criteria.tolerance - truth, truth - upper - criteria.tolerance)
        missed = np.where(inside, 0.0, outside)
        width = upper - lower
        for name, chosen in (("all", np.ones_like(low)), ("high", ~low), ("low", low)):
            self._areas[name].add(missed[chosen], width[chosen])
        wide = low & (width > 0)
        self._ratios.add(pixels.area_error[wide] / width[wide])
        self._deciles.add(confidence, inside, width)
        error = np.abs(disparity - truth)
        self._wrong["bad1"] += int((error > 1).sum())
        self._wrong["bad3"] += int((error > 3).sum())
        self._wrong["truth_outside_range"] += int(((truth < criteria.minimum) | (truth > criteria.maximum)).sum())

    def report(self) -> dict[str, Any]:
        """Return all figures, None without pixels; shares are of the evaluated pixels."""
        report: dict[str, Any] = {name: area.report() for name, area in self._areas.items()}
        ratio = self._ratios.median()
        report["low"]["relative_overestimation"] = None if ratio is None else 1 - ratio  # paper eq. 16
        for name, count in self._wrong.items():
            report[name] = _share(count, report["all"]["count"])
        return report | {"deciles": self._deciles.report()}


def _share(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None
