"""Aggregated costs: the sweeps of eight paths against the slow twin, and the laws of the aggregation."""

from types import SimpleNamespace

import numpy as np
import pytest
import reference
from helpers import codes_of
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.kernels.cost import Cells, Codes, Costs, between
from sat_intervals.kernels.matching import cost_volume, match_costs
from sat_intervals.kernels.penalties import Gradients, Rule
from sat_intervals.kernels.sweeps import Settings
from sat_intervals.products import IMPOSSIBLE_COST, MASKED, NO_BOUND, NO_DATA
from sat_intervals.tiling import Window

bounded = settings(max_examples=50, derandomize=True, deadline=None)
few = settings(max_examples=20, derandomize=True, deadline=None)
COUNTS = (1, 31, 32, 33, 64, 65, 97)
X = IMPOSSIBLE_COST


def volume(scene, **changes):
    """The kernel's aggregated costs of a scene."""
    scene = SimpleNamespace(**{**vars(scene), **changes})
    return cost_volume(between(*codes_of(scene)), Settings(**reference.settings_of(scene)))


def bare_codes(levels):
    """Codes whose Hamming distances are the differences of the levels: ``level`` bits are set."""
    words = (1 << np.asarray(levels, np.uint64)) - 1
    return Codes(words.astype(np.uint32)[np.newaxis], np.zeros(words.shape, np.uint8))


def example_settings(count, regularized=True):
    scene = SimpleNamespace(window=3, minimum=0, count=count, p1=1, p2=3, regularized=regularized)
    return Settings(**reference.settings_of(scene))


def test_cost_volume__worked_example():
    # One row of 4 pixels, 2 disparities, P1 = 1, P2 = 3. Costs C(c, k):
    #     c        0      1      2      3
    #     C      0 5    5 2    2 7    7 1
    # from the left,  L(c) = C + min(L(q), L(q, other) + 1, min L(q) + 3) - min L(q):
    #     L      0 5    5 3    3 7    7 2      e.g. L(1, 1) = 2 + min(5, 0 + 1, 0 + 3) - 0 = 3
    # from the right:
    #     L      1 5    5 3    3 7    7 1      e.g. L(2, 0) = 2 + min(7, 1 + 1, 1 + 3) - 1 = 3
    # The other six paths have one pixel in the row, L = C, so S = 6 C + both:
    #     S      1 40  40 18  18 56  56 9
    left, right = bare_codes([[0, 0, 0, 0]]), bare_codes([[0, 5, 2, 7, 1]])
    expected = [[[1, 40], [40, 18], [18, 56], [56, 9]]]
    assert cost_volume(between(left, right), example_settings(2)).tolist() == expected
    cost = np.array([[[0, 5], [5, 2], [2, 7], [7, 1]]])
    assert reference.aggregate(cost, 3, 1, 3).tolist() == expected


def test_cost_volume__paths_restart_behind_empty_pixels():
    # The same row, its second pixel masked. Pixel 0 stands alone: S = 8 C. From the left, the path restarts:
    #     L      0 5    . .    2 7    7 2      L(3, 1) = 1 + min(7, 2 + 1, 2 + 3) - 2 = 2
    #     L      0 5    . .    3 7    7 1      from the right
    left, right = bare_codes([[0, 0, 0, 0]]), bare_codes([[0, 5, 2, 7, 1]])
    left.state[0, 1] = MASKED
    expected = [[[0, 40], [X, X], [17, 56], [56, 9]]]
    assert cost_volume(between(left, right), example_settings(2)).tolist() == expected
    cost = np.array([[[0, 5], [X, X], [2, 7], [7, 1]]])
    assert reference.aggregate(cost, 3, 1, 3).tolist() == expected


def test_cost_volume__impossible_candidates_cost_more_inside():
    # Two pixels, the right pixel both can see is no data: C = 0 X, X 1. Inside, X = 3^2 + 3 + 1 = 13.
    #     from the left     L(1, 1) = 1 + min(13, 0 + 1, 0 + 3) - 0 = 2
    #     from the right    L(0, 0) = 0 + min(13, 1 + 1, 1 + 3) - 1 = 1
    left, right = bare_codes([[0, 0]]), bare_codes([[0, 5, 1]])
    right.state[0, 1] = NO_DATA
    expected = [[[1, X], [X, 9]]]
    assert cost_volume(between(left, right), example_settings(2)).tolist() == expected
    assert reference.aggregate(np.array([[[0, X], [X, 1]]]), 3, 1, 3).tolist() == expected


@bounded
@given(scene=reference.scenes())
def test_cost_volume__equals_reference(scene):
    np.testing.assert_array_equal(volume(scene), reference.volume_of(scene))


@pytest.mark.parametrize("regularized", [True, False])
@pytest.mark.parametrize("count", COUNTS)
@few
@given(data=st.data())
def test_cost_volume__equals_reference_at_every_count(count, regularized, data):
    scene = data.draw(reference.scenes(counts=(count,), windows=(3, 5, 7, 9, 11), rows=4, columns=9))
    scene.regularized = regularized
    np.testing.assert_array_equal(volume(scene), reference.volume_of(scene))


def test_cost_volume__penalties_at_their_limit():
    # 8 * (window^2 - 1 + P2) = 65528, the largest multiple of 8 in 16 bits. The sums of impossible candidates
    # are greater and may saturate: nobody reads them.
    p2 = IMPOSSIBLE_COST // 8 - 120
    rng = np.random.default_rng(1)
    patches = reference.patch_pair(5, 5, 8, 6, 11, "noise")
    scene = reference.scene_of(patches, window=11, minimum=0, count=6, p1=p2, p2=p2)
    scene.right_state[rng.random(scene.right_state.shape) < 0.005] = NO_DATA
    expected = reference.volume_of(scene)
    assert (expected == IMPOSSIBLE_COST).any()
    np.testing.assert_array_equal(volume(scene), expected)


