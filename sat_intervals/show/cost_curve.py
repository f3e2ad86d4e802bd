"""Match one pixel again: its cost curve and the interval derived from it (paper eq. 5 to 9)."""

from typing import NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.matching import cost_volume, match_costs
from sat_intervals.kernels.sweeps import Settings
from sat_intervals.match.costs import cost_of
from sat_intervals.match.matching_cost import Area, Given
from sat_intervals.match.normalization import PairStatistics
from sat_intervals.match.patch import kernel_settings
from sat_intervals.products import FLAGS, IMPOSSIBLE_COST, REGULARIZED
from sat_intervals.raster import read_views
from sat_intervals.results import Results
from sat_intervals.tiling import Window


class Curve(NamedTuple):
    """The cost curve of a pixel, its disparity and interval (pixels) before median filter and regularisation.

    ``costs`` (float64, aggregated by SGM if the run uses it) and ``possibilities`` (0 to 1) belong to the integers
    ``disparities``, NaN where a candidate is impossible; those of ``cut`` reach ``level``. Without intervals, level and
    bounds are NaN, and the cut is empty.
    """

    disparities: np.ndarray
    costs: np.ndarray
    possibilities: np.ndarray
    level: float
    cut: np.ndarray
    disparity: float
    lower: float
    upper: float


def read_curve(results: Results, row: int, column: int) -> Curve:
    """Match a pixel again with those that support it; as SGM reaches beyond, the run's curve may differ slightly."""
    results.check_pixel(row, column)
    config = results.config
    overlap = config.tiles.support
    pixel = Window(results.region.row + row, results.region.column + column, 1, 1)
    base = pixel.grown(overlap, overlap).clipped(Window(0, 0, results.left.height, results.left.width))
    area = Area.of(base, config)
    settings = kernel_settings(config)
    normalization = results.report.get("normalization")
    statistics = PairStatistics.of_report(normalization) if normalization else None
    cost = cost_of(config, Given(statistics, results.report["inputs"]))
    (costs,) = cost.of_areas(read_views((results.left, results.right), cost.windows([area])), [area])
    there = pixel.relative_to(base)
    curve = cost_volume(costs.costs, settings, costs.gradients, there)[0, 0]
    possible = curve != IMPOSSIBLE_COST
    if not possible.any():
        validity = int(results.read_pixel(row, column).validity)
        reasons = "; ".join(flag.meaning for flag in FLAGS if flag.invalid and validity & flag.value)
        where = f"row {row}, column {column} has no cost curve"
        raise SatIntervalsError(f"{where}: {reasons}: choose a pixel that was matched")
    values = np.where(possible, curve.astype(np.float64), np.nan)
    above = values - np.nanmin(values)
    is_low = bool(results.read_pixel(row, column).validity & REGULARIZED)
    largest = _largest_above(settings, is_low)
    raw = match_costs(costs.costs, settings, there, gradients=costs.gradients).raw
    bounds = (raw.lower_low, raw.upper_low) if is_low else (raw.lower, raw.upper)
    lower, upper = (settings.minimum + bound.item() / settings.steps for bound in bounds)
    alpha = config.interval and config.interval.alpha
    return Curve(
        disparities=np.arange(settings.minimum, settings.minimum + settings.count),
        costs=values,
        possibilities=np.maximum(1 - above / config.cost_span, 0),
        level=float(alpha or np.maximum(1 - largest / config.cost_span, 0)),
        cut=above <= largest,
        disparity=raw.disparity.item(),
        lower=np.nan if np.isnan(largest) else lower,
        upper=np.nan if np.isnan(largest) else upper,
    )


def _largest_above(settings: Settings, is_low: bool) -> float:
    """Return the largest cost above the lowest that belongs to the cut of a pixel's class; NaN without intervals."""
    if settings.steps > 1:
        return settings.low if is_low else settings.high
    return settings.cut_level if settings.cut_level >= 0 else np.nan
