"""Costs of features: the kernel against its slow twin, within the rounding of a float."""

import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.kernels.correlation import correlate
from sat_intervals.products import COSINE_STEPS

few = settings(max_examples=30, derandomize=True, deadline=None)


def features(random, rows, columns, number=64):
    """Unit vectors as networks write them."""
    vectors = random.standard_normal((number, rows, columns)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=0)


def costs_of(left, right, count):
    costs = np.full((*left.shape[1:], -(-count // 32) * 32), 255, np.uint8)
    correlate(left, right, costs)
    return costs[:, :, :count]


@pytest.mark.parametrize("count", [1, 2, 5, 31, 32, 33, 64, 70])
@few
@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(1, 3), columns=st.integers(1, 9))
def test_correlate__equals_reference(count, seed, rows, columns):
    random = np.random.default_rng(seed)
    left, right = features(random, rows, columns), features(random, rows, columns + count - 1)
    found, expected = costs_of(left, right, count), COSINE_STEPS * reference.correlation(left, right)
    assert np.abs(found - expected).max() <= 0.5001


def test_correlate__worked_example():
    # Two features, one row. Left (1, 0) and (0.6, 0.8); right (1, 0), (0, 1), (-1, 0). With 125 steps the costs are
    #     125 (1 - 1), 125 (1 - 0)              = 0, 125
    #     125 (1 - 0.8), 125 (1 + 0.6)          = 25, 200
    left = np.array([[[1, 0.6]], [[0, 0.8]]], np.float32)
    right = np.array([[[1, 0, -1]], [[0, 1, 0]]], np.float32)
    assert COSINE_STEPS == 125
    assert costs_of(left, right, 2).tolist() == [[[0, 125], [25, 200]]]
    assert (125 * reference.correlation(left, right)).round(3).tolist() == [[[0, 125], [25, 200]]]


def test_correlate__spans_all_cosines():
    vector = features(np.random.default_rng(0), 1, 1)
    assert costs_of(vector, vector, 1).item() == 0
    assert costs_of(vector, -vector, 1).item() == 2 * COSINE_STEPS
    # Vectors that are too long, or NaN: nothing wraps around.
    assert costs_of(1.1 * vector, 1.1 * vector, 1).item() == 0
    assert costs_of(1.1 * vector, -1.1 * vector, 1).item() == 255
    assert costs_of(np.nan * vector, vector, 1).item() == 0
