"""Compilation of the kernels, or loading from the cache, before the first tile."""

import numpy as np

from sat_intervals.config import Config
from sat_intervals.kernels.sgm import WAVEFRONTS
from sat_intervals.match.borders import borders_of, trace_area
from sat_intervals.match.costs import cost_of
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.matching_cost import Given, VolumeOf
from sat_intervals.match.normalization import ImageStatistics, PairStatistics
from sat_intervals.match.patch import PatchFrame, frame_area, match_patch, patch_areas
from sat_intervals.match.postprocess import ConfidenceScale, RawRows, postprocess_strips
from sat_intervals.match.refinement import pixel_windows
from sat_intervals.tiling import View, Window


def compile_kernels(config: Config, *, hands_states_on: bool = True) -> None:
    """Compile every kernel that the settings need by matching a few pixels; a single tile hands no states on."""
    random = np.random.default_rng(0)
    search = config.disparity
    frame = PatchFrame.of_whole(Window(0, 0, 4, 4))
    ends = np.array([search.minimum, search.maximum], np.int16).reshape(2, 1, 1)
    ranges = LocalRanges(ends[0], ends[1], 4, 4) if search.is_local else None
    statistics = PairStatistics(ImageStatistics(0.5, 0.3), ImageStatistics(0.5, 0.3))
    cost, areas = cost_of(config, Given(statistics, volume_of=_nothing(config))), patch_areas(frame, config, ranges)
    windows = cost.windows(areas)
    images = (random.random((window.height, window.width), np.float32) for window in windows)
    left, right = (
        View(window, pixels, np.zeros(pixels.shape, np.uint8)) for window, pixels in zip(windows, images, strict=True)
    )
    match_patch(frame, cost.of_areas((left, right), areas), config, ranges=ranges)
    if hands_states_on and config.hands_states_on:
        (costs,) = cost.of_areas((left, right), [frame_area(frame, config, ranges)])
        trace_area(costs, frame, borders_of(frame, config, [{} for _ in WAVEFRONTS]), 0, config, ranges)
    compile_postprocessing(config)


def _nothing(config: Config) -> VolumeOf:
    """Return what makes volumes without candidates."""

    def nothing(left: np.ma.MaskedArray, right: np.ma.MaskedArray, _: int) -> np.ndarray:
        rows, columns = (side - config.cost.window + 1 for side in left.shape)
        return np.full((rows, columns, right.shape[1] - left.shape[1] + 1), np.nan, np.float32)

    return nothing


def compile_postprocessing(config: Config) -> None:
    """Compile every kernel that the settings need after matching, by rows of zeros."""

    def zeros(dtype: type[np.generic], wider: int = 0) -> np.ndarray:
        return np.zeros((4, 4 + wider), dtype)

    bound = zeros(np.uint16)
    rows = RawRows(
        zeros(np.int16), bound, bound, zeros(np.float32), zeros(np.uint32), zeros(np.uint16), bound, bound,
        zeros(np.int16, config.disparity.count - 1),
        *(zeros(np.float32, window.width - 4) for window in pixel_windows(Window(0, 0, 4, 4), config)),
    )  # fmt: skip
    list(postprocess_strips([rows], ConfidenceScale(0.0, 1.0), config))
