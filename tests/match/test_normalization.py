"""Mean and standard deviation of an image from its blocks."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.match.normalization import BLOCK, ImageStatistics, blocks, moments, statistics_of
from sat_intervals.tiling import Window


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(-1e6, 1e6))
def test_scale_of__equals_numpy_on_usable_pixels(seed, share, offset):
    random = np.random.default_rng(seed)
    pixels = random.normal(offset, 30, (9, 40))
    state = (random.random(pixels.shape) < share).astype(np.uint8)
    pixels[state != 0] = 1e9
    parts = [moments(pixels[r : r + 4], state[r : r + 4]) for r in range(0, 9, 4)]
    usable = pixels[state == 0]
    if usable.size > 1:
        assert statistics_of(parts) == pytest.approx(ImageStatistics(usable.mean(), usable.std()), rel=1e-9)


@pytest.mark.parametrize(("value", "mean"), [(7.0, 7.0), (None, 0.0)])
def test_scale_of__divides_by_1_where_there_is_no_deviation(value, mean):
    state = np.full(4, value is None, np.uint8)
    assert statistics_of([moments(np.full(4, value or 0.0), state)]) == (mean, 1.0)


def test_blocks__hold_every_pixel_once():
    seen = np.zeros((3, BLOCK + 5), int)
    for block in blocks(*seen.shape):
        seen[block.slices] += 1
    assert (seen == 1).all()
    assert blocks(*seen.shape) == [Window(0, 0, 3, BLOCK), Window(0, BLOCK, 3, 5)]
