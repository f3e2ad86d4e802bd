"""Evaluate the intervals of a run against a known truth, strip by strip (METHOD.md, section 10)."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.config import Config, Regularization
from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.metrics import Criteria, Metrics
from sat_intervals.kernels.areas import area_maximum
from sat_intervals.kernels.confidence import low_confidence
from sat_intervals.match.histogram import bias_histogram
from sat_intervals.match.postprocess import cut_rows, with_halo
from sat_intervals.products import Bands
from sat_intervals.raster import Layer
from sat_intervals.results import Run, open_run

_PIXELS = 1 << 20  # evaluated at a time, 150 bytes each; pixels read ahead take 25 bytes


def evaluate_run(
    out: str | Path,
    truth: str | Path | None = None,
    mask: str | Path | None = None,
    *,
    tolerance: float = 0.0,
    remove_bias: bool = False,
) -> dict[str, Any]:
    """Evaluate the intervals of a run.

    Parameters
    ----------
    out
        Folder of ``intervals.tif``, ``validity.tif`` and ``run.json``.
    truth
        True disparity of the left image or of the run's region; NaN and no data mean unknown. By default ``truth.tif``
        beside the left image.
    mask
        A raster as large as the truth: pixels where it is 0, such as occluded ones, are left out.
    tolerance
        Distance in pixels up to which a truth outside an interval counts as inside.
    remove_bias
        Whether to add the median of disparity - truth over valid pixels to the truth first.

    Returns
    -------
    Figures over valid pixels: for ``all``, ``high`` and ``low`` confidence ``count``, ``accuracy``, ``relative_size``,
    ``mean_width``, ``median_width`` and ``interval_score`` (pixels), for ``low`` also ``relative_overestimation``;
    ``bad1`` and ``bad3``, the shares of disparities wrong by more than 1 and 3 px; ``truth_outside_range``, the share
    of truths outside the search range; ``locking``, how much more often disparities wrong by at most 1 px are near
    whole pixels than truths, 0 alike and 1 whole pixels only; ``deciles`` of confidence with their coverage.
    ``with_rejected`` contains the same over all pixels with an interval, None unless the run kept rejected pixels.
    ``median_error`` is the median of disparity - truth that is left, ``bias`` the one removed before (pixels), None
    without ``remove_bias``. ``truth_is_whole`` is true if all truths of valid pixels are whole numbers. ``nominal`` is
    the coverage or the alpha of the run, as ``nominal_is`` says, for which ``interval_score`` judges. ``cost`` and
    ``tolerance`` are the settings used.

    Raises
    ------
    SatIntervalsError
        The folder is not a run, there is no truth, or sizes do not fit.
    """
    run = open_run(out)
    run.check_pair()
    config = run.config
    if config.interval is None:
        raise SatIntervalsError(f"{out} has no intervals, its setting interval is null: run match with intervals")
    if truth is None and not run.truth_beside.exists():
        left = run.report["inputs"]["left"]["path"]
        raise SatIntervalsError(f"{run.out}: there is no truth.tif beside its left image {left}: give a truth")
    strips = partial(_read_strips, run, run.layer(truth or run.truth_beside), None if mask is None else run.layer(mask))
    criteria = criteria_of(config, tolerance)
    figures = evaluate(strips, criteria, remove_bias=remove_bias, with_rejected=config.products.keep_rejected)
    nominal_is = "alpha" if config.interval.coverage is None else "coverage"
    return {"cost": config.cost.method, "nominal_is": nominal_is, **figures}


def criteria_of(config: Config, tolerance: float = 0.0) -> Criteria:
    """Return the criteria for a run; without regularisation, low confidence follows the default settings."""
    low = config.regularization or Regularization()
    search = config.disparity
    interval = config.interval
    level = None if interval is None else interval.coverage or interval.alpha
    nominal = None if level is None else float(level)
    return Criteria(search.minimum, search.maximum, low.threshold, low.kernel, low.depth, tolerance, nominal=nominal)


def evaluate(
    strips: Callable[[], Iterable[Bands]],
    criteria: Criteria,
    *,
    remove_bias: bool = False,
    with_rejected: bool = False,
) -> dict[str, Any]:
    """Return the figures of `evaluate_run` without ``cost``; each call of ``strips`` yields the rows from the top."""
    bias = _median_bias(strips()) if remove_bias else None
    criteria = replace(criteria, bias=bias or 0.0)
    kept, written = Metrics(criteria), Metrics(criteria)
    is_whole, errors = True, bias_histogram()
    for rows, first, last in with_halo(strips(), criteria.depth):
        chosen = rows.known & rows.valid
        is_whole = is_whole and bool((rows.truth[chosen] % 1 == 0).all())
        kept.add(*_evaluated(rows, chosen, first, last, criteria))
        inner = slice(first, last)
        errors.add((rows.disparity[inner].astype(np.float64) - rows.truth[inner] - criteria.bias)[chosen[inner]])
        if with_rejected:
            written.add(*_evaluated(rows, rows.known, first, last, criteria))
    report = kept.report()
    return {
        **report,
        "truth_is_whole": is_whole and report["all"]["count"] > 0,
        "tolerance": criteria.tolerance,
        "nominal": criteria.nominal,
        "median_error": errors.median(),
        "bias": bias,
        "with_rejected": written.report() if with_rejected else None,
    }


def _median_bias(strips: Iterable[Bands]) -> float:
    """Return the median of disparity - truth over valid pixels, in pixels; 0 if there are none."""
    histogram = bias_histogram()
    for rows in strips:
        chosen = rows.known & rows.valid
        histogram.add(rows.disparity[chosen].astype(np.float64) - rows.truth[chosen])
    return histogram.median() or 0.0


def _evaluated(
    rows: Bands, chosen: np.ndarray, first: int, last: int, criteria: Criteria
) -> tuple[Bands, np.ndarray, np.ndarray]:
    """Return the chosen pixels of rows ``[first, last)``, see `Metrics.add`; the other rows complete their areas."""
    truth = rows.truth.astype(np.float64) + criteria.bias
    low = low_confidence(rows.confidence, criteria.threshold, criteria.kernel)
    error = np.where(chosen, np.abs(truth - rows.disparity), np.nan)
    area_error = area_maximum(error, low, criteria.depth)
    inner = slice(first, last)
    chosen = chosen[inner]
    disparity, lower, upper, confidence = (band[inner][chosen].astype(np.float64) for band in rows[:4])
    pixels = Bands(disparity, lower, upper, confidence, rows.validity[inner][chosen], truth[inner][chosen])
    return pixels, low[inner][chosen], area_error[inner][chosen]


def _read_strips(run: Run, truth: Layer, mask: Layer | None) -> Iterator[Bands]:
    """Yield strips of rows from the top; files are read by rows of blocks, which are then cut."""
    step = max(1, _PIXELS // run.region.width)
    for window in run.windows():
        true = truth.read(window)
        if mask is not None:
            true[np.nan_to_num(mask.read(window)) == 0] = np.nan
        rows = run.read_bands(window)._replace(truth=true)
        for first in range(0, window.height, step):
            yield cut_rows(rows, first, first + step)
