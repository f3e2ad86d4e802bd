"""Choose the levels of a calibration from intervals measured at a sweep of thresholds, see `measurement`."""

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from math import ceil, isfinite
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.config import Calibration, Config
from sat_intervals.config.calibration import COVERAGES, Levels
from sat_intervals.match.measurement import (
    COUNTS,
    EDGE,
    HIGH,
    INSIDE,
    LOW,
    MISSED,
    QUANTILES,
    WIDTH,
    WIDTHS,
    Measured,
    ThresholdSweep,
    threshold_sweep,
)

_USUAL_QUANTILE = 0.9
# Classes of pixels, and their names in notes.
_CLASSES = {"high": "high confidence", "edge": "high confidence at edges", "low": "low confidence"}
# Of quantiles whose scores differ by less than this, the one with the narrowest intervals is chosen.
_SAME_SCORE = 1.02


class Pool(NamedTuple):
    """Several measurements together.

    table: weighted sums ``(thresholds, schemes, fields)``.
    pixels: number of pixels of high confidence, of edges, and of low confidence.
    """

    table: np.ndarray
    pixels: tuple[int, int, int]


def pooled(parts: Iterable[Measured]) -> Pool:
    """Put measurements together."""
    parts = list(parts)
    high, edge, low = np.sum([part.table[0, : LOW + 1, COUNTS:].sum(axis=-1) for part in parts], axis=0)
    return Pool(np.asarray(sum(part.weight * part.table for part in parts)), (int(high), int(edge), int(low)))


def calibration_of_parts(
    parts: Sequence[Measured], config: Config, name: str, pairs: list[dict[str, Any]], key: dict[str, Any]
) -> tuple[Calibration, list[dict[str, float]]]:
    """Return the calibration of measured parts with ``pairs`` as provenance, and what to expect of it by coverage."""
    thresholds = threshold_sweep(config)
    pool = pooled(parts)
    expected = []
    notes = []
    chosen: list[Levels] = []
    for coverage, groups in zip(COVERAGES, left_out(parts, thresholds, COVERAGES), strict=True):
        levels, doubts = choose(pool, thresholds, coverage)
        levels = not_below(levels, chosen[-1] if chosen else None)
        rounded = {"high": round(levels.high, 3), "edge": levels.edge and round(levels.edge, 3)}
        chosen.append(levels.model_copy(update=rounded | {"low": round(levels.low, 2)}))
        notes += [f"coverage {coverage:g}: {doubt}" for doubt in doubts]
        expected.append({"coverage": coverage, **means(groups.values())})
    provenance = {
        "software": f"sat-intervals {version('sat-intervals')}",
        "pairs": pairs,
        "pixels": dict(zip(_CLASSES, pool.pixels, strict=True)),
        "notes": notes,
        "expected": [
            {key: round(value, 4) if isfinite(value) else None for key, value in row.items()} for row in expected
        ],
    }
    return Calibration(name=name, key=key, levels=tuple(chosen), provenance=provenance), expected


def choose(pool: Pool, sweep: ThresholdSweep, coverage: float) -> tuple[Levels, list[str]]:
    """Choose the levels with which each class reaches a coverage.

    Of the quantiles whose interval score is nearly the best, the one with the narrowest intervals is chosen. A class
    with fewer pixels than the larger of 200 and ``10 / (1 - coverage)`` takes the level of the other class: high
    confidence that of low confidence without regularisation, low confidence that of high with the usual quantile. If
    both have few, or with least squares, each class, edges too, keeps its own.

    Returns the levels, and what a reader must know: a class with few pixels, or a coverage that no level reaches.
    """
    (table, pixels), notes = pool, list[str]()
    needed = ceil(max(200, 10 / (1 - coverage)) - 1e-9)
    few = [number < needed for number in pixels]
    borrows = sweep.are_one and not (few[HIGH] and few[LOW])
    for (name, words), number in zip(_CLASSES.items(), pixels, strict=True):
        if number < needed and not (name == "edge" and sweep.are_one):
            other = _CLASSES["low" if name == "high" else "high"]
            borrowed = f": the level of {other} is used" if borrows else ""
            notes.append(f"{number} pixels of {words}, {needed} are needed{borrowed}")
    high = _level(table[:, LOW if few[HIGH] and borrows else HIGH], sweep.high, coverage)
    edge = _level(table[:, EDGE], sweep.high, coverage)
    most = float(sweep.low[-1])
    own = _best(table, sweep.low, coverage)
    low = (most if high is None else high, _USUAL_QUANTILE) if few[LOW] and borrows else own
    found = zip(_CLASSES.values(), pixels, (high, edge, low), strict=True)
    missed = [f"{words} does not reach it at any level" for words, number, level in found if number and level is None]
    level, quantile = low or (most, QUANTILES[int(np.argmax(table[-1, LOW:, INSIDE]))])  # it comes nearest
    high, edge = (float(sweep.high[-1]) if one is None else one for one in (high, edge))
    levels = Levels(
        coverage=coverage,
        high=high,
        edge=None if sweep.are_one else edge,
        low=level,
        quantile=quantile,
        reached=not missed,
    )
    return levels, notes + missed


