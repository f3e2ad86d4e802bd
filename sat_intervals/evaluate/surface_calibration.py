"""Calibrate the intervals of a surface model in metres, against reference heights.

The margins are those of split-conformal prediction, by class of relief and half width; of few or noisy heights a single
factor of the half widths. Expected figures are those of blocks of ground that were held out.
"""

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sat_intervals.config import HeightCalibration, HeightClass, surface_key
from sat_intervals.config.calibration import COVERAGES
from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.accuracy import NARROWEST, Heights, coverage_of
from sat_intervals.evaluate.comparison import (
    Comparison,
    check_common,
    compared,
    open_comparison,
    registered,
    shared_errors,
    tiles,
)
from sat_intervals.evaluate.points import summary_of
from sat_intervals.kernels.conformal import Margins, least_number, limits_between, margin_of, widened
from sat_intervals.raster import read_tags

_NOISY = 0.5  # half widths: standard deviations of points up to which factors hold
_MOST = 1 << 20  # heights that are used: a sample, if there are more
# Misses of a factor; heights below so many times those of a class have a factor, not classes.
_MISSES, _FEW = 2, 4
_CLASSES = 4  # of relief, and of half width in each, fewer with few cells


class Fit(NamedTuple):
    """Margins, and the number of cells of each class: of each class of relief ``(n,)``."""

    margins: Margins
    cells: tuple[np.ndarray, ...]

    def classes(self) -> tuple[HeightClass, ...]:
        """Return the classes of a calibration."""
        relief, *parts, _ = self.margins
        return tuple(
            HeightClass(relief_below=below, half_width_below=limit, margin=float(margin), cells=round(float(cells)))
            for below, *kinds in zip([*relief.tolist(), None], *parts, self.cells, strict=True)
            for limit, margin, cells in zip([*kinds[0].tolist(), None], *kinds[1:], strict=True)
        )


def calibrate_surface(
    surface: str | Path,
    reference: str | Path,
    name: str,
    *,
    coverage: float | None = None,
    registers: bool = True,
    reference_sigma: float | None = None,
) -> HeightCalibration:
    """Find the margins with which the intervals of a surface model contain a share of reference heights.

    Parameters
    ----------
    surface
        File of `make_surface`, made without a calibration and without a largest width.
    reference, registers, reference_sigma
        As for `evaluate_surface`.
    name
        Name of the calibration, which a surface made with it has in its tags.
    coverage
        Share of heights to be inside, 0.5 to 0.99; by default that of the surface's runs.

    Returns
    -------
    The calibration, for `SurfaceChoices`: ``classes`` have margins in metres. Its ``provenance`` has the
    files, the shift of the reference, and figures: ``before`` and ``expected``, those of blocks of ground with the
    margins of the other blocks (None with too few cells): coverage, median and mean half width in metres; ``lowest``,
    the smallest coverage of a block; ``warnings``, lines.

    Raises
    ------
    SatIntervalsError
        A file cannot be used, or too few cells have an interval and a reference height.
    """
    given = open_comparison(surface, reference, sigma=reference_sigma)
    tags = read_tags(given.surface)
    coverage = _checked_coverage(given.surface, tags, coverage)
    moved, warnings = registered(given) if registers else (given, [])
    is_moved = moved.registration is not None
    sample, cells_of_height = _sample(moved)
    warnings += shared_errors(given) + _datum_warnings(moved, sample)
    sample = sample.of(np.isfinite(sample.half_width))
    warnings += _noise_warnings(sample)
    fit = fitted(sample, cells_of_height, coverage)
    if fit is None:
        once = f" (those in a pixel of {given.resolution:.3g} m count as one)" if _coarser(given) > 1 else ""
        raise SatIntervalsError(
            f"{round(sample.height.size * cells_of_height)} cells of {given.surface} have an interval and a height in "
            f"{given.reference}{once}, {least_number(coverage, _MISSES)} are needed for coverage {coverage:g}: give a "
            "larger reference"
        )
    provenance = {
        "software": f"sat-intervals {version('sat-intervals')}",
        "surface": str(given.surface),
        "reference": str(given.reference),
        "points": None if given.points is None else summary_of(given.points),
        "shift": [round(value, 3) for value in moved.shift] if is_moved else None,
        "before": _figures(sample),
        "expected": _expected(sample, cells_of_height, coverage),
        "warnings": warnings,
    }
    return HeightCalibration(
        name=name,
        coverage=coverage,
        registered=is_moved,
        surface=surface_key(tags, given.cell),
        factor=fit.margins.factor,
        classes=fit.classes(),
        provenance=provenance,
    )


def _checked_coverage(surface: Path, tags: Mapping[str, str], coverage: float | None) -> float:
    """Return the coverage to reach; raise if it or the surface cannot be used."""
    options = {"CALIBRATION": "--calibration", "MAX_WIDTH": "--max-width", "FILLED": "--fill", "FLATTENED": "--flatten"}
    for tag, option in options.items():
        if tag in tags:
            raise SatIntervalsError(f"{surface} was made with {option}: make it without, then calibrate it")
    if coverage is None and "COVERAGE" not in tags:
        raise SatIntervalsError(f"{surface} has no coverage, its runs were matched without one: give --coverage")
    coverage = float(tags["COVERAGE"]) if coverage is None else coverage
    if not COVERAGES[0] <= coverage <= COVERAGES[-1]:
        raise SatIntervalsError(f"coverage is {coverage:g}, allowed: {COVERAGES[0]} to {COVERAGES[-1]}")
    return coverage


