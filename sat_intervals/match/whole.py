"""Matching of two arrays as one tile: raw products, cross-checking and final bands of whole images."""

import numpy as np

from sat_intervals.config import Config
from sat_intervals.kernels.confidence import ambiguity_histogram
from sat_intervals.match.costs import cost_of
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.matching_cost import Given
from sat_intervals.match.normalization import PairStatistics
from sat_intervals.match.patch import PatchFrame, match_patch, patch_areas
from sat_intervals.match.postprocess import ConfidenceScale, RawRows, confidence_scale, postprocess_rows
from sat_intervals.match.refinement import pixel_windows, pixels_of
from sat_intervals.products import NO_DATA, NO_DISPARITY, Bands
from sat_intervals.tiling import View, Window


def match_whole(
    left: np.ma.MaskedArray,
    right: np.ma.MaskedArray,
    config: Config,
    statistics: PairStatistics | None = None,
    ranges: LocalRanges | None = None,
) -> Bands:
    """Match two images of finite floats, ``(rows, columns)``; masked pixels are no data."""
    frame = PatchFrame.of_whole(Window(0, 0, *left.shape))
    cost, areas = cost_of(config, Given(statistics)), patch_areas(frame, config, ranges)
    windows = cost.windows(areas)
    whole = whole_view(left), whole_view(right)
    views = cut(whole[0], windows[0]), cut(whole[1], windows[1])
    patch = match_patch(frame, cost.of_areas(views, areas), config, ranges=ranges)
    rows = RawRows.of(patch.raw, patch.right)
    if config.fits:
        windows = pixel_windows(frame.whole, config)
        pixels = pixels_of((cut(whole[0], windows[0]), cut(whole[1], windows[1])))
        rows = rows._replace(left=pixels[0], right=pixels[1])
    return finish_whole(rows, config)


def scale_of_rows(rows: RawRows, config: Config) -> ConfidenceScale:
    """Return the scale of confidence of a whole image."""
    if config.ambiguity is None:
        return ConfidenceScale(np.nan, np.nan)
    histogram = ambiguity_histogram(rows.ambiguity, rows.winner != NO_DISPARITY, config.largest_ambiguity)
    return confidence_scale(config.ambiguity, histogram, config.cost.rejected)


def finish_whole(rows: RawRows, config: Config) -> Bands:
    """Return the final bands of the rows of a whole image."""
    return postprocess_rows(rows, 0, len(rows.winner), scale_of_rows(rows, config), config)


def whole_view(image: np.ma.MaskedArray) -> View:
    """View of an image."""
    state = np.where(np.ma.getmaskarray(image), NO_DATA, 0).astype(np.uint8)
    return View(Window(0, 0, *image.shape), image.filled(0), state)


def cut(view: View, window: Window) -> View:
    """Cut a window, which may leave the view, out of it; beyond it there is no data."""
    pixels = np.zeros((window.height, window.width), view.pixels.dtype)
    state = np.full(pixels.shape, NO_DATA, np.uint8)
    inside = window.clipped(view.window)
    here, there = inside.relative_to(window).slices, inside.relative_to(view.window).slices
    pixels[here], state[here] = view.pixels[there], view.state[there]
    return View(window, pixels, state)
