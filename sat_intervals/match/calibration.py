"""Choose the levels of a calibration from intervals that were made at a ladder of levels (docs/coverage.md).

Every pair is matched at each rung of the ladder, through the whole chain. So a coverage is known at the rungs, and
interpolated between them. Confidence classes are `HIGH` and low. Low-confidence pixels are measured once for each
quantile of the regularisation, and once without it.

Letters of shapes: rungs (levels of the ladder), schemes (high, then low with each of QUANTILES), fields.
"""

from collections.abc import Iterable, Mapping, Sequence
from math import ceil
from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config

# Quantiles of the regularisation that are tried; None: no regularisation.
QUANTILES = (None, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
HIGH, SCHEMES = 0, 1 + len(QUANTILES)
_USUAL_QUANTILE = 0.9
FEWEST = 1000  # pixels with truth, of all pairs

# Rungs: level 0, and from a fraction of the span to the level that holds every candidate, a third of an octave apart.
_LOWEST, _RUNGS = 1 / 256, 25
# Widths are counted in steps of 1/64 px up to 8 px, and of 1 % above.
_STEPS, _FINE, _RATIO = 64, 8, 1.01
_COARSE = ceil(np.log(32000 / _FINE) / np.log(_RATIO)) + 1
_WIDTHS = np.concatenate([np.arange(_FINE * _STEPS) / _STEPS, _FINE * _RATIO ** (np.arange(_COARSE) + 0.5)])
# Of quantiles whose scores differ by less than this, the one with the narrowest intervals is chosen.
_SAME_SCORE = 1.02
# Fields of a measurement: pixels that hold the truth, sum of widths, sum of distances that miss, counts by width.
INSIDE, WIDTH, MISSED, COUNTS = 0, 1, 2, 3
FIELDS = COUNTS + _WIDTHS.size


class Choice(NamedTuple):
    """Levels of a coverage.

    Attributes
    ----------
    high, low
        Levels of high and low confidence, excess aggregated costs.
    quantile
        Of the regularisation of low confidence; None without it.
    notes
        What a reader must know: a class with too few pixels, or a coverage that no level reaches.
    """

    high: float
    low: float
    quantile: float | None
    notes: tuple[str, ...] = ()


class Measured(NamedTuple):
    """Measurements of a pair, or of a block of one.

    Attributes
    ----------
    group
        Parts of one group are left out together.
    weight
        Of a pixel: one over the pixels of the pair, so that every pair weighs the same.
    table
        ``(rungs, schemes, fields)`` float64 sums over kept pixels with truth.
    known, good
        Pixels with truth, and those of them that are kept and within 1 px of it.
    """

    group: str
    weight: float
    table: np.ndarray
    known: int
    good: int

    @property
    def kept(self) -> int:
        """Return the number of kept pixels with truth."""
        return int(self.table[0, [HIGH, HIGH + 1], COUNTS:].sum())


def ladder(config: Config) -> np.ndarray:
    """Levels at which pairs are matched: ascending float64, the last holds every possible candidate."""
    levels = np.geomspace(config.cost_span * _LOWEST, config.largest_sum, _RUNGS)
    return np.concatenate([[0.0], levels])


def measure(
    lower: np.ndarray, upper: np.ndarray, truth: np.ndarray, tolerance: float, part: np.ndarray, parts: int
) -> np.ndarray:
    """Measure some intervals: ``(parts, fields)``.

    Parameters
    ----------
    lower, upper, truth
        ``(pixels,)`` finite numbers of pixels.
    tolerance
        Distance up to which a truth outside an interval counts as inside.
    part, parts
        Part of each pixel, and number of parts.
    """
    width = upper.astype(np.float64) - lower
    missed = np.maximum(np.maximum(lower - truth, truth - upper) - tolerance, 0)
    coarse = _FINE * _STEPS + np.log(np.maximum(width, _FINE) / _FINE) / np.log(_RATIO)
    place = np.where(width < _FINE, np.rint(width * _STEPS), coarse).astype(np.int64)
    fields = np.zeros((parts, FIELDS))
    for field, weights in ((INSIDE, missed == 0), (WIDTH, width), (MISSED, missed)):
        fields[:, field] = np.bincount(part, weights, parts)
    counts = np.bincount(part * _WIDTHS.size + place, minlength=parts * _WIDTHS.size)
    fields[:, COUNTS:] = counts.reshape(parts, -1)
    return fields


class Pool(NamedTuple):
    """Several measurements together.

    Attributes
    ----------
    table
        Weighted sums ``(rungs, schemes, fields)``.
    pixels
        Number of pixels of high and of low confidence.
    """

    table: np.ndarray
    pixels: tuple[int, int]


def pooled(parts: Iterable[Measured]) -> Pool:
    """Put measurements together."""
    parts = list(parts)
    high, low = np.sum([part.table[0, [HIGH, HIGH + 1], COUNTS:].sum(axis=-1) for part in parts], axis=0)
    return Pool(np.asarray(sum(part.weight * part.table for part in parts)), (int(high), int(low)))


def choose(pool: Pool, levels: np.ndarray, coverage: float) -> Choice:
    """Choose the levels with which each class reaches a coverage.

    Of the quantiles whose interval score is nearly the best, the one with the narrowest intervals is chosen. A class
    with fewer pixels than the larger of 200 and ``10 / (1 - coverage)`` takes the level of the other class: high
    confidence that of low confidence without regularisation, low confidence that of high with the usual quantile. If
    both have few, each keeps its own.
    """
    (table, pixels), notes = pool, []
    needed = ceil(max(200, 10 / (1 - coverage)) - 1e-9)
    few = [number < needed for number in pixels]
    for name, other, number in zip(("high", "low"), ("low", "high"), pixels, strict=True):
        if number < needed:
            borrowed = "" if all(few) else f": the level of {other} confidence is used"
            notes.append(f"{number} pixels of {name} confidence, {needed} are needed{borrowed}")
    reached = [_level(table[:, scheme], levels, coverage) for scheme in range(SCHEMES)]
    borrows = [number < needed <= beside for number, beside in zip(pixels, pixels[::-1], strict=True)]
    if (high := reached[HIGH + borrows[0]]) is None:
        high = float(levels[-1])
        notes.append("high confidence does not reach it at any level")
    if borrows[1]:
        return Choice(high, high, _USUAL_QUANTILE, tuple(notes))
    # level, interval score and sum of widths of each quantile that reaches it
    found = {}
    for scheme, quantile in enumerate(QUANTILES, start=HIGH + 1):
        if (level := reached[scheme]) is not None:
            fields = at_level(table[:, scheme], levels, level)
            found[quantile] = level, interval_score(fields, coverage), fields[WIDTH]
    if not found:
        notes.append("low confidence does not reach it at any level")
        most = int(np.argmax(table[-1, HIGH + 1 :, INSIDE]))
        return Choice(high, float(levels[-1]), QUANTILES[most], tuple(notes))
    best = min(score for _, score, _ in found.values())
    good = {quantile: width for quantile, (_, score, width) in found.items() if score <= _SAME_SCORE * best}
    quantile = min(good, key=lambda quantile: good[quantile])
    return Choice(high, found[quantile][0], quantile, tuple(notes))


def not_below(choice: Choice, before: Choice | None) -> Choice:
    """Raise levels to those of a smaller coverage: the level of another class may be lower than the class's own."""
    if before is None:
        return choice
    low = max(choice.low, before.low) if choice.quantile == before.quantile else choice.low
    return choice._replace(high=max(choice.high, before.high), low=low)


def _level(fields: np.ndarray, levels: np.ndarray, coverage: float) -> float | None:
    """Smallest level that reaches a coverage, between rungs as in `at_level`; None if none does."""
    pixels = fields[0, COUNTS:].sum()
    if pixels == 0:
        return None
    missed = np.minimum.accumulate(1 - fields[:, INSIDE] / pixels)  # regularisation is not quite monotone
    wanted = 1 - coverage + 1e-9
    above = int(np.argmax(missed <= wanted))
    if missed[above] > wanted:
        return None
    if above == 0:
        return float(levels[0])
    before, after = missed[above - 1 : above + 1]
    share = (before - wanted) / (before - after)
    if after > 0:
        share = np.log(before / wanted) / np.log(before / after)
    return float((1 - share) * levels[above - 1] + share * levels[above])


def at_level(fields: np.ndarray, levels: np.ndarray, level: float) -> np.ndarray:
    """Measurement at a level: ``(rungs, fields)`` to ``(fields,)``.

    Between rungs, misses fall geometrically, since they fall nearly exponentially with the level; the rest is linear.
    """
    above = int(np.clip(np.searchsorted(levels, level), 1, levels.size - 1))
    share = (level - levels[above - 1]) / (levels[above] - levels[above - 1])
    found = (1 - share) * fields[above - 1] + share * fields[above]
    pixels = fields[0, COUNTS:].sum()
    misses = np.stack([pixels - fields[above - 1 : above + 1, INSIDE], fields[above - 1 : above + 1, MISSED]], axis=1)
    one, other = np.maximum(misses, 0)  # sums of weights are not exact
    falls = (one > 0) & (other > 0)
    missing = np.where(falls, one ** (1 - share) * other**share, (1 - share) * one + share * other)
    found[INSIDE], found[MISSED] = pixels - missing[0], missing[1]
    return np.asarray(found)


def interval_score(fields: np.ndarray, coverage: float) -> float:
    """Interval score (Gneiting and Raftery 2007): mean of width + 2 / (1 - coverage) x distance of the truth."""
    pixels = fields[COUNTS:].sum()
    return float((fields[WIDTH] + 2 / (1 - coverage) * fields[MISSED]) / pixels)


def expected(table: np.ndarray, levels: np.ndarray, choice: Choice, coverage: float) -> dict[str, float]:
    """Figures with given levels: coverage of all, high and low, widths in pixels, interval score; NaN without pixels.

    ``table`` is that of a `Pool`.
    """
    high = at_level(table[:, HIGH], levels, choice.high)
    low = at_level(table[:, 1 + QUANTILES.index(choice.quantile)], levels, choice.low)
    both = high + low
    if not both[COUNTS:].sum():
        return dict.fromkeys(("all", "high", "low", "mean_width", "median_width", "score"), np.nan)
    upto = np.cumsum(both[COUNTS:])
    return {
        **{name: _share(fields, INSIDE) for name, fields in (("all", both), ("high", high), ("low", low))},
        "mean_width": _share(both, WIDTH),
        "median_width": float(_WIDTHS[np.searchsorted(upto, upto[-1] / 2)]),
        "score": interval_score(both, coverage),
    }


def _share(fields: np.ndarray, which: int) -> float:
    pixels = fields[COUNTS:].sum()
    return float(fields[which] / pixels) if pixels else np.nan


def left_out(
    parts: Sequence[Measured], levels: np.ndarray, coverages: Iterable[float]
) -> list[dict[str, dict[str, float]]]:
    """For each coverage, figures of each group, see `expected`, with the levels chosen on the others.

    Empty for a single group.
    """
    groups = list(dict.fromkeys(part.group for part in parts))
    own = {group: pooled(part for part in parts if part.group == group).table for group in groups}
    rest = {group: pooled(part for part in parts if part.group != group) for group in groups if len(groups) > 1}
    return [
        {
            group: expected(own[group], levels, choose(others, levels, coverage), coverage)
            for group, others in rest.items()
        }
        for coverage in coverages
    ]


def means(groups: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Means of the figures of groups where they are known, and ``lowest``, the smallest coverage of all pixels."""
    found = list(groups)
    figures = {}
    for name in found[0] if found else ():
        known = [one[name] for one in found if np.isfinite(one[name])]
        figures[name] = float(np.mean(known)) if known else np.nan
    return figures | {"lowest": min(one["all"] for one in found)} if found else {}
