"""Conformal margins."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sat_intervals.kernels.conformal import least_number, margins, widened


@pytest.mark.parametrize(("coverage", "number"), [(0.5, 30), (0.6, 30), (0.9, 100), (0.95, 200), (0.99, 1000)])
def test_least_number__is_that_of_ten_misses_or_thirty(coverage, number):
    assert least_number(coverage) == number


def test_margins__worked_example():
    # 99 scores -49 to 49: rank ceil(100 x .9) = 90, the score 40. Twice 0 to 49.5: rank ceil(101 x .9) = 91, 45.
    scores = np.concatenate([np.arange(-49.0, 50), np.arange(0, 50, 0.5)])
    classes = np.repeat([0, 1], [99, 100])
    np.testing.assert_array_equal(margins(scores, classes, 2, 0.9), [40, 45])


@given(seed=st.integers(0, 10_000), coverage=st.sampled_from([0.5, 0.8, 0.9, 0.95]))
def test_margins__reach_the_coverage_of_each_class_and_no_more(seed, coverage):
    random = np.random.default_rng(seed)
    count = random.integers(least_number(coverage), 4 * least_number(coverage), 3)
    classes = random.permutation(np.repeat(np.arange(3), count))
    height = random.normal(0, 3, classes.size)
    truth = random.standard_t(2, classes.size) * (1 + classes)
    limits, size = np.array([2.0, 4.0]), np.array([1.0, 3.0, 5.0])[classes]
    share = random.random(classes.size)
    lower, upper = height - share * size, height + (1 - share) * size
    margin = margins(np.maximum(lower - truth, truth - upper), classes, 3, coverage)
    low, high = widened(height, lower, upper, limits, margin)
    assert (low <= height).all()
    assert (height <= high).all()
    inside = (low - 1e-9 <= truth) & (truth <= high + 1e-9)
    for kind in range(3):
        own = classes == kind
        assert inside[own].mean() >= coverage
        if margin[kind] >= 0:  # else bounds that stop at the height contain more
            assert inside[own].mean() <= coverage + 2 / own.sum()


def test_widened__a_negative_margin_stops_at_the_height():
    height, lower, upper = np.array([5.0, 5, 5, np.nan]), np.array([1.0, 4, 5, np.nan]), np.array([9.0, 9, 6, np.nan])
    low, high = widened(height, lower, upper, np.array([2.0]), np.array([-3.0, -2.0]))
    np.testing.assert_array_equal(low, [3, 5, 5, np.nan])
    np.testing.assert_array_equal(high, [7, 7, 5, np.nan])
