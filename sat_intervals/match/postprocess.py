"""Whole-image steps on raw products: cross-checking, confidence, medians, regularisation, final bands.

Everything here sees full-width rows, with a halo of rows above and below, so that nothing depends on the tiling
(method: sections 4, 6 to 9). The order is: winner and V-fit (in the tile), cross-check, median, quantiles, widening,
NaN for invalid pixels.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from sat_intervals.config import Ambiguity, Config
from sat_intervals.kernels.confidence import low_confidence, normalize, percentiles
from sat_intervals.kernels.disparity import cross_check, median
from sat_intervals.kernels.intervals import regularize
from sat_intervals.products import BANDS, INVALID, NO_DISPARITY, REGULARIZED


class RawRows(NamedTuple):
    """Raw products of full-width rows, all ``(rows, columns)`` but the last.

    Attributes
    ----------
    winner, lower, upper
        int16 disparities, NO_DISPARITY for none.
    disparity
        float32, NaN for none.
    ambiguity
        uint32.
    validity
        uint16 flags.
    right_winner
        ``(rows, columns + count - 1)`` int16, see `RightView`.
    """

    winner: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    disparity: np.ndarray
    ambiguity: np.ndarray
    validity: np.ndarray
    right_winner: np.ndarray

    def cut(self, first: int, last: int) -> "RawRows":
        """The rows ``[first, last)``."""
        return RawRows(*(array[first:last] for array in self))


class Final(NamedTuple):
    """Final bands of some rows: ``intervals`` ``(4, rows, columns)`` float32 in the order of BANDS, and validity."""

    intervals: np.ndarray
    validity: np.ndarray


class ConfidenceScale(NamedTuple):
    """The ambiguities that become confidence 1 and 0."""

    p1: float
    p99: float


def confidence_scale(settings: Ambiguity, histogram: np.ndarray) -> ConfidenceScale:
    """What confidence is relative to: given figures, the whole range, or percentiles of the whole image.

    Equal percentiles do not tell pixels apart, so the whole range takes their place.

    ``histogram`` counts the ambiguities, ``0 .. etas * count``, of all pixels with a possible candidate.
    """
    if settings.p1 is not None and settings.p99 is not None:
        return ConfidenceScale(settings.p1, settings.p99)
    p1, p99 = percentiles(histogram)
    if settings.normalization == "range" or p1 == p99:
        return ConfidenceScale(0.0, float(histogram.size - 1))
    return ConfidenceScale(p1, p99)


def halo(config: Config) -> int:
    """Rows above and below that the final bands of a row depend on."""
    return _median_radius(config) + (config.regularization.depth if config.regularization else 0)


def _median_radius(config: Config) -> int:
    return config.median.size // 2 if config.median else 0


def postprocess_rows(rows: RawRows, first: int, last: int, scale: ConfidenceScale, config: Config) -> Final:
    """Final bands of the rows ``[first, last)``.

    Parameters
    ----------
    rows
        Raw products of these rows and of at least `halo` rows above and below, as far as the region goes.
    first, last
        Counted from the first of ``rows``.
    scale
        See `confidence_scale`; the same for the whole image.
    """
    searched = rows.winner != NO_DISPARITY
    validity = rows.validity.copy()
    if config.cross_check:
        tolerance = config.cross_check.tolerance
        validity |= cross_check(rows.winner, rows.right_winner, config.disparity.minimum, tolerance)
    kept = searched & (validity & INVALID == 0)
    confidence = normalize(rows.ambiguity, searched, scale.p1, scale.p99)
    disparity, (lower, upper) = rows.disparity, _bounds(rows, config)
    if config.median:
        disparity = median(disparity, kept, config.median.size)
        if config.interval:
            lower, upper = median(lower, kept, config.median.size), median(upper, kept, config.median.size)
    inner = slice(first, last)
    if config.regularization:
        lower, upper, low = _regularized(lower, upper, confidence, first, last, config)
        validity[inner][low] |= REGULARIZED
    else:
        lower, upper = lower[inner], upper[inner]
    disparity, validity = disparity[inner], validity[inner]
    bands = np.empty((len(BANDS), *disparity.shape), np.float32)
    bands[0], bands[3] = disparity, confidence[inner]
    # The law of this tool: after medians and quantiles the interval still holds the disparity.
    np.minimum(lower, disparity, out=bands[1])
    np.maximum(upper, disparity, out=bands[2])
    written = searched[inner] if config.products.keep_rejected else kept[inner]
    np.copyto(bands[:3], np.float32(np.nan), where=~written)
    return Final(bands, validity)


def _bounds(rows: RawRows, config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Both bounds as float; what stands where nothing was searched is never written."""
    if config.interval is None:
        nothing = np.full(rows.lower.shape, np.float32(np.nan))
        return nothing, nothing
    return rows.lower.astype(np.float32), rows.upper.astype(np.float32)


def _regularized(
    lower: np.ndarray, upper: np.ndarray, confidence: np.ndarray, first: int, last: int, config: Config
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Regularised bounds and the low-confidence pixels of the rows ``[first, last)``."""
    settings = config.regularization
    assert settings is not None
    top, bottom = max(0, first - settings.depth), last + settings.depth
    low = low_confidence(confidence[top:bottom], settings.threshold, settings.kernel)
    lower, upper = regularize(
        lower[top:bottom],
        upper[top:bottom],
        low,
        config.disparity.minimum,
        settings.depth,
        settings.quantile,
        first - top,
        last - top,
    )
    return lower, upper, low[first - top : last - top]


def postprocess_strips(strips: Iterable[RawRows], scale: ConfidenceScale, config: Config) -> Iterator[Final]:
    """Final bands of a region given strip by strip, from the top; each strip waits for the halo below it."""
    margin = halo(config)
    waiting: RawRows | None = None
    first = 0  # of the waiting rows, those before are halo
    for strip in strips:
        waiting = strip if waiting is None else RawRows(*map(_stacked, waiting, strip))
        last = waiting.winner.shape[0] - margin
        if last > first:
            yield postprocess_rows(waiting, first, last, scale, config)
            start = max(0, last - margin)
            waiting, first = waiting.cut(start, last + margin), last - start
    if waiting is not None and waiting.winner.shape[0] > first:
        yield postprocess_rows(waiting, first, waiting.winner.shape[0], scale, config)


def _stacked(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    return np.concatenate([above, below])
