"""Cells drawn to another grid."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.kernels.change import drawn


def slow_drawn(bands, x, y, reach):
    """Gather the cells nearer than the reach along both axes; NaN if one is unknown or outside."""
    rows, columns = bands.shape[1:]
    near = [
        (i, j, (reach - abs(y - i)) * (reach - abs(x - j)))
        for i in range(-9, rows + 9)
        for j in range(-9, columns + 9)
        if abs(y - i) < reach and abs(x - j) < reach
    ]
    if any(not (0 <= i < rows and 0 <= j < columns) for i, j, _ in near):
        return [np.nan] * 3
    height, lower, upper = np.array([bands[:, i, j] for i, j, _ in near]).T
    return [np.average(height, weights=[weight for *_, weight in near]), lower.min(), upper.max()]


@settings(derandomize=True, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1.0, 1.5, 2.0]))
def test_drawn__equals_the_slow_twin(seed, reach):
    random = np.random.default_rng(seed)
    height = random.normal(size=(6, 7))
    bands = np.stack([height, height - random.random((6, 7)), height + random.random((6, 7))])
    bands[random.random(bands.shape) < 0.03] = np.nan
    x, y = random.uniform(-1, 8, (2, 20)).round(1)
    expected = np.transpose([slow_drawn(bands, *place, reach) for place in zip(x, y, strict=True)])
    np.testing.assert_allclose(drawn(bands, x, y, reach), expected)
