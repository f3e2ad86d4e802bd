"""Disparities by least squares on grey values, and intervals from cost curve and fit (METHOD.md, section 19)."""

from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config
from sat_intervals.kernels.confidence import surroundings
from sat_intervals.kernels.refinement import (
    FIT,
    MARGIN,
    PLANE,
    facing_values,
    least_squares,
    on_planes,
    sides_of_bounds,
)
from sat_intervals.tiling import Views, Window

_AROUND = 9  # side of the windows of relief, in pixels


class Refined(NamedTuple):
    """Disparities in pixels, and the standard deviations of their fits, NaN for none; both float32."""

    disparity: np.ndarray
    deviation: np.ndarray


class HalfWidths(NamedTuple):
    """Distances in pixels to the bounds of a factor of 1, float32, and which pixels are at edges, bool."""

    below: np.ndarray
    above: np.ndarray
    edge: np.ndarray


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
    """Return the rows above and below that refinement depends on: windows of fits, of planes, and of relief."""
    return (FIT + _AROUND // 2) * config.fits + PLANE * config.has_planes


def smoothed(disparity: np.ndarray, kept: np.ndarray, config: Config) -> np.ndarray:
    """Return disparities that are kept on planes through those around, inside the search range; others stay."""
    nothing = np.float32(np.nan)
    smooth = on_planes(np.where(kept, disparity, nothing), np.where(kept, np.float32(0), nothing))
    return np.where(kept, np.clip(smooth, config.disparity.minimum, config.disparity.maximum), disparity)


def half_widths(fits: Refined, lower: np.ndarray, upper: np.ndarray, kept: np.ndarray) -> HalfWidths:
    """Return what a cut, the precision of the fit, and the relief around give together; see `bounds_of_both`."""
    around = surroundings(fits.disparity, kept, _AROUND)
    return HalfWidths(*sides_of_bounds(tuple(fits), (lower, upper), around))


def bounds_of_both(
    disparity: np.ndarray, half: HalfWidths, factor: np.ndarray | float, config: Config
) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds by a factor for each pixel, or for all, inside the search range."""
    search, scale = config.disparity, np.float32(factor)
    lower, upper = disparity - scale * half.below, disparity + scale * half.above
    return np.maximum(lower, search.minimum), np.minimum(upper, search.maximum)
