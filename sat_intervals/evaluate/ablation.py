"""Run the paper's ablation (table 2): the effect of each part of the method, from one matching pass per pair."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from decimal import Decimal
from functools import partial
from typing import Any

import numpy as np

from sat_intervals.config import Config, Interval, Mccnn, load_config
from sat_intervals.config.pairs import Pair
from sat_intervals.config.weights import weights_file
from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.disparity import criteria_of, evaluate
from sat_intervals.evaluate.paper import METHODS
from sat_intervals.kernels.confidence import ambiguity_histogram
from sat_intervals.kernels.curves import read_alpha_cuts, read_baseline, read_right_winners, read_winners
from sat_intervals.kernels.matching import cost_volume
from sat_intervals.match.matching_cost import Area, cost_areas, view_windows
from sat_intervals.match.mccnn import load_network
from sat_intervals.match.memory import PROCESS_BYTES, check_memory, volume_bytes
from sat_intervals.match.normalization import ImageStatistics, PairStatistics, blocks, moments, statistics_of
from sat_intervals.match.patch import Frame, kernel_settings, match_right, patch_areas
from sat_intervals.match.postprocess import ConfidenceScale, RawRows, confidence_scale, cut_rows, postprocess_strips
from sat_intervals.products import NO_CANDIDATE, NO_DISPARITY, Bands
from sat_intervals.raster import Image, check_pair, open_image, read_views, read_window
from sat_intervals.tiling import Views, Window, facing

# The baseline keeps disparities whose similarity is at least 1 - 1/10 (paper section 4.1).
_BASELINE = 1, 10
# Memory beside the volume: images, codes, the raw products of all methods, and one strip of final bands.
_PIXEL_BYTES = 100
_STRIP_PIXELS = 1 << 18


def ablate_pair(pair: Pair, config: Any = None, *, tolerance: float = 0.0) -> dict[str, Any]:
    """Evaluate the paper's baseline, and the method at several levels and with regularisation, on one pair.

    All results come from one aggregated cost volume, which must fit in memory, and are evaluated on the pixels that
    pass cross-checking. The pair's search range and the method's alpha override those of ``config``; ``tolerance`` is
    that of `evaluate_run`. Returns ``cost``, and for each of METHODS the figures ``all`` of `evaluate_run`.
    """
    config = load_config(
        config, {"interval": {"alpha": 0.9}, "disparity": {"minimum": pair.minimum, "maximum": pair.maximum}}
    )
    if config.regularization is None:
        raise SatIntervalsError("regularization is null, but the ablation needs it: leave it on")
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
    areas = patch_areas(Frame.of_whole(whole), config)
    views = read_views((left, right), view_windows(areas, config))
    statistics = PairStatistics(_statistics(left), _statistics(right)) if config.cost.needs_statistics else None
    methods, scale = _all_methods(views, areas, whole, config, statistics)
    report: dict[str, Any] = {"cost": config.cost.method}
    criteria = criteria_of(config, tolerance)
    for method in METHODS:
        strips = partial(_final_strips, *_of_method(methods[method], method, config), scale, truth)
        nominal = criteria.nominal if method == "baseline" else float(method.split()[0])
        report[method] = evaluate(strips, replace(criteria, nominal=nominal))["all"]
    return report


def _statistics(image: Image) -> ImageStatistics:
    return statistics_of(moments(*read_window(image, block)) for block in blocks(image.height, image.width))


def _check_memory(whole: Window, config: Config) -> None:
    """Raise if the cost volume and the bands do not fit in memory."""
    pixels, count = whole.height * whole.width, config.disparity.count
    beyond = count - 1 if config.matches_right_view else 0
    needed = PROCESS_BYTES + volume_bytes(whole.height, whole.width + beyond, config) + _PIXEL_BYTES * pixels
    what = f"{whole.height} x {whole.width} pixels x {count} disparities"
    check_memory(needed, what, "cut the pair")


def _all_methods(
    views: Views, areas: Sequence[Area], whole: Window, config: Config, statistics: PairStatistics | None
) -> tuple[dict[str, RawRows], ConfidenceScale]:
    """Return the raw products of each of METHODS, and the scale of their confidence."""
    search, settings = config.disparity, kernel_settings(config)
    area, *of_right = areas
    network = load_network(weights_file(config.cost.weights)) if isinstance(config.cost, Mccnn) else None
    (cost,) = cost_areas(views, [area], config, statistics, network)
    volume = cost_volume(cost.costs, settings, cost.gradients)
    refine = config.refinement is not None
    winner, disparity, ambiguity = read_winners(volume, search.minimum, settings.weights, refine)
    bounds = {"baseline": read_baseline(volume, search.minimum, *_BASELINE)}
    for method in METHODS[1:]:
        level = config.model_copy(update={"interval": Interval(alpha=Decimal(method.split()[0]))}).cut_level
        assert level is not None  # there is an interval
        bounds[method] = read_alpha_cuts(volume, search.minimum, level, refine)
    seen = np.asarray(read_right_winners(volume, search.minimum))
    del volume, cost  # free memory before the right view's volume
    if of_right:
        (cost,) = cost_areas(views, of_right, config, statistics, network)
        reach = facing(whole, search.minimum, search.maximum)
        seen = match_right(cost, of_right[0], reach, settings)[0].winner
    histogram = ambiguity_histogram(ambiguity, winner != NO_DISPARITY, config.largest_ambiguity)
    assert config.ambiguity is not None  # regularisation needs it
    validity = np.where(winner == NO_DISPARITY, NO_CANDIDATE, 0).astype(np.uint16)
    methods = {
        method: RawRows(winner, lower, upper, disparity, ambiguity, validity, seen)
        for method, (lower, upper) in bounds.items()
    }
    return methods, confidence_scale(config.ambiguity, histogram)


def _of_method(rows: RawRows, method: str, config: Config) -> tuple[RawRows, Config]:
    """Return products and settings of one method: only the last is regularised, the baseline is not filtered."""
    config = config.model_copy(update={"refinement": None})  # V-fit, as in the paper, is done
    if method != METHODS[-1]:
        config = config.model_copy(update={"regularization": None})
    if method == "baseline":
        config = config.model_copy(update={"median": None})
        rows = rows._replace(disparity=rows.winner.astype(np.float32))  # the baseline does not refine
    return rows, config


def _final_strips(rows: RawRows, config: Config, scale: ConfidenceScale, truth: Image) -> Iterator[Bands]:
    """Yield final bands and truth strip by strip: whole, they would need as much memory as the volume."""
    height, width = rows.winner.shape
    step = max(1, _STRIP_PIXELS // width)
    row = 0
    strips = (cut_rows(rows, first, first + step) for first in range(0, height, step))
    for final in postprocess_strips(strips, scale, config):
        pixels, state = read_window(truth, Window(row, 0, final.validity.shape[0], width))
        yield final._replace(truth=np.where(state == 0, pixels.astype(np.float64), np.nan))
        row += final.validity.shape[0]
