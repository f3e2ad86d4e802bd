"""Refined disparities and their intervals: bounds, pixels that stay, and worked examples."""

import numpy as np
import pytest
import reference
from numpy.testing import assert_allclose, assert_array_equal

from sat_intervals import load_config, match_arrays
from sat_intervals.match.refinement import (
    HalfWidths,
    Refined,
    bounds_of_both,
    half_widths,
    pixel_windows,
    pixels_of,
    refined,
    smoothed,
)
from sat_intervals.match.whole import cut, whole_view
from sat_intervals.products import INVALID, NOT_REFINED, REGULARIZED
from sat_intervals.tiling import Window

SEARCH = {"minimum": -4, "maximum": 12}


def pair(rows=90, columns=120, shift=3.3):
    """Textured images; the right one is moved by a fraction of a pixel, and noisy."""
    row, column = np.mgrid[0.0:rows, 0.0:columns]
    left, right = (reference.waves(row, column - moved, 0.6, 150) for moved in (0.0, shift))
    return left, right + np.random.default_rng(0).normal(0, 2, right.shape)


@pytest.fixture(scope="module")
def matched():
    """Results of a pair by both refinements."""
    images = pair()
    return {
        method: match_arrays(*images, {"preset": "satellite", "disparity": SEARCH, "refinement": {"method": method}} | (
            {} if method == "least_squares" else {"interval": {"alpha": 0.9}}))
        for method in ("vfit", "planes", "least_squares")
    }  # fmt: skip


def test_refined__is_nearer_to_the_truth(matched):
    inner = np.s_[10:-10, 20:-20]
    errors = {name: np.abs(found.disparity.values[inner] - 3.3) for name, found in matched.items()}
    assert np.nanmedian(errors["least_squares"]) < 0.5 * np.nanmedian(errors["vfit"])
    assert np.nanstd(errors["planes"]) < 0.5 * np.nanstd(errors["vfit"])
    assert np.nanmedian(errors["least_squares"]) < 0.05


def test_bounds__hold_the_disparity_inside_the_search_range(matched):
    found = matched["least_squares"]
    valid = found.validity.values & INVALID == 0
    lower, disparity, upper = (found[name].values[valid] for name in ("lower", "disparity", "upper"))
    assert ((lower <= disparity) & (disparity <= upper)).all()
    assert lower.min() >= SEARCH["minimum"]
    assert upper.max() <= SEARCH["maximum"]
    assert_array_equal(lower * 64 % 1, 0)


def test_match_arrays__gives_the_factor_of_the_calibration(matched):
    """A larger coverage widens the intervals of high confidence around the same disparities."""
    images = pair()
    wide = match_arrays(*images, {"preset": "satellite", "disparity": SEARCH, "interval": {"coverage": 0.95}})
    usual = matched["least_squares"]
    high = (usual.validity.values & (INVALID | REGULARIZED)) == 0
    assert_array_equal(wide.disparity.values[high], usual.disparity.values[high])
    for one, other in ((usual.upper - wide.upper, 0), (wide.lower - usual.lower, 0)):
        assert (one.values[high] <= other).all()
    assert (wide.upper - wide.lower).values[high].mean() > 1.2 * (usual.upper - usual.lower).values[high].mean()


def test_match_arrays__of_a_range_too_short_stays_inside_it():
    """The true shift is beyond the maximum; also with few disparities, where no winner is at an end."""
    images = pair(shift=4.6)
    for interval in ({"coverage": 0.9}, {"alpha": 0.05}):
        settings = {"preset": "satellite", "disparity": {"minimum": 0, "maximum": 4}, "interval": interval}
        found = match_arrays(*images, settings)
        valid = found.validity.values & INVALID == 0
        assert found.disparity.values[valid].max() <= 4
        assert found.upper.values[valid].max() <= 4.5
        assert found.lower.values[valid].min() >= -0.5


