"""Conformal margins."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sat_intervals.kernels.conformal import Margins, least_number, limits_between, margin_of, relief_of, widened


@pytest.mark.parametrize(("coverage", "number"), [(0.5, 30), (0.6, 30), (0.9, 100), (0.95, 200), (0.99, 1000)])
def test_least_number__is_that_of_ten_misses_or_thirty(coverage, number):
    assert least_number(coverage) == number


def test_margin_of__worked_example():
    # 99 scores -49 to 49: rank ceil(100 x .9) = 90, the score 40. 100 scores 0 to 49.5: rank ceil(101 x .9) = 91, 45.
    assert margin_of(np.arange(-49.0, 50), 0.9) == 40
    assert margin_of(np.arange(0, 50, 0.5)[::-1], 0.9) == 45


@given(seed=st.integers(0, 10_000), coverage=st.sampled_from([0.5, 0.8, 0.9, 0.95]))
def test_margin_of__reaches_the_coverage_and_no_more(seed, coverage):
    random = np.random.default_rng(seed)
    count = random.integers(least_number(coverage), 4 * least_number(coverage))
    height, truth = random.normal(0, 3, count), random.standard_t(2, count)
    share, size = random.random(count), random.choice([1.0, 3.0])
    lower, upper = height - share * size, height + (1 - share) * size
    margin = margin_of(np.maximum(lower - truth, truth - upper), coverage)
    low, high = widened(height, lower, upper, np.full(count, margin))
    assert ((low <= height) & (height <= high)).all()
    inside = ((low - 1e-9 <= truth) & (truth <= high + 1e-9)).mean()
    assert inside >= coverage
    if margin >= 0:  # else bounds that stop at the height contain more
        assert inside <= coverage + 2 / count


def test_widened__a_negative_margin_stops_at_the_height():
    height, lower, upper = np.array([5.0, 5, 5, np.nan]), np.array([1.0, 4, 5, np.nan]), np.array([9.0, 9, 6, np.nan])
    low, high = widened(height, lower, upper, np.array([-2.0, -2, -3, -2]))
    np.testing.assert_array_equal(low, [3, 5, 5, np.nan])
    np.testing.assert_array_equal(high, [7, 7, 5, np.nan])


def test_margins__of_classes_of_relief_and_of_half_width_in_each():
    table = Margins(np.array([2.0]), (np.array([1.0]), np.empty(0)), (np.array([0.1, 0.2]), np.array([0.3])))
    half_width, relief = np.array([[0.5, 1, 9, 0.5]]), np.array([[1.9, 0, 1, 2]])
    np.testing.assert_array_equal(table.of(half_width, relief), [[0.1, 0.2, 0.2, 0.3]])


@given(seed=st.integers(0, 10_000))
def test_relief_of__is_the_range_of_the_known_heights_around(seed):
    random = np.random.default_rng(seed)
    height = random.normal(0, 1, random.integers(1, 9, 2))
    height[random.random(height.shape) < 0.6] = np.nan
    for (i, j), found in np.ndenumerate(relief_of(height)):
        near = height[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3]
        known = near[np.isfinite(near)]
        np.testing.assert_equal(found, np.ptp(known) if known.size else np.nan)


def test_limits_between__fewer_classes_with_few_values_and_equal_ones_together():
    values = np.repeat([1.0, 2.0, 3.0, 4.0], 10)
    np.testing.assert_array_equal(limits_between(values, 4, 10), [1.755, 2.505, 3.255])
    np.testing.assert_array_equal(limits_between(values, 4, 15), [2.505])
    assert limits_between(values, 4, 21).size == limits_between(np.ones(40), 4, 10).size == 0
