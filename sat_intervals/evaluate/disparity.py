"""Intervals of a run against a known truth, strip by strip, whatever the size of the images (method: section 10)."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.config import Config, Regularization
from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.metrics import Criteria, Judged, Metrics, bias_histogram
from sat_intervals.kernels.areas import area_maximum
from sat_intervals.kernels.confidence import low_confidence
from sat_intervals.match.postprocess import cut_rows, with_halo
from sat_intervals.products import Bands
from sat_intervals.results import Layer, Run, open_run

_JUDGED_PIXELS = 1 << 20  # at a time, 150 bytes each; those read and waiting are 25


def evaluate_run(
    out: str | Path,
    truth: str | Path | None = None,
    mask: str | Path | None = None,
    *,
    tolerance: float = 0.0,
    remove_bias: bool = False,
) -> dict[str, Any]:
    """Judge the intervals in the folder of a run.

    Parameters
    ----------
    out
        Folder of ``intervals.tif``, ``validity.tif`` and ``run.json``.
    truth
        True disparity of the left image, or of the run's region of it: NaN and no data are unknown. By default
        ``truth.tif`` beside the left image.
    mask
        Of the truth's size: pixels where it is 0 are not judged, such as the occluded ones.
    tolerance
        Pixels by which the truth may lie outside an interval that still counts as right.
    remove_bias
        Whether the median of disparity - truth, over valid pixels, is added to the truth first.

    Returns
    -------
    Figures over valid pixels: for ``all``, ``high`` and ``low`` confidence ``count``, ``accuracy``, ``relative_size``
    and ``mean_width`` (pixels), for ``low`` also ``relative_overestimation``; ``bad1`` and ``bad3``, the shares of
    disparities wrong by more than 1 and 3 px; ``truth_outside_range``, the share of truths that were not searched;
    ``deciles`` of confidence with their coverage. ``with_rejected`` holds the same over all pixels that have an
    interval, None unless the run wrote those of rejected pixels. ``bias`` is the bias removed (pixels), None if it was
    not asked for. ``cost`` and ``tolerance`` say what was judged and how.

    Raises
    ------
    SatIntervalsError
        No run, no truth, or sizes that do not fit.
    """
    run = open_run(out)
    config = run.config
    if config.interval is None:
        raise SatIntervalsError(f"{out} has no intervals, its setting interval is null: run match with intervals")
    if truth is None and not run.truth_beside.exists():
        left = run.report["inputs"]["left"]["path"]
        raise SatIntervalsError(f"{out}: there is no truth.tif beside its left image {left}: give --truth")
    truth_layer = run.layer(truth or run.truth_beside)
    mask_layer = None if mask is None else run.layer(mask)
    criteria = criteria_of(config, tolerance)

    def strips() -> Iterator[Bands]:
        return _read_strips(run, truth_layer, mask_layer)

    return {
        "cost": config.cost.method,
        **evaluate(strips, criteria, remove_bias=remove_bias, with_rejected=config.products.keep_rejected),
    }


def criteria_of(config: Config, tolerance: float = 0.0) -> Criteria:
    """How a run is judged; where it did not regularise, low confidence is that of the default settings."""
    low, search = config.regularization or Regularization(), config.disparity
    return Criteria(search.minimum, search.maximum, low.threshold, low.kernel, low.depth, tolerance)


def evaluate(
    strips: Callable[[], Iterable[Bands]],
    criteria: Criteria,
    *,
    remove_bias: bool = False,
    with_rejected: bool = False,
) -> dict[str, Any]:
    """Judge rows given strip by strip, from the top; ``strips`` is called once for every time they are gone through.

    Returns what `evaluate_run` does, but for ``cost``.
    """
    bias = _median_bias(strips()) if remove_bias else None
    criteria = replace(criteria, bias=bias or 0.0)
    kept, written = Metrics(criteria), Metrics(criteria)
    for rows, first, last in with_halo(strips(), criteria.depth):
        kept.add(_judged(rows, rows.known & rows.valid, first, last, criteria))
        if with_rejected:
            written.add(_judged(rows, rows.known, first, last, criteria))
    return {
        **kept.report(),
        "tolerance": criteria.tolerance,
        "bias": bias,
        "with_rejected": written.report() if with_rejected else None,
    }


def _median_bias(strips: Iterable[Bands]) -> float:
    """Median of disparity - truth over valid pixels, in pixels; 0 where there are none."""
    histogram = bias_histogram()
    for rows in strips:
        chosen = rows.known & rows.valid
        histogram.add(rows.disparity[chosen].astype(np.float64) - rows.truth[chosen])
    return histogram.median() or 0.0


def _judged(rows: Bands, chosen: np.ndarray, first: int, last: int, criteria: Criteria) -> Judged:
    """The chosen pixels of the rows ``[first, last)``; the rows around them make their low-confidence areas whole."""
    truth = rows.truth.astype(np.float64) + criteria.bias
    low = low_confidence(rows.confidence, criteria.threshold, criteria.kernel)
    error = np.where(chosen, np.abs(truth - rows.disparity), np.nan)
    area_error = area_maximum(error, low, criteria.depth)
    inner = slice(first, last)
    chosen = chosen[inner]
    disparity, lower, upper, confidence = (band[inner][chosen].astype(np.float64) for band in rows[:4])
    pixels = Bands(disparity, lower, upper, confidence, rows.validity[inner][chosen], truth[inner][chosen])
    return Judged(pixels, low[inner][chosen], area_error[inner][chosen])


def _read_strips(run: Run, truth: Layer, mask: Layer | None) -> Iterator[Bands]:
    """Strips of rows, from the top; files are read by rows of blocks, which are then cut."""
    step = max(1, _JUDGED_PIXELS // run.region.width)
    for window in run.windows():
        true = truth.read(window)
        if mask is not None:
            true[np.nan_to_num(mask.read(window)) == 0] = np.nan
        rows = run.read_bands(window)._replace(truth=true)
        for first in range(0, window.height, step):
            yield cut_rows(rows, first, first + step)
