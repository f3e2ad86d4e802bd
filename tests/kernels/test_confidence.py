"""Ambiguity, confidence and low confidence against their slow twins."""

from types import SimpleNamespace

import numpy as np
import pytest
import reference
from helpers import matched
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sat_intervals.config import Ambiguity
from sat_intervals.kernels.confidence import low_confidence, normalize, surroundings
from sat_intervals.kernels.cost import Codes, between
from sat_intervals.kernels.matching import match_costs
from sat_intervals.kernels.sweeps import Settings
from sat_intervals.match.postprocess import confidence_scale
from sat_intervals.products import IMPOSSIBLE_COST, NO_DATA
from sat_intervals.tiling import Window

bounded = settings(max_examples=30, derandomize=True, deadline=None)
few = settings(max_examples=20, derandomize=True, deadline=None)
N = np.nan
X = IMPOSSIBLE_COST


# ---- Ambiguity ---------------------------------------------------------------------------------------------
def test_match_costs__ambiguity_worked_example():
    # Census 5 without SGM: span 24. Etas 0, .05, .1: costs up to 0, 1 (1.2), 2 (2.4) above the least.
    #     9 3 5 9     6 0 2 6 above: 1 + 1 + 2 = 4
    #     4 4 4 7     0 0 0 3 above: 3 + 3 + 3 = 9
    #     . 2 6 4     . 0 4 2 above, the impossible one counts for every eta: 2 + 2 + 3 = 7
    curves = np.array([[9, 3, 5, 9], [4, 4, 4, 7], [X, 2, 6, 4]])
    words = (1 << np.where(curves == X, 0, curves).astype(np.uint64)) - 1
    left = Codes(np.zeros((1, 3, 1), np.uint32), np.zeros((3, 1), np.uint8))
    right = Codes(words.astype(np.uint32)[np.newaxis], np.where(curves == X, NO_DATA, 0).astype(np.uint8))
    scene = SimpleNamespace(window=5, minimum=-2, count=4, p1=8, p2=32, regularized=False)
    parameters = Settings(**reference.settings_of(scene, eta_max="0.15", eta_step="0.05"))
    assert parameters.weights.tolist() == [3, 2, 1] + 22 * [0]
    raw, *_ = match_costs(between(left, right), parameters, Window(0, 0, 3, 1))
    assert raw.ambiguity.tolist() == [[4], [9], [7]]
    assert reference.ambiguity(curves[:, np.newaxis], "0.15", "0.05", 24).tolist() == [[4], [9], [7]]


@pytest.mark.parametrize("etas", [("0.7", "0.01"), ("0.33", "0.1"), ("1", "0.07"), ("0.01", "0.01")])
@bounded
@given(scene=reference.scenes())
def test_match_costs__ambiguity_equals_reference(etas, scene):
    raw = matched(scene, eta_max=etas[0], eta_step=etas[1])[0]
    expected = reference.ambiguity(reference.volume_of(scene), *etas, reference.span_of(scene))
    np.testing.assert_array_equal(raw.ambiguity, expected)
    assert raw.ambiguity.dtype == np.uint32


@few
@given(scene=reference.scenes())
def test_match_costs__without_ambiguity(scene):
    (raw, _), (whole, _) = matched(scene, eta_max=None), matched(scene)
    assert (raw.ambiguity == 0).all()
    for name in ("winner", "lower", "upper", "disparity", "validity"):
        np.testing.assert_array_equal(getattr(raw, name), getattr(whole, name))


# ---- Confidence --------------------------------------------------------------------------------------------
def test_confidence_scale__of_equal_percentiles_is_the_whole_range():
    histogram = np.zeros(71, np.int64)
    histogram[[3, 40]] = 1, 1000
    assert confidence_scale(Ambiguity(), histogram)[:2] == (0, 70)
    histogram[3] = 100
    assert confidence_scale(Ambiguity(), histogram)[:2] == (3, 40)


