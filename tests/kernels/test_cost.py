"""Census codes against the slow twin: Hamming distances and the states of windows."""

import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sat_intervals.kernels.cost import Codes, census

bounded = settings(max_examples=40, derandomize=True, deadline=None)
WINDOWS = (3, 5, 7, 9, 11)
GREY = st.integers(0, 4).map(float)


def distance(one: Codes, other: Codes) -> np.ndarray:
    """Hamming distances of the codes of two images, pixel by pixel."""
    return np.bitwise_count(one.words ^ other.words).sum(axis=0, dtype=np.int64)


def usable(pixels: np.ndarray) -> np.ndarray:
    return np.zeros(pixels.shape, np.uint8)


def test_census__worked_example():
    # Window 3 on 3 x 4 pixels: two windows, with centres 4 and 4. Neighbours greater than the centre:
    #     1 2 3 4      . . .      . . .
    #     5 4 4 0      5 . .      . . .
    #     9 4 1 7      9 . .      . . 7
    # so codes of two bits and of one, with none in common: 3 bits differ.
    pixels = np.array([[1, 2, 3, 4], [5, 4, 4, 0], [9, 4, 1, 7]], np.float32)
    codes = census(pixels, usable(pixels), 3)
    assert codes.state.shape == (1, 2)
    assert np.bitwise_count(codes.words).sum(axis=0).tolist() == [[2, 1]]
    assert np.bitwise_count(codes.words[:, :, 0] ^ codes.words[:, :, 1]).sum() == 3
    assert reference.census(pixels, 3).sum(axis=2).tolist() == [[2, 1]]


# float64 with codes of 8 bits and of 120: what it changes is the comparison of two pixels, whatever the window.
@pytest.mark.parametrize(
    ("window", "dtype"), [*((window, np.float32) for window in WINDOWS), (3, np.float64), (11, np.float64)]
)
@bounded
@given(data=st.data())
def test_census__distances_equal_reference(window, dtype, data):
    shape = (2, window + data.draw(st.integers(0, 4)), window + data.draw(st.integers(0, 9)))
    one, other = data.draw(hnp.arrays(dtype, shape, elements=GREY, fill=GREY))
    codes = census(one, usable(one), window), census(other, usable(other), window)
    bits = reference.census(one, window), reference.census(other, window)
    np.testing.assert_array_equal(distance(*codes), (bits[0] != bits[1]).sum(axis=2))


@pytest.mark.parametrize("window", WINDOWS)
@bounded
@given(data=st.data())
def test_census__state_is_the_union_of_the_window(window, data):
    shape = window + data.draw(st.integers(0, 6)), window + data.draw(st.integers(0, 6))
    state = data.draw(hnp.arrays(np.uint8, shape, elements=st.integers(0, 3), fill=st.just(0)))
    codes = census(np.zeros(shape, np.float32), state, window)
    np.testing.assert_array_equal(codes.state, reference.window_state(state, window))


def test_census__compares_float64_in_float64():
    # In float32 1 + 1e-12 equals 1.
    pixels = np.ones((3, 3))
    pixels[0, 1] += 1e-12
    assert np.bitwise_count(census(pixels, usable(pixels), 3).words).sum() == 1


def test_census__reads_strided_patches():
    # Windows are read out of larger arrays; every second column is not a contiguous array.
    wide = np.random.default_rng(0).integers(0, 9, (11, 30)).astype(np.float32)
    part = wide[2:, 1:21:2]
    codes, copied = census(part, usable(part), 5), census(part.copy(), usable(part), 5)
    np.testing.assert_array_equal(codes.words, copied.words)
