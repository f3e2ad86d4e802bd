"""Raw products of one patch: the windows that it needs, its costs, its match, its right view."""

from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config, CosineSgm, Sgm
from sat_intervals.kernels.matching import Raw, RightView, Settings, match_costs
from sat_intervals.kernels.sgm import Borders
from sat_intervals.match.matching_cost import Area, MatchingCost, cost_areas, view_windows
from sat_intervals.match.normalization import PairStatistics
from sat_intervals.products import LEFT_MASKED, MASKED, NO_DISPARITY
from sat_intervals.tiling import Views, Window, facing


class Patch(NamedTuple):
    """Raw products of a core.

    Attributes
    ----------
    raw
        Products of the pixels of ``output``.
    output
        The core and, inside the region, a ring of one pixel around it, which neighbours compute too.
    right
        The right view among the core's left pixels.
    """

    raw: Raw
    output: Window
    right: RightView


def kernel_settings(config: Config) -> Settings:
    """Convert a configuration to the settings of the kernels."""
    cuts = config.cuts
    # penalties that follow gradients come with these
    constant = config.sgm if isinstance(config.sgm, Sgm | CosineSgm) else None
    return Settings(
        minimum=config.disparity.minimum,
        count=config.disparity.count,
        impossible=config.impossible_cost,
        p1=config.in_steps(constant.p1) if constant else 0,
        p2=config.in_steps(constant.p2) if constant else 0,
        regularized=config.sgm is not None,
        cut_level=-1 if cuts or config.cut_level is None else config.cut_level,
        weights=np.zeros(0, np.uint16) if config.ambiguity_weights is None else config.ambiguity_weights,
        refine=config.refinement is not None,
        high=cuts.high if cuts else -1.0,
        low=cuts.low if cuts and config.subpixel_levels == 2 else -1.0,
        steps=config.bound_steps,
    )


def path_window(core: Window, region: Window, whole: Window, config: Config) -> Window:
    """Pixels whose paths a tile computes: its core and, at the ends of the region, the pixels that support it."""
    around = _supported(region, whole, config)
    row = around.row if core.row == region.row else core.row
    column = around.column if core.column == region.column else core.column
    row_stop = around.row_stop if core.row_stop == region.row_stop else core.row_stop
    column_stop = around.column_stop if core.column_stop == region.column_stop else core.column_stop
    return Window(row, column, row_stop - row, column_stop - column)


def patch_window(core: Window, region: Window, whole: Window, config: Config) -> Window:
    """Pixels that a tile reads: those of `path_window` and one more on each side where another tile follows."""
    return path_window(core, region, whole, config).grown(1, 1).clipped(_supported(region, whole, config))


def _supported(region: Window, whole: Window, config: Config) -> Window:
    return region.grown(config.tiles.support, config.tiles.support).clipped(whole)


def patch_areas(core: Window, region: Window, whole: Window, config: Config) -> list[Area]:
    """Area of a core with what it reads around it and, for accurate cross-checking, that of the right view.

    ``whole`` is the window of all left pixels. The area may leave the region, but not the image.
    """
    overlap = config.tiles.overlap
    if overlap == "exact":
        return [Area.of(patch_window(core, region, whole, config), config)]
    areas = [Area.of(core.grown(overlap, overlap).clipped(whole), config)]
    if config.cross_check and config.cross_check.method == "accurate":
        areas.append(_right_area(core, whole, overlap, config))
    return areas


def _right_area(core: Window, whole: Window, overlap: int, config: Config) -> Area:
    """Area of the right pixels that face a core, with their overlap; they may be outside the right image."""
    search = config.disparity
    reach = facing(core, search.minimum, search.maximum)
    rows = Window(whole.row, reach.column - overlap, whole.height, reach.width + 2 * overlap)
    return Area.mirror(reach.grown(overlap, overlap).clipped(rows), config)


def patch_windows(core: Window, region: Window, whole: Window, config: Config) -> tuple[Window, Window]:
    """Windows of both images that matching a core needs; see `patch_areas`."""
    return view_windows(patch_areas(core, region, whole, config), config)


def match_patch(
    views: Views,
    core: Window,
    region: Window,
    whole: Window,
    config: Config,
    statistics: PairStatistics | None = None,
    borders: Borders | None = None,
) -> Patch:
    """Match a core.

    Parameters
    ----------
    views
        Both images in the `patch_windows` of the core.
    core
        Left pixels whose products are kept.
    region
        Left pixels of the whole run.
    whole
        All pixels of the left image.
    config
        Settings.
    statistics
        Mean and standard deviation of the whole images; None if the matching cost needs none.
    borders
        Path states of the neighbours; by default every path starts where the patch does.
    """
    settings = kernel_settings(config)
    output = core if config.tiles.overlap == "exact" else core.grown(1, 1).clipped(region)
    area, *of_right = patch_areas(core, region, whole, config)
    cost, *cost_of_right = cost_areas(views, [area, *of_right], config, statistics)
    wants_fast = config.cross_check is not None and config.cross_check.method == "fast"
    right_core = core if wants_fast else Window(core.row, core.column, 0, 0)
    raw, right_view = match_costs(
        cost.costs, settings, output.relative_to(area.base), right_core.relative_to(area.base), cost.gradients, borders
    )
    inside = output.relative_to(area.base).slices
    raw.validity[cost.state[inside] & MASKED != 0] |= LEFT_MASKED
    _mark_ambiguous(raw, cost.textureless[inside], config)
    if of_right:
        right_view = match_right(cost_of_right[0], of_right[0], core, settings)
    return Patch(raw, output, right_view)


def _mark_ambiguous(raw: Raw, textureless: np.ndarray, config: Config) -> None:
    """Set the interval of textureless pixels to the whole search range, and their ambiguity to the largest."""
    if not textureless.any():
        return
    ambiguous = textureless & (raw.winner != NO_DISPARITY)
    if config.interval:
        search, steps = config.disparity, config.bound_steps
        first, last = (0, steps * (search.count - 1)) if steps else (search.minimum, search.maximum)
        raw.lower[ambiguous], raw.upper[ambiguous] = first, last
        if config.subpixel_levels == 2:
            raw.lower_low[ambiguous], raw.upper_low[ambiguous] = first, last
    raw.ambiguity[ambiguous] = config.largest_ambiguity


def match_right(cost: MatchingCost, area: Area, core: Window, settings: Settings) -> RightView:
    """Match the right view of a core with its own volume: the images swap, and disparities change sign."""
    maximum = settings.minimum + settings.count - 1
    mirrored = settings._replace(
        minimum=-maximum, cut_level=-1, low=-1.0, steps=0, weights=np.zeros(0, np.uint16), refine=False
    )
    reach = facing(core, settings.minimum, maximum).relative_to(area.base)
    raw, _ = match_costs(cost.costs, mirrored, reach, reach, cost.gradients)
    return RightView(raw.cost, np.where(raw.winner == NO_DISPARITY, NO_DISPARITY, -raw.winner).astype(np.int16))
