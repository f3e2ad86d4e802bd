"""Points gathered in cells, against slow twins."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from sat_intervals.kernels.gridding import BOUNDED, empty_cells, gather, mean_heights, quantiles, splat


@settings(max_examples=60)
@given(seed=st.integers(0, 1000), rows=st.integers(1, 6), columns=st.integers(1, 7), radius=st.floats(0.01, 3))
def test_splat__and_quantiles_equal_their_slow_twins(seed, rows, columns, radius):
    random = np.random.default_rng(seed)
    count = random.integers(0, 13)
    column, row = random.uniform(-2, columns + 2, count), random.uniform(-2, rows + 2, count)
    height, confidence = random.normal(50, 10, count), random.random(count)
    height[random.random(count) < 0.2] = np.nan
    lower, upper = height - random.random(count), height + random.random(count)
    lower[random.random(count) < 0.2] = np.nan
    bounded = np.isfinite(lower)
    cells = empty_cells(rows, columns)
    splat(column, row, height, lower, upper, confidence, radius, cells)
    with_heights, counts = np.flatnonzero(bounded & ~np.isnan(height)), cells[BOUNDED].astype(np.int64)
    bounds = []
    for bound, share in ((lower, 0.25), (upper, 0.75)):
        listed, ends = np.empty(counts.sum(), np.float32), counts.cumsum().reshape(counts.shape) - counts
        for part in np.array_split(with_heights, 2):
            gather(column[part], row[part], bound[part], radius, ends, listed)
        bounds.append(quantiles(counts, listed, share))
    for i, j in np.ndindex(rows, columns):
        across, down = column - (j + 0.5), row - (i + 0.5)
        falls_in = np.maximum(abs(across), abs(down)) <= 0.5
        near = ((np.hypot(across, down) <= radius) | falls_in) & ~np.isnan(height)
        weight = np.exp(-(across**2 + down**2) / 2)[near]
        with_bounds = near & bounded
        sums = [weight.sum(), (weight * height[near]).sum(), (weight * confidence[near]).sum()]
        assert_allclose(cells[:3, i, j], sums, atol=1e-9)
        lows, highs = lower[with_bounds], upper[with_bounds]
        ends = min(lows, default=np.inf), max(highs, default=-np.inf)
        assert_array_equal(cells[3:, i, j], [near.sum(), with_bounds.sum(), *ends])
        assert_allclose(mean_heights(cells)[i, j], sums[1] / sums[0] if near.any() else np.nan)
        expected = (np.quantile(lows, 0.25), np.quantile(highs, 0.75)) if with_bounds.any() else (np.nan, np.nan)
        assert_allclose([bound[i, j] for bound in bounds], expected, rtol=1e-6)
