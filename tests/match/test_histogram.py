"""Quantiles of histograms against numpy on the values; `Histogram` has more tests with its users."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sat_intervals.match.histogram import quantile


@settings(max_examples=30, derandomize=True, deadline=None)
@given(
    counts=hnp.arrays(np.int64, st.integers(1, 60), elements=st.integers(0, 40)).filter(np.any),
    share=st.sampled_from([0.01, 0.05, 0.5, 0.9, 0.99, 1.0]),
)
def test_quantile__equals_numpy_on_the_values(counts, share):
    values = np.random.default_rng(counts.size).permutation(counts.size) - 5
    assert quantile(values, counts, share) == np.quantile(np.repeat(values, counts), share)


def test_quantile__of_a_very_large_image():
    # 10^12 pixels: ranks do not fit in 32 bits.
    counts = np.array([10**10 + 1, 98 * 10**10 - 2, 10**10 + 1])
    assert [quantile(np.array([10, 500, 900]), counts, share) for share in (0.01, 0.99)] == pytest.approx([10, 900])


def test_quantile__of_nothing_is_nan():
    assert np.isnan(quantile(np.arange(5), np.zeros(5, np.int64), 0.5))
