"""Matching cost volume: the values of another matcher as integer costs."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sat_intervals.config import Config, ConfigError, Volume
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.cost import Costs, padded_to_lanes
from sat_intervals.match.matching_cost import Area, AreaCosts, Given, MatchingCost
from sat_intervals.products import LOG_SPAN
from sat_intervals.tiling import Views, strips

# Relative to the span: values beyond it by rounding. Of the sum of probabilities. Pixels of rows converted at a time.
_TOLERANCE = 1e-5
_SUM = 1e-3
_PIXELS = 1 << 14


def _section(config: Config) -> Volume:
    assert isinstance(config.cost, Volume)
    return config.cost


class VolumeCost(MatchingCost):
    """Values of ``volume_of``."""

    def __init__(self, config: Config, given: Given) -> None:
        super().__init__(config, given)
        self.check(config)
        if given.volume_of is None:
            name = _section(config).name
            raise SatIntervalsError(f"the costs of this run are those of {name}, which only match_pair calls")
        self._volume_of = given.volume_of

    @staticmethod
    def check(config: Config) -> None:
        """Raise if nobody named the function that makes volumes."""
        if _section(config).name is None:
            raise SatIntervalsError("cost.method is volume: use intervals_of, or give match_pair volume_of")

    def of_areas(
        self, views: Views, areas: Sequence[Area], made: Sequence[np.ndarray] | None = None
    ) -> list[AreaCosts]:
        """Make the integer costs of areas."""
        made = [self._made(views, area) for area in areas] if made is None else made
        return [external_costs(costs, area.disparities, self._config) for area, costs in zip(areas, made, strict=True)]

    def _made(self, views: Views, area: Area) -> np.ndarray:
        margin = self._config.cost.window // 2
        windows = area.base.grown(margin, margin), area.facing.grown(margin, margin)
        left, right = (
            np.ma.array(view.inner(view.pixels, there), mask=view.inner(view.state, there) != 0)
            for view, there in zip(views, windows, strict=True)
        )
        values = unmasked(self._volume_of(left, right, area.minimum))
        needed = (area.base.height, area.base.width, area.disparities)
        if values.shape != needed or values.dtype.kind not in "uif":
            raise SatIntervalsError(f"volume_of returned {values.shape} of {values.dtype}, needed are {needed} numbers")
        return integer_costs(values, self._config)


def unmasked(values: Any) -> np.ndarray:
    """Return an array, with NaN under a mask."""
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.filled(values.astype(np.result_type(values, np.float32)), np.nan)
    return np.asarray(values)


def integer_costs(
    values: np.ndarray, config: Config, blocked: np.ndarray | None = None, *, compares_pixels: bool = False
) -> np.ndarray:
    """Return the integer costs of values: ``(rows, columns, size)`` uint16, ``impossible_cost`` where not finite.

    blocked: ``(rows, columns)`` bool: pixels whose candidates are all impossible.
    Costs of probabilities are logarithms of their share of the pixel's largest, see LOG_SPAN.
    compares_pixels: whether they are those of the probabilities themselves, which pixels share.
    Raises with the number of values outside the span, or of pixels whose probabilities do not sum to 1.
    """
    cost, (height, width, count) = _section(config), values.shape
    ends, steps = (float(cost.lowest), float(cost.lowest + cost.span)), float(config.numbers.steps)
    made = np.zeros((height, width, padded_to_lanes(count)), np.uint16)
    margin = _TOLERANCE * (ends[1] - ends[0])
    outside, number = 0, np.result_type(values.dtype, np.float32)
    for window in strips(height, width, _PIXELS):
        rows = slice(window.row, window.row_stop)
        part = values[rows].astype(number)
        impossible = ~np.isfinite(part)
        if blocked is not None:
            impossible |= blocked[rows, :, np.newaxis]
        np.copyto(part, ends[0], where=impossible)
        if part.min() < ends[0] - margin or part.max() > ends[1] + margin:
            outside += int(((part < ends[0] - margin) | (part > ends[1] + margin)).sum())
        if cost.kind == "probability" and not compares_pixels:
            _check_sums(part, impossible)
            part /= np.maximum(part.max(axis=2, keepdims=True), np.finfo(np.float32).tiny)
        if cost.kind == "probability":
            part = -np.log(np.maximum(part, np.exp(-np.float32(LOG_SPAN)))) / LOG_SPAN
        else:
            part = part - ends[0] if cost.kind == "cost" else ends[1] - part
        part *= steps
        np.rint(part, out=part)
        np.clip(part, 0, config.numbers.largest, out=part)
        np.copyto(part, config.impossible_cost, where=impossible)
        made[rows, :, :count] = part
    if outside:
        raise ConfigError(f"{outside} of {values.size} values are outside {ends[0]:g} to {ends[1]:g}: give their span")
    return made


def _check_sums(probabilities: np.ndarray, impossible: np.ndarray) -> None:
    sums = probabilities.sum(axis=2, dtype=np.float64)[~impossible.all(axis=2)]
    if (wrong := np.abs(sums - 1) > _SUM).any():
        raise ConfigError(
            f"probabilities of {wrong.sum()} of {sums.size} pixels do not sum to 1 within {_SUM:g}, but to "
            f"{sums[wrong][0]:.4g} at the first: give a softmax, or kind similarity with its span"
        )


def external_costs(costs: np.ndarray, count: int, config: Config) -> AreaCosts:
    """Return what `integer_costs` makes of ``count`` candidates as costs for the kernels."""
    rows, columns = costs.shape[:2]
    possible = np.empty((rows, columns), np.int64)
    for window in strips(rows, columns, _PIXELS):
        part = slice(window.row, window.row_stop)
        possible[part] = (costs[part, :, :count] < config.impossible_cost).sum(axis=2)
    states = np.zeros((rows, columns), np.uint8), np.zeros((rows, columns + count - 1), np.uint8)
    return AreaCosts(Costs(costs, None, *states, possible), None, states[0], None)
