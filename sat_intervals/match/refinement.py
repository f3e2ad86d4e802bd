"""Disparities by least squares on grey values, and intervals from cost curve and fit (METHOD.md, section 19)."""

from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config
from sat_intervals.kernels.refinement import FIT, MARGIN, PLANE, facing_values, least_squares, on_planes
from sat_intervals.tiling import Views, Window

# Deviation in pixels that stands for a pixel without a fit, and what adds to a deviation and to a side of the cut.
_NO_FIT = np.float32(1.0)
_LEAST = np.float32(0.2)
_SIDE = np.float32(0.3)


class Refined(NamedTuple):
    """Disparities in pixels, and the standard deviations of their fits, NaN for none; both float32."""

    disparity: np.ndarray
    deviation: np.ndarray


def pixel_windows(rows: Window, config: Config) -> tuple[Window, Window]:
    """Return the windows of both images that the refinement of some rows needs."""
    search = config.disparity
    first = rows.column + search.minimum - MARGIN
    return rows, Window(rows.row, first, rows.height, rows.width + search.count - 1 + 2 * MARGIN)


def pixels_of(views: Views) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of both views as float32, NaN where not usable."""
    left, right = (np.where(view.state == 0, view.pixels, np.nan).astype(np.float32, copy=False) for view in views)
    return left, right


def refined(disparity: np.ndarray, kept: np.ndarray, left: np.ndarray, right: np.ndarray, config: Config) -> Refined:
    """Refine disparities that are kept; one that cannot be fitted, or would leave the search range, stays as it is.

    disparity, kept: ``(rows, columns)`` float32 pixels, and bool.
    left, right: pixels of both images, see `pixel_windows`.
    """
    matched = np.where(kept, disparity, np.float32(np.nan))
    search = config.disparity
    shift, deviation = least_squares(left, *facing_values(right, matched, search.minimum), matched)
    smooth = on_planes(np.where(np.isnan(deviation), matched, matched + shift), deviation)
    deviation[(smooth < search.minimum) | (smooth > search.maximum)] = np.nan
    return Refined(np.where(np.isnan(deviation), disparity, smooth), deviation)


def halo_of(config: Config) -> int:
    """Return the rows above and below that a refined disparity depends on: windows of fits, and of planes."""
    return FIT * config.fits + PLANE * config.has_planes


def smoothed(disparity: np.ndarray, kept: np.ndarray, config: Config) -> np.ndarray:
    """Return disparities that are kept on planes through those around, inside the search range; others stay."""
    nothing = np.float32(np.nan)
    smooth = on_planes(np.where(kept, disparity, nothing), np.where(kept, np.float32(0), nothing))
    return np.where(kept, np.clip(smooth, config.disparity.minimum, config.disparity.maximum), disparity)


def bounds_of_both(
    fits: Refined, lower: np.ndarray, upper: np.ndarray, factor: float, config: Config
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds that cost curve and fit give together, inside the search range."""
    # On either side ``factor (.2 + deviation) (.3 + distance to the bound of the cut)`` from the disparity.
    disparity, search = fits.disparity, config.disparity
    scale = np.float32(factor) * (_LEAST + np.where(np.isnan(fits.deviation), _NO_FIT, fits.deviation))
    below, above = (scale * (_SIDE + np.maximum(side, 0)) for side in (disparity - lower, upper - disparity))
    return np.maximum(disparity - below, search.minimum), np.minimum(disparity + above, search.maximum)
