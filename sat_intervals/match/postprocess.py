"""Whole-image steps on raw products: cross-checking, confidence, medians, least squares, regularisation, widening.

All steps work on full-width rows with a halo of rows above and below, so that results do not depend on the tiling
(METHOD.md, sections 4, 6 to 9, and 19).
"""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple, TypeVar

import numpy as np

from sat_intervals import products
from sat_intervals.config import Ambiguity, Config
from sat_intervals.kernels.confidence import low_confidence, normalize, surroundings
from sat_intervals.kernels.disparity import cross_check, median
from sat_intervals.kernels.intervals import regularize
from sat_intervals.kernels.matching import Raw, RightView
from sat_intervals.match.histogram import quantile
from sat_intervals.match.refinement import HalfWidths, Refined, bounds_of_both, half_widths, halo_of, refined, smoothed

# Many images: side of the windows, and steps of height between their cells, that errors are larger in, whatever the
# confidence: half widths of .9 fall from .99 to .49 m on ten images of a city if these cells count as uncertain.
_ROUGH = 7, 4
# Steps per pixel in which sub-pixel bounds are regularised.
_STEPS = 8
_EMPTY = np.empty((0, 0), np.uint16)

Rows = TypeVar("Rows", bound=tuple[Any, ...])


class RawRows(NamedTuple):
    """Raw products of full-width rows, all ``(rows, columns)`` except the last three.

    winner: int16 disparities in pixels, NO_DISPARITY for none.
    lower, upper, lower_low, upper_low: uint16 bounds in steps, of high and of low confidence, see `Raw`.
    disparity: float32 pixels, NaN for none.
    ambiguity: uint32.
    validity: uint16 flags.
    right_winner: ``(rows, columns + count - 1)`` int16, see `RightView`.
    left, right: pixels of both images, see `refinement.pixel_windows`; empty without least squares.
    """

    winner: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    disparity: np.ndarray
    ambiguity: np.ndarray
    validity: np.ndarray
    lower_low: np.ndarray
    upper_low: np.ndarray
    right_winner: np.ndarray
    left: np.ndarray = _EMPTY
    right: np.ndarray = _EMPTY

    @classmethod
    def of(cls, raw: Raw, right: RightView) -> "RawRows":
        """Make the rows of a pair that was matched as one tile."""
        return cls(**{name: getattr(raw, name) for name in raw._fields if name != "cost"}, right_winner=right.winner)


class Filtered(NamedTuple):
    """Rows before regularisation: bands with their halo, low-confidence pixels (None without), pixels to write.

    deviation: of the fits of least squares, see `Refined`; empty without.
    below, above, edge: see `HalfWidths`; empty without least squares and a coverage.
    """

    disparity: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    confidence: np.ndarray
    validity: np.ndarray
    low: np.ndarray | None
    written: np.ndarray
    deviation: np.ndarray
    below: np.ndarray
    above: np.ndarray
    edge: np.ndarray

    @property
    def half(self) -> HalfWidths:
        """Return the half widths."""
        return HalfWidths(self.below, self.above, self.edge)


class ConfidenceScale(NamedTuple):
    """Ambiguities that become confidence 1 and 0, and the largest one of which a pixel is kept."""

    p1: float
    p99: float
    most: float = np.inf


def confidence_scale(settings: Ambiguity, histogram: np.ndarray, doubtful: float = 0.0) -> ConfidenceScale:
    """Scale of confidence: given figures, the whole range, or percentiles of the whole image."""
    # ``histogram`` counts the ambiguities of all pixels with a possible candidate. Equal percentiles cannot rank
    # pixels, so the whole range replaces them.
    # ``doubtful``: share of pixels, of the largest ambiguity, that are not kept.
    most = quantile(np.arange(histogram.size), histogram, 1 - doubtful) if doubtful else np.inf
    if settings.p1 is not None and settings.p99 is not None:
        return ConfidenceScale(settings.p1, settings.p99, most)
    p1, p99 = (quantile(np.arange(histogram.size), histogram, share) for share in (0.01, 0.99))
    if settings.normalization == "range" or p1 == p99:
        return ConfidenceScale(0.0, float(histogram.size - 1), most)
    return ConfidenceScale(p1, p99, most)


