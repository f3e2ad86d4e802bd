"""Significance of differences, and correlation of their errors."""

import numpy as np
import pytest

from sat_intervals.kernels.significance import Correlation, correlation_of, probability, ratio_of

# Two-sided quantiles of Student's distribution with 4 degrees of freedom, from its tables.
TABLE = {0.5: 0.741, 0.1: 2.132, 0.05: 2.776, 0.01: 4.604, 0.001: 8.610}


@pytest.mark.parametrize(("rate", "quantile"), TABLE.items())
def test_probability__is_that_of_student(rate, quantile):
    assert probability(np.array([-0.5 * quantile, 0.5 * quantile]), 0.5) == pytest.approx(rate, rel=2e-3)
    assert ratio_of(rate, 2.0) == pytest.approx(2 * quantile, rel=1e-3)


def test_within__nears_one_in_small_areas_and_the_integral_in_large_ones():
    distances = np.arange(0, 60, 0.25)
    found = Correlation(1.0, distances.tolist(), np.exp(-distances / 4).tolist())
    assert found.within(0.01) == pytest.approx(1, abs=0.02)
    # 2 pi L^2 / area, less the part beyond the edge
    assert found.within(40_000) == pytest.approx(2 * np.pi * 16 / 40_000, rel=0.06)


def test_correlation_of__finds_that_of_smoothed_noise():
    noise = np.random.default_rng(0).normal(size=(256, 256))
    smooth = sum(np.roll(noise, shift, axis) for axis in (0, 1) for shift in range(4))  # two lines of four cells each
    smooth[:, 7] = np.nan
    found = correlation_of([smooth[:128], smooth[128:]], 0.5)
    variance = np.nanvar(smooth)
    assert found.variance == pytest.approx(variance, rel=0.02)
    # a cell apart along rows: three of four products of one line, those of the other line once
    expected = np.nanmean(smooth[:, 1:] * smooth[:, :-1]) / variance
    assert found.distances[:2] == [0.0, 0.5]
    assert found.values[1] == pytest.approx(expected, abs=0.03)
    assert max(found.values[5:], default=0) < 0.1
