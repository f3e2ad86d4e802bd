"""Make the bands of a surface: from the points gathered of one or several runs, by a calibration, by limits."""

from collections.abc import Sequence

import numpy as np

from sat_intervals.config import HeightCalibration
from sat_intervals.kernels.conformal import widened
from sat_intervals.kernels.gridding import BOUNDED, CONFIDENCE, COUNT, HEIGHT, LOWER, UPPER, WEIGHT
from sat_intervals.products import SURFACE

_NARROWEST = 0.01  # metres: narrower intervals weigh as much as one of this width


def fused(gathered: Sequence[np.ndarray]) -> np.ndarray:
    """Return the bands of SURFACE, ``(6, rows, columns)`` float32, from the cells of runs, see `PointCloud.splat`."""
    # Heights and middles of intervals are means weighted by ``1 / width^2``, widths those of the mean weight, not
    # divided by the root of the number of runs: errors of pairs of one place are correlated. Where intervals do not
    # meet, their hull is taken, and the height of the narrowest: a mean may be in none of them. Without any, all
    # heights count.
    layers = np.stack(gathered, axis=1)  # of each layer, the cells of all runs
    count = layers[COUNT].sum(axis=0)
    weights = np.where(layers[COUNT] > 0, layers[WEIGHT], np.nan)
    heights, confidences = layers[HEIGHT] / weights, layers[CONFIDENCE] / weights
    lowers, uppers = np.where(layers[BOUNDED] > 0, layers[[LOWER, UPPER]], np.nan)
    height, lower, upper = _mean(weights, heights), lowers[0], uppers[0]
    several = np.isfinite(lowers).sum(axis=0) > 1
    meeting = np.fmax.reduce(lowers) <= np.fmin.reduce(uppers)
    if len(gathered) > 1:
        width = np.maximum(uppers - lowers, _NARROWEST)
        height = np.where(np.isfinite(width).any(axis=0), _mean(width**-2, heights), height)
        narrowest = np.where(np.isnan(width), np.inf, uppers - lowers).argmin(axis=0)[np.newaxis]
        height = np.where(several & ~meeting, np.take_along_axis(heights, narrowest, axis=0)[0], height)
        middle, half = _mean(width**-2, (lowers + uppers) / 2), _mean(width**-2, width**2) ** 0.5 / 2
        lower = np.where(several & meeting, middle - half, np.fmin.reduce(lowers))
        upper = np.where(several & meeting, middle + half, np.fmax.reduce(uppers))
    bands = {
        "height": np.fmin(np.fmax(height, lower), upper),
        "height_lower": _outwards(lower, -np.inf),
        "height_upper": _outwards(upper, np.inf),
        "count": np.where(count > 0, count, np.nan),
        "confidence": _mean(weights, confidences),
        "agreement": np.where(several, meeting, np.nan),
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
    height, lower, upper, _, confidence, _ = bands
    poor = np.zeros(height.shape, np.bool_)
    if max_width is not None:
        poor |= ~(upper - lower <= max_width)
    if min_confidence is not None:
        poor |= ~(confidence >= min_confidence)
    poor &= np.isfinite(height)
    bands[:, poor] = np.nan
    return int(poor.sum())


def _outwards(bound: np.ndarray, end: float) -> np.ndarray:
    """Round a bound to float32, towards ``end``."""
    single = bound.astype(np.float32)
    inside = single > bound if end < 0 else single < bound
    return np.where(inside, np.nextafter(single, np.float32(end)), single)