def _best(table: np.ndarray, levels: np.ndarray, coverage: float) -> tuple[float, float | None] | None:
    """Return level and quantile of low confidence; None if no quantile reaches the coverage."""
    found = []
    for scheme, quantile in enumerate(QUANTILES, start=LOW):
        if (level := _level(table[:, scheme], levels, coverage)) is not None:
            fields = at_level(table[:, scheme], levels, level)
            found.append((level, quantile, interval_score(fields, coverage), fields[WIDTH]))
    if not found:
        return None
    best = min(score for _, _, score, _ in found)
    level, quantile, _, _ = min((one for one in found if one[2] <= _SAME_SCORE * best), key=lambda one: one[3])
    return level, quantile


def not_below(levels: Levels, before: Levels | None) -> Levels:
    """Raise levels to those of a smaller coverage: the level of another class may be lower than the class's own."""
    if before is None:
        return levels
    low = max(levels.low, before.low) if levels.quantile == before.quantile else levels.low
    edge = None if levels.edge is None else max(levels.edge, before.edge or 0)
    return levels.model_copy(update={"high": max(levels.high, before.high), "edge": edge, "low": low})


def _level(fields: np.ndarray, levels: np.ndarray, coverage: float) -> float | None:
    """Smallest level that reaches a coverage, between thresholds as in `at_level`; None if none does."""
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
    """Measurement at a level: ``(thresholds, fields)`` to ``(fields,)``."""
    # Between thresholds, misses fall geometrically, since they fall nearly exponentially with the level.
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


def expected(table: np.ndarray, sweep: ThresholdSweep, levels: Levels) -> dict[str, float]:
    """Coverage of all and by class, widths in pixels and interval score with given levels; NaN without pixels."""
    assert levels.coverage is not None
    edge = {} if levels.edge is None else {"edge": at_level(table[:, EDGE], sweep.high, levels.edge)}
    classes = {"high": at_level(table[:, HIGH], sweep.high, levels.high)} | edge
    classes["low"] = at_level(table[:, LOW + QUANTILES.index(levels.quantile)], sweep.low, levels.low)
    both = np.sum(list(classes.values()), axis=0)
    if not both[COUNTS:].sum():
        return dict.fromkeys(("all", *classes, "mean_width", "median_width", "score"), np.nan)
    upto = np.cumsum(both[COUNTS:])
    return {
        **{name: _share(fields, INSIDE) for name, fields in ({"all": both} | classes).items()},
        "mean_width": _share(both, WIDTH),
        "median_width": float(WIDTHS[np.searchsorted(upto, upto[-1] / 2)]),
        "score": interval_score(both, levels.coverage),
    }


def _share(fields: np.ndarray, which: int) -> float:
    pixels = fields[COUNTS:].sum()
    return float(fields[which] / pixels) if pixels else np.nan


def left_out(
    parts: Sequence[Measured], sweep: ThresholdSweep, coverages: Iterable[float]
) -> list[dict[str, dict[str, float]]]:
    """For each coverage, the `expected` figures of each group, levels chosen on the others; none for one group."""
    groups = list(dict.fromkeys(part.group for part in parts))
    own = {group: pooled(part for part in parts if part.group == group).table for group in groups}
    rest = {group: pooled(part for part in parts if part.group != group) for group in groups if len(groups) > 1}
    return [
        {group: expected(own[group], sweep, choose(others, sweep, coverage)[0]) for group, others in rest.items()}
        for coverage in coverages
    ]


def means(groups: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Means of the figures of groups where they are known, and ``lowest``, the smallest coverage of all pixels."""
    found = list(groups)
    figures = {}
    for name in found[0] if found else ():
        known = [one[name] for one in found if np.isfinite(one[name])]
        figures[name] = float(np.mean(known)) if known else np.nan
    known = [one["all"] for one in found if np.isfinite(one["all"])]
    return figures | {"lowest": min(known, default=np.nan)} if found else {}
