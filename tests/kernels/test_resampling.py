"""Resampling at the positions of a grid, against a slow twin and on images that are known between pixels."""

import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from sat_intervals.kernels.resampling import Step, reach, reduced, resample, resample_reduced

STEP = 4


def positions(nodes, row, column):
    """The position in the image of a pixel of the result, by the four nodes around it."""
    (i, y), (j, x) = divmod(row, STEP), divmod(column, STEP)
    y, x = y / STEP, x / STEP
    above, below = ((1 - x) * nodes[k, j] + x * nodes[k, j + 1] for k in (i, i + 1))
    return (1 - y) * above + y * below


def turned(shape, origin, turn, scale=1.0):
    """Nodes of a result that is turned and scaled, ``(n, m, 2)``."""
    rows, columns = np.indices([size // STEP + 2 for size in shape]) * STEP * scale
    here = np.cos(turn) * rows + np.sin(turn) * columns, np.cos(turn) * columns - np.sin(turn) * rows
    return np.stack(here, axis=-1) + origin


@settings(max_examples=25)
@given(seed=st.integers(0, 1000), scale=st.sampled_from([1.0, 1.3, 2.5]), turn=st.floats(-0.4, 0.4))
def test_resample__equals_its_slow_twin(seed, scale, turn):
    random = np.random.default_rng(seed)
    pixels = random.random((60, 60), np.float32)
    pixels[random.random(pixels.shape) < 0.02] = np.nan
    nodes = turned((6, 7), (28.3, 25.2), turn, scale) + random.uniform(-0.1, 0.1, (3, 3, 2))
    nodes[0, 2] = nodes[0, 2] if seed % 3 else np.nan
    arguments = pixels, (0, 0), nodes, STEP, (1, 0), 5, 7
    found = resample(*arguments) if scale == 1 else resample_reduced(*arguments, scale)
    for r, c in np.ndindex(found.shape):
        row, column = positions(nodes, r + 1, c)
        if np.isnan(row):
            assert np.isnan(found[r, c])
            continue
        before, after = reach(scale)
        down = np.arange(int(np.floor(row)) - before, int(np.floor(row)) + after + 1)
        across = np.arange(int(np.floor(column)) - before, int(np.floor(column)) + after + 1)
        weights = np.outer(reference.cubic((row - down) / scale), reference.cubic((column - across) / scale))
        wanted = (weights * pixels[np.ix_(down, across)]).sum() / weights.sum()
        assert_allclose(found[r, c], wanted, atol=1e-6)


def test_resample__is_exact_for_quadratic_images():
    row, column = np.indices((40, 40), float)
    nodes = turned((12, 12), (15.0, 12.0), 0.3)
    pixels = (0.2 * row**2 - row * column + 3 * column).astype(np.float32)
    found = resample(pixels, (0, 0), nodes, STEP, (0, 0), 12, 12)
    places = np.array([[positions(nodes, r, c) for c in range(12)] for r in range(12)])
    y, x = np.moveaxis(places, -1, 0)
    assert_allclose(found, 0.2 * y**2 - y * x + 3 * x, atol=1e-3)


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_resample__a_pixel_is_the_same_in_any_window(scale):
    pixels = np.random.default_rng(0).random((80, 80)).astype(np.float32)
    nodes = turned((20, 20), (30.7, 20.1), 0.2, scale)

    def made(origin, first, rows, columns):
        window = np.ascontiguousarray(pixels[origin[0] :, origin[1] :])
        arguments = window, origin, nodes, STEP, first, rows, columns
        return resample(*arguments) if scale == 1 else resample_reduced(*arguments, scale)

    assert_array_equal(made((0, 0), (0, 0), 20, 20)[7:, 5:], made((11, 3), (7, 5), 13, 15))


def test_resample_reduced__leaves_no_pattern_of_finer_detail():
    stripes = np.tile([0.0, 1.0], (80, 40))
    nodes = turned((16, 16), (20.0, 20.0), 0.0, 1.9)
    assert np.ptp(resample(stripes, (0, 0), nodes, STEP, (0, 0), 16, 16)) > 0.9
    assert np.ptp(resample_reduced(stripes, (0, 0), nodes, STEP, (0, 0), 16, 16, 1.9)) < 0.1


def test_reduced__averages_usable_pixels_where_half_of_a_block_is_usable():
    pixels = np.array([[1, 2, 0, 8, 9], [3, 0, 0, 0, 9]], np.float32)
    assert reduced(pixels, (pixels == 0).view(np.uint8), Step(2, 2)).tolist()[0][0] == 2.0
    assert np.isnan(reduced(pixels, (pixels == 0).view(np.uint8), Step(2, 2))[0, 1])
    assert reduced(pixels, np.zeros(pixels.shape, np.uint8), Step(1, 2)).tolist() == [[1.5, 4.0], [1.5, 0.0]]
    large = np.full((48, 96), 3, np.float32)
    for step in (Step(12, 12), Step(16, 32)):
        np.testing.assert_array_equal(reduced(large, np.zeros(large.shape, np.uint8), step), 3)