def halo(config: Config) -> int:
    """Number of rows above and below that the final bands of a row depend on."""
    radius = config.median.size // 2 if config.median else 0
    radius += 0 if config.cost.compares_two else _ROUGH[0] // 2
    return radius + max(config.regularization.depth if config.regularization else 0, halo_of(config))


def postprocess_rows(rows: RawRows, first: int, last: int, scale: ConfidenceScale, config: Config) -> products.Bands:
    """Final bands of the rows ``[first, last)`` of ``rows``, which has `halo` more on both sides in the region."""
    filtered = filter_rows(rows, scale, config)
    inner, cuts = slice(first, last), config.cuts
    validity, low = filtered.validity[inner].copy(), filtered.low
    lower, upper = filtered.lower[inner], filtered.upper[inner]
    if config.regularization:
        quantile = cuts.quantile if cuts else config.regularization.quantile
        lower, upper = regularized(filtered, first, last, config, quantile)
        assert low is not None
        validity[low[inner]] |= products.REGULARIZED
    if config.fits and cuts:
        assert low is not None  # a coverage needs all classes
        assert cuts.edge is not None
        half = cut_rows(filtered.half, first, last)
        factors = np.where(half.edge, np.float32(cuts.edge), np.float32(cuts.high))
        bounds = bounds_of_both(filtered.disparity[inner], half, factors, config)
        lower, upper = (np.where(low[inner], old, new) for new, old in zip(bounds, (lower, upper), strict=True))
    disparity = np.where(filtered.written[inner], filtered.disparity[inner], np.float32(np.nan))
    bands = products.Bands(disparity, *widened(lower, upper, disparity, config), filtered.confidence[inner], validity)
    return bands._replace(sigma=filtered.deviation[inner]) if config.products.sigma else bands


def filter_rows(rows: RawRows, scale: ConfidenceScale, config: Config) -> Filtered:
    """Cross-check, confidence and medians: all steps before regularisation; see `postprocess_rows`."""
    searched = rows.winner != products.NO_DISPARITY
    validity = rows.validity.copy()
    if config.cross_check:
        tolerance = config.cross_check.tolerance
        validity |= cross_check(rows.winner, rows.right_winner, config.disparity.minimum, tolerance)
    validity[rows.ambiguity > scale.most] |= products.MISMATCH
    kept = searched & (validity & products.INVALID == 0)
    confidence = normalize(rows.ambiguity, searched, scale.p1, scale.p99)
    if config.opens_ends:  # beyond the ends of the range the true disparity may be
        ends = validity & products.RANGE_END != 0
        confidence[ends] = 0
        if config.interval:
            below = rows.winner <= config.disparity.minimum + 1
            validity[ends] |= np.where(below[ends], products.OPEN_BELOW, products.OPEN_ABOVE).astype(validity.dtype)
    low = None
    if config.regularization:
        low = low_confidence(confidence, config.regularization.threshold, config.regularization.kernel)
        if not config.cost.compares_two:
            lowest, highest, _ = surroundings(rows.winner.astype(np.float32), kept, _ROUGH[0])
            low |= kept & (highest - lowest >= _ROUGH[1])
    disparity, (lower, upper) = rows.disparity, _bounds(rows, low, kept, config)
    if config.median:
        disparity = median(disparity, kept, config.median.size)
    deviation = _EMPTY
    if config.fits:
        disparity, deviation = refined(disparity, kept, rows.left, rows.right, config)
        validity[np.isfinite(deviation)] &= ~np.uint16(products.NOT_REFINED)
    elif config.has_planes:
        disparity = smoothed(disparity, kept, config)
    written = searched if config.products.keep_rejected else kept
    half = (_EMPTY,) * 3
    if config.fits and config.has_coverage:
        half = half_widths(Refined(disparity, deviation), lower, upper, kept)
    return Filtered(disparity, lower, upper, confidence, validity, low, written, deviation, *half)


