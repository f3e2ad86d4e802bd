"""Matching of a patch: matching costs in, products of every pixel out (METHOD.md, sections 2 to 6)."""

from typing import NamedTuple

import numpy as np

from sat_intervals.kernels.cost import Cells, Costs, padded_to_lanes, volume_starts
from sat_intervals.kernels.penalties import Gradients
from sat_intervals.kernels.reading import RightPixels, rectangle_of
from sat_intervals.kernels.sgm import WAVEFRONTS, Borders, Edge
from sat_intervals.kernels.sweeps import Settings, Volume, new_buffers, sweep_down, sweep_up, trace_wave
from sat_intervals.products import IMPOSSIBLE_COST, NO_BOUND, NO_DISPARITY
from sat_intervals.tiling import Window


class Raw(NamedTuple):
    """Products read from single curves, all ``(rows, columns)``.

    winner: int16 disparities in pixels, NO_DISPARITY for none.
    lower, upper: uint16 bounds in steps above the first disparity of the whole search range, NO_BOUND for none.
    disparity: float32 refined disparity in pixels, NaN for none.
    cost: uint16 aggregated cost of the winner, IMPOSSIBLE_COST for none.
    ambiguity: uint32, 0 where there is no candidate.
    validity: uint16 flags, without those of the left image's mask, cross-checking and regularisation.
    lower_low, upper_low: the same at the level of low-confidence pixels; those of one level are the same arrays.
    """

    winner: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    disparity: np.ndarray
    cost: np.ndarray
    ambiguity: np.ndarray
    validity: np.ndarray
    lower_low: np.ndarray
    upper_low: np.ndarray


class RightView(NamedTuple):
    """Winners of right pixels among the left pixels of a core; ``[r, c + k]`` faces left ``(r, c)`` at k.

    cost: ``(rows, columns + count - 1)`` uint16: the smallest aggregated cost, IMPOSSIBLE_COST for none.
    winner: int16 of the same shape: its left disparity in pixels, the largest at ties; NO_DISPARITY for none.
    """

    cost: np.ndarray
    winner: np.ndarray


class Matched(NamedTuple):
    """Products of the wanted pixels, winners of the right pixels that face the core, and what `trace` returns of LAST.

    ``leaving`` is empty without borders.
    """

    raw: Raw
    right: RightView
    leaving: Edge


def _sweep(costs, gradients, settings, output, core, keep, borders, cells):
    """Run both sweeps; return what they match and the volume (finished curves only with ``keep``)."""
    size = padded_to_lanes(settings.count)
    buffers = new_buffers(costs, gradients, settings, borders, cells, True)
    shape = output.height, output.width
    # Allocated for each tile: a buffer kept between tiles (4 % faster) can pause a dask worker above its memory limit.
    starts = volume_starts(buffers.cells, output)
    volume = Volume(np.empty(starts[-1], np.uint16), starts, np.zeros(costs.left_state.shape[1], np.int64))
    bounds = [np.full(shape, NO_BOUND, np.uint16) for _ in range(4 if settings.steps > 1 else 2)]
    lower, upper, lower_low, upper_low = bounds[:2] + bounds[-2:]
    raw = Raw(
        winner=np.full(shape, NO_DISPARITY, np.int16),
        lower=lower,
        upper=upper,
        disparity=np.full(shape, np.nan, np.float32),
        cost=np.full(shape, IMPOSSIBLE_COST, np.uint16),
        ambiguity=np.zeros(shape, np.uint32),
        validity=np.zeros(shape, np.uint16),
        lower_low=lower_low,
        upper_low=upper_low,
    )
    wanted, cores = rectangle_of(output), rectangle_of(core)
    cost = np.full((core.height, core.width + size), IMPOSSIBLE_COST, np.uint16)
    right = RightPixels(cores, np.arange(size, dtype=np.uint16), cost, np.zeros(cost.shape, np.uint16))
    if settings.regularized:
        sweep_down(buffers, gradients, settings, wanted, volume)
        buffers = new_buffers(costs, gradients, settings, borders, cells, False)
    sweep_up(buffers, gradients, settings, wanted, volume, raw, right, keep)
    cost = cost[:, : core.width + settings.count - 1]
    winner = right.best[:, : cost.shape[1]].astype(np.int16) + np.int16(settings.minimum)
    winner[cost == IMPOSSIBLE_COST] = NO_DISPARITY
    return Matched(raw, RightView(cost, winner), buffers.leaving), volume.sums


def trace(
    costs: Costs, settings: Settings, borders: Borders, wavefront: int, gradients: Gradients | None, cells: Cells | None
) -> Edge:
    """Path states of one of WAVEFRONTS where it leaves ``borders.inside``; parameters as in `match_costs`."""
    down, wave = WAVEFRONTS[wavefront]
    buffers = new_buffers(costs, gradients, settings, borders, cells, down)
    trace_wave(buffers, gradients, settings, wave)
    return buffers.leaving


def match_costs(
    costs: Costs,
    settings: Settings,
    output: Window,
    core: Window | None = None,
    gradients: Gradients | None = None,
    borders: Borders | None = None,
    cells: Cells | None = None,
) -> Matched:
    """Match a patch: matching costs in, raw products and the right view's winners out.

    settings: 8 times the sum of the largest cost and the largest P2 is below IMPOSSIBLE_COST.
    output: pixels of the patch whose products are returned; the others only support them.
    core: left pixels that make the right view; by default those of ``output``.
    gradients: those that P1 and P2 follow; by default P1 and P2 are those of ``settings``.
    borders: path states around the patch; by default every path starts at the edge of the patch.
    cells: search ranges of the pixels within that of ``settings``; by default all search all of it.
    Returns ``raw`` of the shape of ``output``, ``right`` of ``(core.height, core.width + count - 1)``.
    """
    return _sweep(costs, gradients, settings, output, core or output, False, borders, cells)[0]


def cost_volume(
    costs: Costs, settings: Settings, gradients: Gradients | None = None, output: Window | None = None
) -> np.ndarray:
    """Aggregated costs of the pixels of ``output``, by default the whole patch; without SGM the matching costs.

    Parameters as in `match_costs`. Returns ``(rows, columns, count)`` uint16, IMPOSSIBLE_COST at impossible candidates.
    """
    output = output or Window(0, 0, *costs.left_state.shape)
    sums = _sweep(costs, gradients, settings, output, output, True, None, None)[1]
    return sums.reshape(output.height, output.width, -1)[:, :, : settings.count]
