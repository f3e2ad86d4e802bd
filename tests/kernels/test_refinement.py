"""Least squares on grey values and planes: slow twins, known shifts, pixels that keep their disparity."""

import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from sat_intervals.kernels.refinement import MARGIN, facing_values, least_squares, on_planes

NAN = np.float32(np.nan)


def facing_image(right, minimum, count, columns):
    """The columns of a right image that the kernel needs; NaN outside."""
    wide = np.full((len(right), columns + count - 1 + 2 * MARGIN), NAN)
    for x in range(wide.shape[1]):
        if 0 <= x + minimum - MARGIN < right.shape[1]:
            wide[:, x] = right[:, x + minimum - MARGIN]
    return wide


def refined(left, right, disparity, minimum, count):
    """Disparities, deviations and planes of a pair."""
    value, slope = facing_values(facing_image(right, minimum, count, left.shape[1]), disparity, minimum)
    shift, deviation = least_squares(left, value, slope, disparity)
    moved = np.where(np.isnan(shift), disparity, disparity + shift)
    return moved, deviation, on_planes(moved, deviation)


def texture(rows, columns):
    """Smooth grey values about 500."""
    return reference.waves(*np.mgrid[0.0:rows, 0.0:columns], 0.35, 56)


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), holes=st.sampled_from([0.0, 0.1, 0.4]))
def test_kernels__equal_their_slow_twins(seed, holes):
    random = np.random.default_rng(seed)
    rows, columns, minimum, count = 7, 11, -3, 6
    left, right = (random.normal(500, 80, (rows, size)).astype(np.float32) for size in (columns, columns + 12))
    right[:, :columns] += left  # some likeness
    disparity = (np.repeat([[0.0, 1.6]], [4, columns - 4], axis=1) + random.uniform(-0.5, 0.5, left.shape)).astype("f4")
    for image in (left, right, disparity):
        image[random.random(image.shape) < holes / 2] = NAN
    wide = facing_image(right, minimum, count, columns)
    value, slope = facing_values(wide, disparity, minimum)
    for r, c in np.argwhere(np.isfinite(disparity)):
        wanted = reference.facing_value(wide[r].astype(np.float64), c + MARGIN + disparity[r, c] - minimum)
        assert_allclose((value[r, c], slope[r, c]), wanted, rtol=1e-4, atol=1e-3)
    shift, deviation = least_squares(left, value, slope, disparity)
    moved = np.where(np.isnan(shift), disparity, disparity + shift)
    smooth = on_planes(moved, deviation)
    for r, c in np.ndindex(left.shape):
        wanted = reference.fit(left, value, slope, disparity, r, c)
        assert_allclose((shift[r, c], deviation[r, c]), wanted, rtol=2e-2, atol=2e-3)
        assert_allclose(smooth[r, c], reference.on_plane(moved, deviation, r, c), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("fraction", [-0.45, -0.2, 0.0, 0.3, 0.5])
@pytest.mark.parametrize("slant", [0.0, 0.15])
def test_least_squares__finds_a_known_shift(fraction, slant):
    """The left image is exactly the right one between its pixels, on flat or slanted ground."""
    right = texture(60, 90)
    row, column = np.mgrid[0.0:60, 0.0:60]
    true = 12 + fraction + slant * (column - 30)
    left = reference.waves(row, column + true, 0.35, 56).astype(np.float32)
    _, deviation, smooth = refined(left, right.astype(np.float32), (true - fraction).astype(np.float32), 0, 40)
    inner = np.s_[6:-6, 8:-8]
    error = np.abs(smooth - true)[inner]
    assert np.isfinite(deviation[inner]).all()
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.9) < 0.05
    assert np.median(deviation[inner]) < 0.02


def test_least_squares__leaves_what_it_cannot_fit():
    right = texture(40, 60).astype(np.float32)
    left = right[:, 10:50].copy()
    left[:20, :20] = 300  # no texture
    left[20:, :20] = 1000 - left[20:, :20]  # no likeness
    left[:20, 20:] = right[:20, 33:53]  # three pixels away
    disparity = np.full(left.shape, np.float32(10))
    _, deviation, smooth = refined(left, right, disparity, 0, 20)
    assert_array_equal(np.isfinite(deviation[4:16, 4:16]), False)
    assert_array_equal(np.isfinite(deviation[24:36, 4:16]), False)
    assert np.isfinite(deviation[4:16, 24:36]).mean() < 0.7
    assert np.isfinite(deviation[24:36, 24:36]).all()
    assert_array_equal(smooth[4:16, 4:16], 10)
    assert np.isnan(refined(left, right, np.full_like(disparity, NAN), 0, 20)[2]).all()


def test_on_planes__worked_example():
    """A plane stays, a bump is flattened, a step of a pixel is none of the surface."""
    row, column = np.mgrid[0.0:15, 0.0:15]
    plane = (0.02 * row - 0.01 * column).astype(np.float32)
    fits = np.full(plane.shape, np.float32(0.1))
    # slopes are held back by a thousandth: the middle of a window stays
    assert_allclose(on_planes(plane, fits)[4:-4, 4:-4], plane[4:-4, 4:-4], atol=1e-5)
    bump = plane.copy()
    bump[7, 7] += 0.5
    assert_allclose(on_planes(bump, fits)[7, 7] - plane[7, 7], 0.5 / 81, atol=1e-4)
    step = plane.copy()
    step[:, 8:] += 1
    assert_allclose(on_planes(step, fits)[7, 5:10], step[7, 5:10], atol=0.01)
    none = np.full(plane.shape, NAN)
    assert_array_equal(on_planes(bump, none), bump)
