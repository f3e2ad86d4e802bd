"""One patch of two images to raw products: read, census, match, and what the neighbours need to know."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config
from sat_intervals.kernels.cost import Codes, between, census
from sat_intervals.kernels.matching import Raw, RightView, Settings, match
from sat_intervals.products import LEFT_MASKED, MASKED, NO_DISPARITY
from sat_intervals.tiling import Window, facing

Reader = Callable[[Window], tuple[np.ndarray, np.ndarray]]
"""Pixels (float) and states (uint8) of any window of an image; outside the image the state is NO_DATA."""


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
    return Settings(
        minimum=config.disparity.minimum,
        count=config.disparity.count,
        impossible=config.cost.window**2 + (config.sgm.p2 if config.sgm else 0) + 1,
        p1=config.sgm.p1 if config.sgm else 0,
        p2=config.sgm.p2 if config.sgm else 0,
        regularized=config.sgm is not None,
        cut_level=-1 if config.cut_level is None else config.cut_level,
        weights=np.zeros(0, np.uint16) if config.ambiguity_weights is None else config.ambiguity_weights,
        refine=config.refinement is not None,
    )


def match_patch(left: Reader, right: Reader, core: Window, region: Window, image: Window, config: Config) -> Patch:
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
    """
    settings = kernel_settings(config)
    overlap = config.tiles.overlap
    window = config.cost.window
    area = core.grown(overlap, overlap).clipped(image)
    output = core.grown(1, 1).clipped(region)
    method = config.cross_check.method if config.cross_check else None
    seen = core if method == "fast" else Window(core.row, core.column, 0, 0)
    raw, right_view, left_state = _match_area(left, right, area, output, seen, settings, window)
    raw.validity[left_state & MASKED != 0] |= LEFT_MASKED
    if method == "accurate":
        right_view = _match_from_right(left, right, core, image, settings, overlap, window)
    return Patch(raw, output, right_view)


def _codes(read: Reader, area: Window, window: int) -> tuple[Codes, np.ndarray]:
    """Census codes of an area, and the states of its pixels."""
    radius = window // 2
    pixels, state = read(area.grown(radius, radius))
    inner = Window(radius, radius, area.height, area.width)
    return census(pixels, state, window), state[inner.slices]


def _match_area(
    left: Reader, right: Reader, area: Window, output: Window, core: Window, settings: Settings, window: int
) -> tuple[Raw, RightView, np.ndarray]:
    """Match the pixels of an area; returns the products of ``output`` and the states of its left pixels."""
    maximum = settings.minimum + settings.count - 1
    left_codes, left_state = _codes(left, area, window)
    right_codes, _ = _codes(right, facing(area, settings.minimum, maximum), window)
    wanted = output.relative_to(area)
    raw, right_view = match(between(left_codes, right_codes), settings, wanted, core.relative_to(area))
    return raw, right_view, left_state[wanted.slices]


def _match_from_right(
    left: Reader, right: Reader, core: Window, image: Window, settings: Settings, overlap: int, window: int
) -> RightView:
    """The right view from a volume of its own: left and right change places, and disparities their sign."""
    maximum = settings.minimum + settings.count - 1
    mirrored = settings._replace(minimum=-maximum, cut_level=-1, weights=np.zeros(0, np.uint16), refine=False)
    reach = facing(core, settings.minimum, maximum)
    rows = Window(image.row, reach.column - overlap, image.height, reach.width + 2 * overlap)
    area = reach.grown(overlap, overlap).clipped(rows)
    raw, _, _ = _match_area(right, left, area, reach, reach, mirrored, window)
    return RightView(raw.cost, np.where(raw.winner == NO_DISPARITY, NO_DISPARITY, -raw.winner).astype(np.int16))