def test_confidence_scale__keeps_all_but_the_share_of_doubtful_pixels():
    histogram = np.full(100, 10, np.int64)
    assert confidence_scale(Ambiguity(), histogram).most == np.inf
    most = confidence_scale(Ambiguity(), histogram, 0.05).most
    assert histogram[np.arange(100) > most].sum() == pytest.approx(50, abs=10)


def test_normalize__worked_example():
    # p1 = 2, p99 = 6: 1 - (A - 2) / 4 within 0 and 1; no candidate at (1, 3) and (2, 0).
    amounts = np.array([[0, 2, 3, 4], [5, 6, 7, 0], [0, 9, 2, 6]], np.uint32)
    searched = np.array([[1, 1, 1, 1], [1, 1, 1, 0], [0, 1, 1, 1]], bool)
    expected = np.array([[1, 1, 0.75, 0.5], [0.25, 0, 0, N], [N, 0, 1, 0]], np.float32)
    for confidence in (normalize(amounts, searched, 2.0, 6.0), reference.normalize(amounts, searched, 2, 6)):
        assert confidence.dtype == np.float32
        np.testing.assert_array_equal(confidence, expected)


@bounded
@given(
    amounts=hnp.arrays(np.uint32, (4, 7), elements=st.integers(0, 5000) | st.integers(0, 2**31)),
    searched=hnp.arrays(bool, (4, 7)),
    p1=st.floats(0, 2000),
    width=st.floats(0, 3000),
)
def test_normalize__equals_reference(amounts, searched, p1, width):
    expected = reference.normalize(amounts, searched, p1, p1 + width)
    np.testing.assert_array_equal(normalize(amounts, searched, p1, p1 + width), expected)


# ---- Low confidence ----------------------------------------------------------------------------------------
def test_low_confidence__worked_example():
    # 1 x 3, threshold .6: .5 makes its neighbours low; .6 itself is low; a pixel without candidate is not low
    # and makes no other low; .61 is not low; 0 at the border reaches one pixel.
    confidence = np.array([[0.9, 0.5, 0.9, 0.9], [N, 0.6, N, 0.9], [0.9, 0.61, 0.9, 0]], np.float32)
    expected = [[True, True, True, False], [False, True, False, False], [False, False, True, True]]
    assert low_confidence(confidence, 0.6, 3).tolist() == expected
    assert reference.low_confidence(confidence, 0.6, 3).tolist() == expected


confidences = st.sampled_from([0, 0.25, 0.5, 0.59, 0.6, 0.61, 0.75, 1, N]).map(np.float32).map(float)


@bounded
@given(
    confidence=hnp.arrays(np.float32, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=confidences),
    threshold=st.sampled_from([0.0, 0.25, 0.6, 1.0]),
    kernel=st.sampled_from([1, 3, 5, 7, 21]),
)
def test_low_confidence__equals_reference(confidence, threshold, kernel):
    expected = reference.low_confidence(confidence, threshold, kernel)
    np.testing.assert_array_equal(low_confidence(confidence, threshold, kernel), expected)


# ---- Surroundings --------------------------------------------------------------------------------------------
@few
@given(data=st.data(), shape=hnp.array_shapes(min_dims=2, max_dims=2, max_side=8))
def test_surroundings__equals_a_slow_twin(data, shape):
    values = data.draw(hnp.arrays(np.float32, shape, elements=st.sampled_from([-2.5, 0, 1, 7.25])))
    kept = data.draw(hnp.arrays(bool, shape))
    values[~kept & data.draw(hnp.arrays(bool, shape))] = N
    size = data.draw(st.sampled_from([1, 3, 5, 9]))
    lowest, highest, whole = surroundings(values, kept, size)
    for r, c in np.ndindex(shape):
        around = tuple(slice(max(0, i - size // 2), i + size // 2 + 1) for i in (r, c))
        there = values[around][kept[around]]
        assert (lowest[r, c], highest[r, c]) == (there.min(initial=np.inf), there.max(initial=-np.inf))
        assert whole[r, c] == kept[around].all()
