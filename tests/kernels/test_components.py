"""Connected components of a disparity map."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.kernels.components import component_sizes, components


def slow_sizes(disparity, known):
    """Spread the smallest number of each component until nothing changes, then count."""
    label = np.where(known, np.arange(known.size).reshape(known.shape), -1)
    while True:
        before = label.copy()
        for (r, c), (y, x) in ((a, b) for a in np.ndindex(known.shape) for b in neighbours(*a, known.shape)):
            if known[r, c] and known[y, x] and abs(disparity[r, c] - disparity[y, x]) <= 1:
                label[r, c] = label[y, x] = min(label[r, c], label[y, x])
        if (before == label).all():
            return np.array([[(label == one).sum() if one >= 0 else 0 for one in row] for row in label])


def neighbours(r, c, shape):
    return [(y, x) for y, x in ((r + 1, c), (r, c + 1)) if y < shape[0] and x < shape[1]]


def test_component_sizes__worked_example():
    disparity = np.array([[0, 1, 5, 5], [9, 2, 9, 6], [0, 0, 0, 0]], np.float32)
    known = np.array([[1, 1, 1, 1], [0, 1, 0, 1], [1, 1, 0, 1]], bool)
    assert component_sizes(disparity, known).tolist() == [[3, 3, 3, 3], [0, 3, 0, 3], [2, 2, 0, 1]]


@settings(derandomize=True, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.2, 1))
def test_component_sizes__equals_the_slow_twin(seed, share):
    random = np.random.default_rng(seed)
    disparity = random.integers(0, 4, (5, 7)).astype(np.float32)
    known = random.random(disparity.shape) < share
    np.testing.assert_array_equal(component_sizes(disparity, known), slow_sizes(disparity, known))


@settings(derandomize=True, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.2, 1))
def test_components__have_numbers_in_the_order_of_their_first_pixels(seed, share):
    random = np.random.default_rng(seed)
    signs = (random.integers(-2, 3, (5, 7)) * (random.random((5, 7)) < share)).astype(np.int8)
    labels = components(signs, signs != 0)
    numbers, first = np.unique(labels[signs != 0], return_index=True)
    assert numbers.tolist() == list(range(1, numbers.size + 1))
    assert (np.diff(first) > 0).all()
    assert all((np.sign(signs[labels == one]) == np.sign(signs[labels == one][0])).all() for one in numbers)
    sizes = np.bincount(labels.ravel())[labels] * (signs != 0)
    np.testing.assert_array_equal(sizes, slow_sizes(signs, signs != 0))
