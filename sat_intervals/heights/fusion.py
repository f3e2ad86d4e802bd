"""Make the intervals of cells: from sums over points, from those of several runs, by a calibration."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sat_intervals.config import HeightCalibration
from sat_intervals.kernels.conformal import widened
from sat_intervals.kernels.splat import BOUNDED, CONFIDENCE, COUNT, HEIGHT, LEAST, LOWER, MOST, UPPER, WEIGHT
from sat_intervals.products import SURFACE

# Metres: narrower intervals weigh as much as one of this width.
_NARROWEST = 0.01


class RunCells(NamedTuple):
    """The cells of one run; NaN where no point contributes."""

    weight: np.ndarray
    height: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    confidence: np.ndarray
    points: np.ndarray


def cells_of_run(gathered: np.ndarray, bounds: str) -> RunCells:
    """Return heights and bounds from sums over points, see `PointCloud.splat`; ``bounds`` as in `SurfaceChoices`."""
    weight = np.where(gathered[COUNT] > 0, gathered[WEIGHT], np.nan)
    bounded = np.where(gathered[BOUNDED] > 0, gathered[BOUNDED], np.nan)
    if bounds == "mean":
        lower, upper = gathered[LOWER] / bounded, gathered[UPPER] / bounded
    else:
        lower, upper = (np.where(np.isnan(bounded), np.nan, gathered[index]) for index in (LEAST, MOST))
    height, confidence = gathered[HEIGHT] / weight, gathered[CONFIDENCE] / weight
    if bounds not in ("envelope", "mean"):  # heights do not depend on the bounds
        lower, upper = np.minimum(lower, height), np.maximum(upper, height)
    return RunCells(weight, height, lower, upper, confidence, gathered[COUNT])


def fused(runs: Sequence[RunCells]) -> np.ndarray:
    """Return the bands of SURFACE from the cells of each run: ``(6, rows, columns)`` float32.

    Heights and middles of intervals are means weighted by ``1 / width^2``; the width is that of the mean weight. It is
    not divided by the root of the number of runs: errors of pairs of the same place are correlated. Where the intervals
    do not meet, their hull is taken. Heights of runs without intervals count where no run has one.
    """
    weights, heights, lowers, uppers = (
        np.stack([getattr(run, name) for run in runs]) for name in ("weight", "height", "lower", "upper")
    )
    known = np.isfinite(weights)
    height, lower, upper = _mean(weights, heights), lowers[0], uppers[0]
    overlapping = np.fmax.reduce(lowers) <= np.fmin.reduce(uppers)
    several = np.isfinite(lowers).sum(axis=0) > 1
    if len(runs) > 1:
        width = np.maximum(uppers - lowers, _NARROWEST)
        height = np.where(np.isfinite(width).any(axis=0), _mean(width**-2, heights), height)
        middle, half = _mean(width**-2, (lowers + uppers) / 2), _mean(width**-2, width**2) ** 0.5 / 2
        averaged = several & overlapping
        lower = np.where(averaged, middle - half, np.fmin.reduce(lowers))
        upper = np.where(averaged, middle + half, np.fmax.reduce(uppers))
    bands = {
        "height": np.fmin(np.fmax(height, lower), upper),
        "height_lower": _outwards(lower, -np.inf),
        "height_upper": _outwards(upper, np.inf),
        "count": np.where(known.any(axis=0), sum(run.points for run in runs), np.nan),
        "confidence": _mean(weights, np.stack([run.confidence for run in runs])),
        "agreement": np.where(several, overlapping, np.nan),
    }
    return np.stack([bands[band.name] for band in SURFACE]).astype(np.float32)


def _mean(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the weighted mean over the first axis of what is known; NaN without anything."""
    weights = np.where(np.isnan(values), np.nan, weights)
    total = np.nansum(weights, axis=0)
    total[total == 0] = np.nan
    return np.asarray(np.nansum(weights * values, axis=0) / total)


def calibrate(bands: np.ndarray, calibration: HeightCalibration) -> None:
    """Widen or narrow the intervals of cells by the margins of a calibration, in place."""
    limits, margins = np.array(calibration.limits), np.array(calibration.margins)
    height, lower, upper = bands[:3].astype(np.float64)
    lower, upper = widened(height, lower, upper, limits, margins)
    bands[1], bands[2] = _outwards(lower, -np.inf), _outwards(upper, np.inf)


def without_poor_cells(bands: np.ndarray, max_width: float | None, min_confidence: float | None) -> int:
    """Set the cells of wider intervals or lower confidence to NaN, in place; return their number."""
    band = dict(zip((band.name for band in SURFACE), bands, strict=True))
    poor = np.zeros(bands.shape[1:], np.bool_)
    if max_width is not None:
        poor |= np.isfinite(band["height"]) & ~(band["height_upper"] - band["height_lower"] <= max_width)
    if min_confidence is not None:
        poor |= np.isfinite(band["height"]) & ~(band["confidence"] >= min_confidence)
    bands[:, poor] = np.nan
    return int(poor.sum())


def _outwards(bound: np.ndarray, end: float) -> np.ndarray:
    """Round a bound to float32, towards ``end``."""
    single = bound.astype(np.float32)
    inside = single > bound if end < 0 else single < bound
    return np.where(inside, np.nextafter(single, np.float32(end)), single)
