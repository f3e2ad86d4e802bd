"""Winners of whole volumes against the slow twin."""

import numpy as np
import reference
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.kernels.curves import read_right_winners
from sat_intervals.products import IMPOSSIBLE_COST

some = settings(max_examples=40, derandomize=True, deadline=None)
X = IMPOSSIBLE_COST
SPAN = 448


@st.composite
def volumes(draw):
    """Aggregated costs with ties, holes and pixels without any candidate."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = tuple(int(random.integers(1, most)) for most in (5, 7, 9))
    volume = random.integers(0, draw(st.sampled_from([3, 60, SPAN + 1])), shape).astype(np.uint16)
    volume[random.random(shape) < draw(st.sampled_from([0, 0.3]))] = X
    volume[random.random(shape[:2]) < draw(st.sampled_from([0, 0.2]))] = X
    return volume


@some
@given(volumes(), st.sampled_from([0, -7]))
def test_read_right_winners__equals_the_slow_twin(volume, minimum):
    index, _ = reference.right_winners(volume.astype(np.int64))
    expected = reference.absolute(index, minimum)
    np.testing.assert_array_equal(read_right_winners(volume, minimum), expected)