def widened(
    lower: np.ndarray, upper: np.ndarray, disparity: np.ndarray, config: Config
) -> tuple[np.ndarray, np.ndarray]:
    """Widen bounds to contain the disparity, rounded outwards: medians or quantiles may have moved them past it."""
    lower, upper = np.minimum(lower, disparity), np.maximum(upper, disparity)
    if config.has_coverage:
        for round_, bound in ((np.floor, lower), (np.ceil, upper)):  # in place: half the time
            bound *= products.BOUND_STEPS
            round_(bound, out=bound)
            bound /= products.BOUND_STEPS
    return lower, upper


def _bounds(rows: RawRows, low: np.ndarray | None, kept: np.ndarray, config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Both bounds in pixels as float32, of the level of each pixel's class, after the median."""
    # With least squares the cuts of the two classes differ much, so each is filtered on its own.
    if config.interval is None:
        nothing = np.full(rows.lower.shape, np.float32(np.nan))
        return nothing, nothing
    high, both = (rows.lower, rows.upper), ((rows.lower_low, rows.lower), (rows.upper_low, rows.upper))
    if low is None or not config.has_coverage:
        lower, upper = (_filtered(bound, kept, config) for bound in high)
    elif config.fits:
        lower, upper = (np.where(low, *(_filtered(bound, kept, config) for bound in pair)) for pair in both)
    else:
        lower, upper = (_filtered(np.where(low, *pair), kept, config) for pair in both)
    return lower, upper


def _filtered(bound: np.ndarray, kept: np.ndarray, config: Config) -> np.ndarray:
    """Convert bounds to pixels, and take their medians."""
    bound = bound.astype(np.float32)
    bound /= config.bound_steps
    bound += np.float32(config.disparity.minimum)
    return np.asarray(median(bound, kept, config.median.size)) if config.median else bound


def regularized(
    rows: Filtered, first: int, last: int, config: Config, quantile: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Regularised bounds of the rows ``[first, last)``; those before without a quantile."""
    if quantile is None:
        return rows.lower[first:last], rows.upper[first:last]
    settings = config.regularization
    assert settings is not None
    top = max(0, first - settings.depth)
    near = cut_rows(rows, top, last + settings.depth)
    search, steps = config.disparity, max(2, min(_STEPS, config.bound_steps))
    wanted = first - top, last - top
    lower, upper = regularize(near.lower, near.upper, near.low, search.minimum, settings.depth, quantile, wanted, steps)
    return lower, upper


def postprocess_strips(strips: Iterable[RawRows], scale: ConfidenceScale, config: Config) -> Iterator[products.Bands]:
    """Final bands of a region from its strips, from the top; a row is finished once the halo below it is read.

    With `halo` rows, inside the region, above and below a strip its `inner_rows` have the bits of the whole region.
    """
    for rows, first, last in with_halo(strips, halo(config)):
        yield postprocess_rows(rows, first, last, scale, config)


def inner_rows(pieces: Iterable[Rows], above: int, height: int) -> Iterator[Rows]:
    """Yield the ``height`` rows below the first ``above`` of a record that is given piece by piece."""
    row = -above
    for piece in pieces:
        rows = len(piece[0])
        if row + rows > 0 and row < height:
            yield cut_rows(piece, max(0, -row), min(rows, height - row))
        row += rows


def with_halo(strips: Iterable[Rows], margin: int) -> Iterator[tuple[Rows, int, int]]:
    """Add rows above and below to records of full-width rows, given strip by strip from the top.

    Yields ``(record, first, last)``: the rows ``[first, last)`` have ``margin`` rows above and below, fewer at the
    image's ends.
    """
    waiting: Rows | None = None
    first = 0
    for strip in strips:
        waiting = strip if waiting is None else type(strip)(*map(np.concatenate, zip(waiting, strip, strict=True)))
        last = len(waiting[0]) - margin
        if last > first:
            yield waiting, first, last
            start = max(0, last - margin)
            waiting, first = cut_rows(waiting, start, last + margin), last - start
    if waiting is not None and len(waiting[0]) > first:
        yield waiting, first, len(waiting[0])


def cut_rows(rows: Rows, first: int, last: int) -> Rows:
    """Cut the rows ``[first, last)`` of a record."""
    return type(rows)(*(array[first:last] for array in rows))
