"""What each part of the method is worth: the paper's ablation, in one matching pass a pair (paper, table 2)."""

from collections.abc import Iterator, Sequence
from decimal import Decimal
from functools import partial
from typing import Any

import numpy as np

from sat_intervals.config import Config, Interval, Mccnn, load_config
from sat_intervals.config.pairs import Pair
from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.disparity import criteria_of, evaluate
from sat_intervals.evaluate.paper import METHODS
from sat_intervals.kernels.confidence import ambiguity_histogram
from sat_intervals.kernels.curves import read_alpha_cuts, read_baseline, read_right_winners, read_winners
from sat_intervals.kernels.matching import cost_volume
from sat_intervals.match.matching_cost import Area, View, Views, cost_areas, view_windows
from sat_intervals.match.memory import PROCESS_BYTES, check_memory, volume_bytes
from sat_intervals.match.normalization import PairStatistics, blocks, moments, statistics_of
from sat_intervals.match.patch import kernel_settings, match_right, patch_areas
from sat_intervals.match.postprocess import ConfidenceScale, RawRows, confidence_scale, cut_rows, postprocess_strips
from sat_intervals.products import NO_CANDIDATE, NO_DISPARITY, Bands
from sat_intervals.raster import Image, check_pair, open_image, read_window
from sat_intervals.tiling import Window

# The baseline keeps disparities whose similarity is at least 1 - 1/10 (paper section 4.1).
_BASELINE = 1, 10
# Beside the volume: images on their way, codes, and the raw products of all methods; of the final bands only a strip.
_PIXEL_BYTES = 100
_STRIP_PIXELS = 1 << 18


def ablate_pair(pair: Pair, config: Any = None, *, tolerance: float = 0.0) -> dict[str, Any]:
    """Judge the paper's baseline, and the method at several levels with and without its regularisation, on one pair.

    All of them are read off one aggregated volume, which must fit in memory, and judged on the same pixels: those that
    pass cross-checking.

    Parameters
    ----------
    pair
        Images, truth and search range.
    config
        Settings, or what `load_config` makes them from; the pair's search range and the method's alpha win.
    tolerance
        Pixels by which the truth may lie outside an interval that still counts as right.

    Returns
    -------
    For each of METHODS ``count``, ``accuracy``, ``relative_size`` and ``mean_width``, as `evaluate_run`; and ``cost``.

    Raises
    ------
    SatIntervalsError
        Images that are no pair, settings without the parts compared, or a volume larger than the memory.
    """
    config = load_config(config, {"disparity": {"minimum": pair.minimum, "maximum": pair.maximum}})
    if config.regularization is None:
        raise SatIntervalsError("regularization is null: the ablation compares with and without it, leave it on")
    left, right, truth = (open_image(path) for path in (pair.left, pair.right, pair.truth))
    check_pair(left, right, config.disparity.count)
    config.disparity.check_images(left.path, left.width, right.path, right.width)
    if (truth.height, truth.width) != (left.height, left.width):
        raise SatIntervalsError(
            f"{truth.path} has {truth.height} x {truth.width} pixels, {left.path} {left.height} x {left.width}: "
            "give the truth of the left image"
        )
    whole = Window(0, 0, left.height, left.width)
    _check_memory(whole, config)
    areas = patch_areas(whole, whole, config)
    windows = zip((left, right), view_windows(areas, config), strict=True)
    left_view, right_view = (View(window, *read_window(image, window)) for image, window in windows)
    methods, scale = _all_methods((left_view, right_view), areas, whole, config, _statistics((left, right), config))
    report: dict[str, Any] = {"cost": config.cost.method}
    criteria = criteria_of(config, tolerance)
    for method in METHODS:
        strips = partial(_evaluated, *_settled(methods[method], method, config), scale, truth)
        report[method] = evaluate(strips, criteria)["all"]
    return report


def _statistics(images: Sequence[Image], config: Config) -> PairStatistics | None:
    if not isinstance(config.cost, Mccnn):
        return None
    return PairStatistics(
        *(
            statistics_of(moments(*read_window(image, block)) for block in blocks(image.height, image.width))
            for image in images
        )
    )


def _check_memory(whole: Window, config: Config) -> None:
    """Refuse a pair without memory for the volume, the right view's own if there is one, and the bands."""
    pixels, count = whole.height * whole.width, config.disparity.count
    beyond = count - 1 if config.cross_check and config.cross_check.method == "accurate" else 0
    needed = PROCESS_BYTES + volume_bytes(whole.height, whole.width + beyond, config) + _PIXEL_BYTES * pixels
    what = f"{whole.height} x {whole.width} pixels x {count} disparities"
    check_memory(needed, what, "cut the pair")


def _all_methods(
    views: Views, areas: Sequence[Area], whole: Window, config: Config, statistics: PairStatistics | None
) -> tuple[dict[str, RawRows], ConfidenceScale]:
    """Raw products of every one of METHODS, and what their confidence is relative to."""
    search, settings = config.disparity, kernel_settings(config)
    area, *of_right = areas
    (cost,) = cost_areas(views, [area], config, statistics)
    volume = cost_volume(cost.costs, settings, cost.gradients)
    refine = config.refinement is not None
    winner, disparity, ambiguity = read_winners(volume, search.minimum, settings.weights, refine)
    bounds = {"baseline": read_baseline(volume, search.minimum, *_BASELINE)}
    for method in METHODS[1:]:
        level = config.model_copy(update={"interval": Interval(alpha=Decimal(method.split()[0]))}).cut_level
        assert level is not None  # there is an interval
        bounds[method] = read_alpha_cuts(volume, search.minimum, level, refine)
    seen = np.asarray(read_right_winners(volume, search.minimum))
    del volume, cost  # before the right view has its own
    if of_right:
        (cost,) = cost_areas(views, of_right, config, statistics)
        seen = match_right(cost, of_right[0], whole, settings).winner
    histogram = ambiguity_histogram(ambiguity, winner != NO_DISPARITY, config.largest_ambiguity)
    assert config.ambiguity is not None  # regularisation needs it
    validity = np.where(winner == NO_DISPARITY, NO_CANDIDATE, 0).astype(np.uint16)
    methods = {
        method: RawRows(winner, lower, upper, disparity, ambiguity, validity, seen)
        for method, (lower, upper) in bounds.items()
    }
    return methods, confidence_scale(config.ambiguity, histogram)


def _settled(rows: RawRows, method: str, config: Config) -> tuple[RawRows, Config]:
    """What one method finishes: only the last has its intervals regularised, the baseline not even filtered."""
    if method != METHODS[-1]:
        config = config.model_copy(update={"regularization": None})
    if method == "baseline":
        config = config.model_copy(update={"median": None})
        rows = rows._replace(disparity=rows.winner.astype(np.float32))  # no refinement that bounds had to follow
    return rows, config


def _evaluated(rows: RawRows, config: Config, scale: ConfidenceScale, truth: Image) -> Iterator[Bands]:
    """Final bands and truth, strip by strip: whole they would take as much as the volume."""
    height, width = rows.winner.shape
    step = max(1, _STRIP_PIXELS // width)
    row = 0
    strips = (cut_rows(rows, first, first + step) for first in range(0, height, step))
    for final in postprocess_strips(strips, scale, config):
        pixels, state = read_window(truth, Window(row, 0, final.validity.shape[0], width))
        yield final._replace(truth=np.where(state == 0, pixels.astype(np.float64), np.nan))
        row += final.validity.shape[0]
