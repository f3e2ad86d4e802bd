"""Row offsets: the polynomial, resampling along columns against a slow twin, shifts of known images."""

import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from sat_intervals.kernels.row_offsets import AFTER, BEFORE, RowOffsets, shift_equations, shift_rows


@settings(max_examples=40)
@given(seed=st.integers(0, 1000), rows=st.integers(1, 6), columns=st.integers(1, 5))
def test_shift_rows__equals_its_slow_twin(seed, rows, columns):
    random = np.random.default_rng(seed)
    pixels = random.random((rows + 8, columns))
    state = (random.random(pixels.shape) < 0.1).astype(np.uint8) * 3
    offset = random.uniform(BEFORE, BEFORE + 4, (rows, columns))
    offset[random.random(offset.shape) < 0.2] = 2
    found, states = shift_rows(pixels, state, np.floor(offset).astype(np.int64), offset - np.floor(offset))
    for r, c in np.ndindex(rows, columns):
        place = r + offset[r, c]
        near = np.arange(len(pixels))
        weights = reference.cubic(place - near)
        wanted = np.bitwise_or.reduce(state[np.abs(weights) > 1e-12, c])
        assert states[r, c] == wanted
        assert_allclose(found[r, c], 0 if wanted else weights @ pixels[:, c], atol=1e-12)


def test_row_offsets__worked_example():
    # an image of 101 x 201: v from -.5 to .5, u from -1 to 1 (halves of 201 px)
    offsets = RowOffsets((1.0, 2.0, -4.0, 0.5), 101, 201)
    assert offsets.at(np.array(50), np.array(100)) == 1.0
    assert_allclose(
        offsets.at(np.array(100), np.array(0)), 1 + 2 * 50 / 100.5 + 4 * 100 / 100.5 + 0.5 * (50 / 100.5) ** 2
    )
    assert_allclose(offsets.design(np.array([50, 100]), np.array([100, 0]), 4) @ offsets.coefficients, offsets.at(
        np.array([50, 100]), np.array([100, 0])))  # fmt: skip


def test_row_offsets__windows_are_read_from_the_same_positions():
    offsets = RowOffsets((0.3, 1.7, -0.9), 400, 300)
    first, count, whole, part = offsets.read(0, 0, 400, 300)
    assert (whole.min() >= BEFORE, whole.max() + AFTER < count) == (True, True)
    row, _, inner_whole, inner_part = offsets.read(120, 40, 50, 60)
    assert_array_equal(inner_whole + row - 120, whole[120:170, 40:100] + first)
    assert_array_equal(inner_part, part[120:170, 40:100])


@pytest.mark.parametrize("shift", [-0.4, 0.0, 0.3, 0.8])
def test_shift_equations__find_a_shift_along_columns(shift):
    """left = 1.5 right + 20 at a slanted disparity, whose rows are lower by ``shift``."""
    row, column = np.mgrid[-4.0:44, -4.0:54]

    def image(r, c):
        return np.sin(0.7 * r + 0.3 * c) + np.cos(0.5 * r - 0.6 * c) + 0.5 * np.sin(0.35 * c)

    disparity = 2 + 0.05 * column[4:-4, 4:-8]
    left = 1.5 * image(row[4:-4, 4:-8], column[4:-4, 4:-8] + disparity) + 20
    right = image(row - shift, column)
    known = np.ones(disparity.shape, bool)
    offset = 0.0
    for _ in range(3):
        equations, pixels = shift_equations(left, right, disparity, known, offset, 4, 4)
        found = np.linalg.solve(equations[pixels > 60, :, :4], equations[pixels > 60, :, 4:])[..., 0]
        offset += np.median(found[:, 3] / found[:, 0])
    assert abs(offset - shift) < 0.01
    assert_allclose(np.median(found[:, :2], axis=0), (1.5, 20), atol=0.1)
