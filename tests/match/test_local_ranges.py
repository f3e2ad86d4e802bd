"""Local search ranges: hulls, cells, and what they do to confidence."""

import numpy as np
import pytest

from sat_intervals import SatIntervalsError, load_config
from sat_intervals.demo import make_scene
from sat_intervals.kernels.sweeps import sweep_down, sweep_up, trace_wave
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.match.whole import match_whole
from sat_intervals.tiling import Window

SEARCH = {"preset": "paper", "disparity": {"minimum": -14, "maximum": 27}}


def ranges(minimum, maximum, height=16, width=16):
    return LocalRanges(np.array(minimum, np.int16), np.array(maximum, np.int16), height, width)


def test_within__is_the_hull_of_the_cells_that_a_window_meets():
    found = ranges([[-5, 0, 2], [1, 1, 1]], [[-1, 3, 9], [2, 2, 2]])
    config = load_config(SEARCH)
    hull = found.within(Window(4, 10, 8, 10), config).disparity
    assert (hull.minimum, hull.maximum) == (-5, 3)
    cells = found.cells(Window(4, 10, 20, 10), -5)
    assert (cells.first.tolist(), cells.last.tolist()) == ([[0, 5], [6, 6]], [[4, 8], [7, 7]])
    assert (cells.row, cells.column) == (4, 10)


def test_clipped__gives_the_whole_range_to_cells_that_lie_outside():
    found = ranges([[-50, 3, 1]], [[-20, 30, 0]]).clipped(-14, 27)
    assert found.minimum.tolist() == [[-14, 3, -14]]
    assert found.maximum.tolist() == [[27, 27, 27]]


def test_local_ranges__survive_their_report():
    found = ranges([[-5, 0], [1, 1]], [[-1, 3], [2, 2]], 8, 32)
    again = LocalRanges.of_report(found.report())
    assert again.report() == found.report()
    np.testing.assert_array_equal(again.maximum, found.maximum)


@pytest.fixture(scope="module")
def images():
    scene = make_scene(96, 160, seed=11)
    return [np.ma.masked_equal(image, 0).astype(np.float32) for image in (scene.left, scene.right)]


@pytest.mark.parametrize("interval", [{}, {"coverage": 0.9}])
def test_match_whole__ranges_of_all_cells_as_wide_as_the_whole_change_nothing(images, interval):
    config = load_config(SEARCH | {"interval": interval})
    whole = ranges(np.full((6, 10), -14), np.full((6, 10), 27))
    for one, other in zip(match_whole(*images, config), match_whole(*images, config, ranges=whole), strict=True):
        np.testing.assert_array_equal(one, other)


def test_match_whole__cells_of_one_range_have_the_bounds_of_that_range_alone(images):
    off = dict.fromkeys(("ambiguity", "cross_check", "median", "regularization"))
    config = load_config(SEARCH | off)
    alone = match_whole(*images, load_config(config, {"disparity": {"minimum": 0, "maximum": 20}}))
    found = match_whole(*images, config, ranges=ranges(np.full((6, 10), 0), np.full((6, 10), 20)))
    assert found.valid.mean() > 0.5
    for one, other in zip(found[:3], alone[:3], strict=True):
        np.testing.assert_array_equal(one[found.valid], other[found.valid])


def test_match_whole__a_cell_that_misses_the_truth_is_not_more_confident(images):
    """A tower taller than its cell knows: there the confidence is at most that of a search of the whole range."""
    config = load_config(SEARCH | {"ambiguity": {"p1": 40, "p99": 1200}, "regularization": None})
    whole = match_whole(*images, config)
    truth = whole.disparity
    missed = whole.valid & (truth > 8)
    low = ranges(np.full((6, 10), -14), np.full((6, 10), 5))
    found = match_whole(*images, config, ranges=low.clipped(-14, 27))
    assert missed.sum() > 100
    assert (found.confidence[missed] <= whole.confidence[missed] + 1e-6).mean() > 0.95
    assert np.nanmax(found.upper) <= 5


def test_load_config__accurate_cross_checking_does_not_know_local_ranges():
    with pytest.raises(SatIntervalsError, match="local ranges, which cross_check"):
        load_config({"disparity": {"local": True}, "cross_check": {"method": "accurate"}})


def test_compile_kernels__leaves_nothing_to_compile_for_local_ranges(images):
    config = load_config(SEARCH | {"disparity": SEARCH["disparity"] | {"local": True}})
    kernels = trace_wave, sweep_down, sweep_up
    compile_kernels(config)
    compiled = [len(kernel.signatures) for kernel in kernels]
    cells = ranges(np.full((6, 10), -14), np.full((6, 10), 27))
    match_whole(*images, config, ranges=cells)
    assert [len(kernel.signatures) for kernel in kernels] == compiled