@few
@given(scene=reference.scenes())
def test_cost_volume__possible_costs_stay_within_the_declared_span(scene):
    costs = volume(scene)
    assert costs[costs != IMPOSSIBLE_COST].max(initial=0) <= reference.span_of(scene)


# ---- Penalties that follow the gradients -------------------------------------------------------------------
def gradients_of(scene, p1, p2, left_edge, right_edge):
    """The windows' centres of a scene's images, and a rule."""
    radius = scene.window // 2
    inner = np.s_[radius : scene.left.shape[0] - radius]
    left, right = (
        np.ascontiguousarray(image[inner, radius : image.shape[1] - radius]) for image in (scene.left, scene.right)
    )
    return Gradients(left, right, Rule(p1, p2, float(left_edge), float(right_edge)))


def varying_volume(scene, gradients):
    return cost_volume(between(*codes_of(scene)), Settings(**reference.settings_of(scene)), gradients)


def expected_volume(scene, penalties):
    cost = reference.census_cost(scene.left, scene.right, scene.left_state, scene.right_state, scene.window)
    return reference.aggregate_with(cost, scene.window**2 + scene.p2 + 1, penalties)


# P1 and P2 by path, along the row, the falling and the rising diagonal and the column, and by images with an edge.
P1 = np.array([[6, 3, 1], [5, 2, 1], [7, 4, 2], [3, 2, 0]], np.uint16)
P2 = np.array([[40, 20, 3], [41, 21, 4], [42, 22, 5], [43, 23, 6]], np.uint16)


def line_of(step):
    """Which of the four lines a path follows."""
    return 0 if step[0] == 0 else 3 if step[1] == 0 else 1 if step[0] == step[1] else 2


# Windows whose Census codes have 32 bits: gradients and wider codes do not meet in a kernel.
small_windows = reference.scenes(windows=(3, 5), rows=6, columns=12)


@pytest.mark.peer("onnxruntime", "mc_cnn")  # only MC-CNN has gradients: kernels compiled for no other test
@bounded
@given(scene=small_windows, left_edge=st.integers(0, 6), right_edge=st.integers(0, 6))
def test_cost_volume__equals_reference_with_penalties_that_follow_edges(scene, left_edge, right_edge):
    scene.regularized, scene.p2 = True, int(P2.max())
    gradients = gradients_of(scene, P1, P2, left_edge, right_edge)

    def penalties(step):
        tables, edges = (P1[line_of(step)], P2[line_of(step)]), (left_edge, right_edge)
        return reference.edge_penalties(gradients.left, gradients.right, scene.count, step, tables, edges)

    np.testing.assert_array_equal(varying_volume(scene, gradients), expected_volume(scene, penalties))


@pytest.mark.peer("onnxruntime", "mc_cnn")  # only MC-CNN stores costs: kernels compiled for no other test
@few
@given(scene=reference.scenes(windows=(3, 5)))
def test_cost_volume__of_stored_costs_equals_that_of_codes(scene):
    # The same Hamming distances, computed beforehand; what stands at impossible candidates is not looked at.
    left, right = codes_of(scene)
    rows, columns = left.state.shape
    stored = np.full((rows, columns, -(-scene.count // 32) * 32), 255, np.uint8)
    for k in range(scene.count):
        differing = left.words ^ right.words[:, :, k : k + columns]
        stored[:, :, k] = np.bitwise_count(differing).sum(axis=0)
    costs = Costs(stored, None, left.state, right.state)
    parameters = Settings(**reference.settings_of(scene))
    np.testing.assert_array_equal(cost_volume(costs, parameters), cost_volume(between(left, right), parameters))


@few
@given(seed=st.integers(0, 2**32 - 1), before=st.integers(0, 70), after=st.integers(0, 70), holes=st.booleans())
def test_match_costs__candidates_that_no_cell_searches_change_nothing(seed, before, after, holes):
    """Cells of random ranges in a hull and in a wider one: other vectors contain the candidates of each pixel."""
    random, (rows, columns, count) = np.random.default_rng(seed), (9, 21, 80)
    largest = 8 * (24 + 32)  # eight paths, each at most a code's 24 bits and P2
    weights = np.arange(largest + 1, 0, -1).astype(np.uint16)
    ends = np.sort(random.integers(0, count, (2, 3, 4)), axis=0)
    whole = Window(0, 0, rows, columns)

    def codes(width):
        words = random.integers(0, 2**24, (1, rows, width), np.uint32)
        return Codes(words, np.where(random.random((rows, width)) < 0.15 * holes, NO_DATA, 0).astype(np.uint8))

    def matched(right, padding):
        total = right.state.shape[1] + 1 - columns
        settings = Settings(-padding, total, 77, 8, 32, True, 60, weights, True)
        cells = Cells(ends[0] + padding, ends[1] + padding, 4, 6, 2, 1)
        return match_costs(between(left, right), settings, whole, cells=cells)

    left, right = codes(columns), codes(columns + count - 1)
    sides = codes(before), right, codes(after)
    wider = Codes(*(np.concatenate(parts, axis=-1) for parts in zip(*sides, strict=True)))
    narrow, wide = matched(right, 0), matched(wider, before)
    for name, products in narrow.raw._asdict().items():
        if name in ("lower", "upper", "lower_low", "upper_low"):  # steps from the first candidate
            products = np.where(products == NO_BOUND, products, products + before)
        np.testing.assert_array_equal(getattr(wide.raw, name), products, name)
    inner = slice(before, before + right.state.shape[1])
    np.testing.assert_array_equal(wide.right.winner[:, inner], narrow.right.winner)
