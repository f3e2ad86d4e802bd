"""Winners and intervals of whole aggregated volumes against the slow twins."""

import numpy as np
import reference
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.config import load_config
from sat_intervals.kernels.curves import read_alpha_cuts, read_right_winners, read_winners
from sat_intervals.products import IMPOSSIBLE_COST, NO_DISPARITY

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


def from_indices(index, minimum):
    return np.where(index < 0, NO_DISPARITY, index + minimum)


@some
@given(volumes(), st.sampled_from([0, -7]), st.booleans())
def test_read_winners__equals_the_slow_twin(volume, minimum, refine):
    weights = load_config({"preset": "paper", "disparity": {"minimum": 0, "maximum": 1}}).ambiguity_weights
    winner, disparity, ambiguity = read_winners(volume, minimum, weights, refine)
    expected = reference.winner_takes_all(volume.astype(np.int64))
    np.testing.assert_array_equal(winner, from_indices(expected, minimum))
    refined, _ = reference.vfit(volume.astype(np.int64), expected, minimum)
    whole = np.where(expected < 0, np.nan, expected + minimum).astype(np.float32)
    np.testing.assert_array_equal(disparity, refined if refine else whole)
    np.testing.assert_array_equal(ambiguity, reference.ambiguity(volume.astype(np.int64), "0.7", "0.01", SPAN))


@some
@given(volumes(), st.sampled_from([0, -7]))
def test_read_right_winners__equals_the_slow_twin(volume, minimum):
    index, _ = reference.right_winners(volume.astype(np.int64))
    expected = reference.absolute(index, minimum)
    np.testing.assert_array_equal(read_right_winners(volume, minimum), expected)


@some
@given(volumes(), st.sampled_from(["0.5", "0.8", "0.9", "0.98", "1"]), st.booleans())
def test_read_alpha_cuts__equals_the_slow_twin(volume, alpha, refine):
    found = read_alpha_cuts(volume, -3, reference.cut_level(alpha, SPAN), refine)
    expected = reference.alpha_cut(volume.astype(np.int64), alpha, SPAN, refine)
    for bound, index in zip(found, expected, strict=True):
        np.testing.assert_array_equal(bound, from_indices(index, -3))
