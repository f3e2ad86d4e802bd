"""Whole-image steps on raw products: cross-checking, confidence, medians, regularisation, final bands.

Everything here sees full-width rows, with a halo of rows above and below, so that nothing depends on the tiling
(method: sections 4, 6 to 9). The order is: winner and V-fit (in the tile), cross-check, median, quantiles, widening,
NaN for invalid pixels.
"""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple, TypeVar

import numpy as np

from sat_intervals.config import Ambiguity, Config
from sat_intervals.kernels.confidence import low_confidence, normalize, percentiles
from sat_intervals.kernels.disparity import cross_check, median
from sat_intervals.kernels.intervals import regularize
from sat_intervals.kernels.matching import Raw, RightView
from sat_intervals.products import INVALID, NO_DISPARITY, REGULARIZED, Bands

Rows = TypeVar("Rows", bound=tuple[Any, ...])


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

    @classmethod
    def of(cls, raw: Raw, right: RightView) -> "RawRows":
        """What was matched as one tile."""
        return cls(raw.winner, raw.lower, raw.upper, raw.disparity, raw.ambiguity, raw.validity, right.winner)


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


def postprocess_rows(rows: RawRows, first: int, last: int, scale: ConfidenceScale, config: Config) -> Bands:
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
    written = (searched if config.products.keep_rejected else kept)[inner]
    disparity = np.where(written, disparity[inner], np.float32(np.nan))
    # The law of this tool: after medians and quantiles the interval still holds the disparity.
    lower, upper = np.minimum(lower, disparity), np.maximum(upper, disparity)
    return Bands(disparity, lower, upper, confidence[inner], validity[inner])


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


def postprocess_strips(strips: Iterable[RawRows], scale: ConfidenceScale, config: Config) -> Iterator[Bands]:
    """Final bands of a region given strip by strip, from the top; each strip waits for the halo below it."""
    for rows, first, last in with_halo(strips, halo(config)):
        yield postprocess_rows(rows, first, last, scale, config)


def with_halo(strips: Iterable[Rows], margin: int) -> Iterator[tuple[Rows, int, int]]:
    """Records of full-width rows, given strip by strip from the top, with the rows around them.

    Yields records with ``first`` and ``last``: the rows between have ``margin`` rows above and below them, as far as
    the image goes, and every row is between once.
    """
    waiting: Rows | None = None
    first = 0
    for strip in strips:
        waiting = strip if waiting is None else _made(strip, map(np.concatenate, zip(waiting, strip, strict=True)))
        last = len(waiting[0]) - margin
        if last > first:
            yield waiting, first, last
            start = max(0, last - margin)
            waiting, first = cut_rows(waiting, start, last + margin), last - start
    if waiting is not None and len(waiting[0]) > first:
        yield waiting, first, len(waiting[0])


def cut_rows(rows: Rows, first: int, last: int) -> Rows:
    """The rows ``[first, last)`` of a record."""
    return _made(rows, (array[first:last] for array in rows))


def _made(like: Rows, arrays: Iterable[np.ndarray]) -> Rows:
    return type(like)(*arrays)