def _coarser(given: Comparison) -> float:
    """Return the cells along a pixel of the reference, at least 1."""
    return max(1.0, round(given.resolution / given.cell, 3))


def _sample(given: Comparison) -> tuple[Heights, float]:
    """Return heights, `_MOST` at most by chance, and the cells that one stands for."""
    random = np.random.default_rng(0)
    parts = [np.empty((len(Heights._fields), 0))]
    common = 0
    gathered = 0
    share = 1.0
    for window in tiles(given):
        values = np.stack(compared(given, window).cells)
        common += values.shape[1]
        parts.append(values[:, random.random(values.shape[1]) < share])
        gathered += parts[-1].shape[1]
        while gathered > _MOST:
            share /= 2
            parts = [part[:, random.random(part.shape[1]) < 0.5] for part in parts]
            gathered = sum(part.shape[1] for part in parts)
    sample = Heights(*np.concatenate(parts, axis=1))
    cells_of_all = common / (given.finer * _coarser(given)) ** 2
    return sample, min(1.0, cells_of_all / max(1, sample.height.size))


def _datum_warnings(given: Comparison, sample: Heights) -> list[str]:
    """Return a warning if the heights differ by as much as two datums do; raise if the reference was not moved."""
    median = float(np.median(sample.height - sample.reference)) + given.shift[2] if sample.height.size else None
    warnings = check_common(given, sample.height.size, median)
    if warnings and not given.registration:
        raise SatIntervalsError(f"{warnings[0]}, make the surface with --geoid, or leave out --no-register")
    return warnings


def _noise_warnings(sample: Heights) -> list[str]:
    """Return a warning if noise of points hides the true errors: on simulated ones coverage .9 became .81."""
    noise = np.median(sample.sigma / np.maximum(sample.half_width, NARROWEST)) if sample.height.size else 0.0
    if noise <= _NOISY:
        return []
    return [f"errors of the points are {noise:.2g} half widths: intervals may be too narrow, give more accurate points"]


def fitted(sample: Heights, cells_of_height: float, coverage: float) -> Fit | None:
    """Return margins by classes of relief and half width, of fewer classes with few cells; None with too few."""
    half, least = sample.half_width, least_number(coverage) / cells_of_height
    if half.size * cells_of_height < least_number(coverage, _MISSES):
        return None
    if sample.sigma.any() or half.size < _FEW * least:
        factor = np.ceil(1000 * _factor(sample, cells_of_height, coverage)) / 1000
        return Fit(Margins.of_factor(float(factor)), (np.array([cells_of_height * half.size]),))
    relief = limits_between(sample.relief, _CLASSES, least)
    limits, margins, cells = [], [], []
    for kind in range(relief.size + 1):
        own = np.searchsorted(relief, sample.relief, side="right") == kind
        limits.append(limits_between(half[own], _CLASSES, least))
        classes, outside = np.searchsorted(limits[-1], half[own], side="right"), sample.outside[own]
        found = [margin_of(outside[classes == number], coverage) for number in range(limits[-1].size + 1)]
        margins.append(np.ceil(1000 * np.array(found)) / 1000)  # millimetres
        cells.append(cells_of_height * np.bincount(classes))
    return Fit(Margins(relief, tuple(limits), tuple(margins)), tuple(cells))


def _factor(sample: Heights, cells_of_height: float, coverage: float) -> float:
    """Return the factor of half widths with which intervals, about their middles, contain a share of true heights."""
    if not sample.sigma.any():
        half = np.maximum(sample.half_width, NARROWEST)
        return 1 + margin_of(sample.outside / half, coverage)
    count = cells_of_height * sample.height.size  # the rank of split-conformal prediction
    return sample.true_errors().factor(min(np.ceil((count + 1) * coverage) / count, 1 - 0.5 / count))


def held_out(sample: Heights, cells_of_height: float, coverage: float) -> Heights | None:
    """Return the sample with margins of the other blocks of ground; None if the others have too few cells."""
    lower, upper = np.full((2, sample.height.size), np.nan)
    for own in (sample.block == number for number in np.unique(sample.block)):
        fit = fitted(sample.of(~own), cells_of_height, coverage)
        if fit is None:
            return None
        part = sample.of(own)
        lower[own], upper[own] = widened(*part[:3], fit.margins.of(part.half_width, part.relief))
    return sample._replace(lower=lower, upper=upper)


def _expected(sample: Heights, cells_of_height: float, coverage: float) -> dict[str, float | None] | None:
    """Return figures of intervals that were held out, and the smallest coverage of a block with enough cells."""
    found = held_out(sample, cells_of_height, coverage)
    if found is None:
        return None
    blocks = [found.of(found.block == number) for number in np.unique(found.block)]
    shares = [coverage_of(one)[0] for one in blocks if one.height.size * cells_of_height >= least_number(coverage)]
    of_blocks = [share for share in shares if share is not None]
    return _figures(found) | {"lowest": round(min(of_blocks), 4) if of_blocks else None}


def _figures(sample: Heights) -> dict[str, float | None]:
    """Return coverage of true heights and its standard error, median and mean half width of intervals."""
    coverage, deviation = coverage_of(sample)
    half = sample.half_width
    figures = {"coverage": coverage, "deviation": deviation, "median_half_width": np.median(half)}
    figures |= {"mean_half_width": half.mean()}
    return {name: None if value is None else round(float(value), 4) for name, value in figures.items()}
