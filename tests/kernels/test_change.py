"""Cells drawn to another grid, and connected areas of change."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.kernels.change import connected, drawn, painted


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


def test_connected__worked_example():
    # Sign 1: the three cells of the first column with one sure cell, a single sure one, and two sure ones on the right
    # that touch along a row. An area of at least two sure cells is the last alone; of one, all three.
    signs = np.array([[1, 0, 2, 0, 1, 2], [1, -2, 0, 0, 0, 2], [2, -2, -1, 0, 0, 0]], np.int8)
    whole = 0, 0, 3, 6
    assert painted(*connected(signs, 1, 2), whole).tolist() == [[0, 0, 0, 0, 1, 1], [0, 0, 0, 0, 0, 1], [0] * 6]
    assert painted(*connected(signs, 1, 1), whole).tolist() == [
        [1, 0, 2, 0, 3, 3], [1, 0, 0, 0, 0, 3], [1, 0, 0, 0, 0, 0]
    ]  # fmt: skip
    assert painted(*connected(signs, -1, 2), (1, 1, 2, 2)).tolist() == [[1, 0], [1, 1]]


@settings(derandomize=True, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.2, 0.8))
def test_connected__areas_are_apart_and_whole(seed, share):
    """Cells that touch have one area, and as many areas are found as a fill from each cell finds."""
    inside = np.random.default_rng(seed).random((9, 11)) < share
    labels = painted(*connected(2 * inside.astype(np.int8), 1, 1), (0, 0, 9, 11))
    assert ((labels > 0) == inside).all()
    for one, other in ((labels[1:], labels[:-1]), (labels[:, 1:], labels[:, :-1])):
        assert (one == other)[(one > 0) & (other > 0)].all()
    left, count = set(zip(*np.nonzero(inside), strict=True)), 0
    while left:
        grown, count = [left.pop()], count + 1
        while grown:
            i, j = grown.pop()
            near = {(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)} & left
            left -= near
            grown += near
    assert labels.max() == count
