"""One patch of two images to raw products: read, compare, match, and what the neighbours need to know."""

from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config, CosineSgm, Sgm
from sat_intervals.kernels.matching import Raw, RightView, Settings, match
from sat_intervals.match.matching_cost import Area, MatchingCost, Reader, cost_areas
from sat_intervals.match.normalization import PairStatistics
from sat_intervals.products import LEFT_MASKED, MASKED, NO_DISPARITY
from sat_intervals.tiling import Window, facing


class Patch(NamedTuple):
    """Raw products of a core.

    Attributes
    ----------
    raw
        Of the pixels of ``output``.
    output
        The core and, where the region goes on, one pixel around it: the ring that neighbours compute too.
    right
        The right view as the core's left pixels see it.
    """

    raw: Raw
    output: Window
    right: RightView


def kernel_settings(config: Config) -> Settings:
    """What the kernels need to know of a configuration."""
    # others come with the gradients that they follow
    constant = config.sgm if isinstance(config.sgm, Sgm | CosineSgm) else None
    return Settings(
        minimum=config.disparity.minimum,
        count=config.disparity.count,
        impossible=config.impossible_cost,
        p1=config.in_steps(constant.p1) if constant else 0,
        p2=config.in_steps(constant.p2) if constant else 0,
        regularized=config.sgm is not None,
        cut_level=-1 if config.cut_level is None else config.cut_level,
        weights=np.zeros(0, np.uint16) if config.ambiguity_weights is None else config.ambiguity_weights,
        refine=config.refinement is not None,
    )


def match_patch(
    left: Reader,
    right: Reader,
    core: Window,
    region: Window,
    image: Window,
    config: Config,
    statistics: PairStatistics | None = None,
) -> Patch:
    """Match a core with its overlap.

    Parameters
    ----------
    left, right
        The images.
    core
        The left pixels whose products are kept.
    region
        The left pixels of the whole run.
    image
        All left pixels: the overlap goes beyond the region, but not beyond the image.
    config
        Settings.
    statistics
        Mean and standard deviation of the whole images, which MC-CNN needs.
    """
    settings = kernel_settings(config)
    overlap = config.tiles.overlap
    output = core.grown(1, 1).clipped(region)
    method = config.cross_check.method if config.cross_check else None
    areas = [Area.of(core.grown(overlap, overlap).clipped(image), config)]
    if method == "accurate":
        areas.append(_seen_area(core, image, config))
    matching_costs = cost_areas(left, right, areas, config, statistics)
    seen = core if method == "fast" else Window(core.row, core.column, 0, 0)
    raw, right_view = _matched(matching_costs[0], areas[0], settings, output, seen)
    inside = output.relative_to(areas[0].base).slices
    raw.validity[matching_costs[0].state[inside] & MASKED != 0] |= LEFT_MASKED
    _doubt(raw, matching_costs[0].textureless[inside], config)
    if method == "accurate":
        right_view = _match_from_right(matching_costs[1], areas[1], core, settings)
    return Patch(raw, output, right_view)


def _matched(cost: MatchingCost, area: Area, settings: Settings, output: Window, core: Window) -> tuple[Raw, RightView]:
    """Match an area; returns the products of ``output`` and the right view of ``core``."""
    windows = output.relative_to(area.base), core.relative_to(area.base)
    return match(cost.costs, settings, *windows, cost.gradients)


def _doubt(raw: Raw, textureless: np.ndarray, config: Config) -> None:
    """Give pixels without texture the whole search range as interval, and the largest ambiguity."""
    if not textureless.any():
        return
    doubtful = textureless & (raw.winner != NO_DISPARITY)
    if config.interval:
        raw.lower[doubtful], raw.upper[doubtful] = config.disparity.minimum, config.disparity.maximum
    raw.ambiguity[doubtful] = config.largest_ambiguity


def _seen_area(core: Window, image: Window, config: Config) -> Area:
    """The right pixels that a core can reach, with their overlap; they may lie outside the right image."""
    search, overlap = config.disparity, config.tiles.overlap
    reach = facing(core, search.minimum, search.maximum)
    rows = Window(image.row, reach.column - overlap, image.height, reach.width + 2 * overlap)
    return Area.mirror(reach.grown(overlap, overlap).clipped(rows), config)


def _match_from_right(cost: MatchingCost, area: Area, core: Window, settings: Settings) -> RightView:
    """The right view from a volume of its own: left and right change places, and disparities their sign."""
    maximum = settings.minimum + settings.count - 1
    mirrored = settings._replace(minimum=-maximum, cut_level=-1, weights=np.zeros(0, np.uint16), refine=False)
    reach = facing(core, settings.minimum, maximum)
    raw, _ = _matched(cost, area, mirrored, reach, reach)
    return RightView(raw.cost, np.where(raw.winner == NO_DISPARITY, NO_DISPARITY, -raw.winner).astype(np.int16))