@pytest.mark.parametrize("method", ["vfit", "least_squares"])
def test_validity__bit_3_is_of_pixels_that_neither_refinement_has_moved(method):
    """The true shift is next to the minimum, where V-fit has only one side."""
    settings = {"preset": "satellite", "disparity": {"minimum": 3, "maximum": 8}, "refinement": {"method": method}}
    found = match_arrays(*pair(), settings | {"interval": {"alpha": 0.9}, "products": {"sigma": method != "vfit"}})
    valid = found.validity.values & INVALID == 0
    without = (found.validity.values & NOT_REFINED != 0)[valid]
    if method == "vfit":
        assert without.mean() > 0.5
    else:
        assert not without[np.isfinite(found.sigma.values[valid])].any()
        assert without.mean() < 0.2


def test_half_widths__worked_example():
    fits = Refined(np.float32([[5, 5, 5, 19]]), np.float32([[0.1, np.nan, 0.1, 0.1]]))
    lower, upper = np.float32([[4.5, 4.5, 5.2, 18]]), np.float32([[5.7, 5.7, 6.2, 20]])
    below, above, edge = half_widths(fits, lower, upper, np.array([[True, True, True, False]]))
    # (.5 + .1) (.5 + .5) sqrt(.5); without a fit (.5 + 1); a cut beyond the disparity leaves .5; 14 px above others
    root, far = np.sqrt([0.5, 14.5])
    assert_allclose(below, [[0.6 * root, 1.5 * root, 0.3 * root, 0.9 * far]], rtol=1e-6)
    assert_allclose(above, [[0.72 * root, 1.8 * root, 1.02 * root, 0.9 * root]], rtol=1e-6)
    assert edge.all()  # a pixel around is missing
    flat, step = np.zeros((1, 12), np.float32), np.repeat(np.float32([[0, 3]]), [4, 8], axis=1)
    kept = np.ones(flat.shape, bool)
    assert not half_widths(Refined(flat, flat), flat, flat, kept).edge.any()
    assert_array_equal(np.flatnonzero(half_widths(Refined(step, flat), step, step, kept).edge), range(8))


def test_bounds_of_both__stay_in_the_search_range():
    config = load_config({"preset": "satellite", "disparity": {"minimum": 0, "maximum": 20}})
    half = HalfWidths(np.float32([1, 2]), np.float32([3, 4]), np.array([False, True]))
    disparity = np.float32([5, 5])
    assert_array_equal(bounds_of_both(disparity, half, np.array([2, 0.5]), config), [[3, 4], [11, 7]])
    assert_array_equal(bounds_of_both(disparity, half, 1000.0, config), [[0, 0], [20, 20]])


def test_refined__only_where_it_is_kept():
    config = load_config({"preset": "satellite", "disparity": {"minimum": 0, "maximum": 6}})
    left, right = pair(40, 60, shift=2.4)
    rows = Window(0, 0, *left.shape)
    views = [
        cut(whole_view(np.ma.array(image)), window)
        for image, window in zip((left, right), pixel_windows(rows, config), strict=True)
    ]
    disparity, kept = np.full(left.shape, np.float32(2)), np.ones(left.shape, bool)
    kept[:, 30:] = False
    found = refined(disparity, kept, *pixels_of((views[0], views[1])), config)
    assert np.isfinite(found.deviation[4:36, 8:24]).mean() > 0.8
    assert_allclose(np.median(found.disparity[4:36, 8:24]), 2.4, atol=0.05)
    assert_array_equal(found.disparity[:, 30:], 2)
    assert np.isnan(found.deviation[:, 30:]).all()


def test_smoothed__averages_noise_of_slopes_and_keeps_walls_and_what_is_rejected():
    config = load_config({"disparity": SEARCH, "refinement": {"method": "planes"}})
    row, column = np.mgrid[0.0:40, 0.0:60]
    truth = np.where(column < 30, 0.05 * row, 6 + 0.05 * column).astype(np.float32)
    noisy = (truth + np.random.default_rng(0).normal(0, 0.1, truth.shape)).astype(np.float32)
    kept = column != 10
    found = smoothed(noisy, kept, config)
    assert_array_equal(found[~kept], noisy[~kept])
    assert np.abs(found - truth)[kept].std() < 0.4 * np.abs(noisy - truth)[kept].std()
    assert np.abs(found - truth)[kept].max() < 0.2
