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
from sat_intervals.products import IMPOSSIBLE_COST, MASKED, NO_DATA
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


def test_cost_volume__all_directions_worked_example():
    # 3 x 4 pixels of one grey but for a step of 8 at (1, 1), 1 disparity: then L = C on every path, S = 8 C.
    levels = np.zeros((3, 4), int)
    levels[1, 1] = 8
    expected = 8 * levels[:, :, np.newaxis]
    left, right = bare_codes(np.zeros((3, 4), int)), bare_codes(levels)
    np.testing.assert_array_equal(cost_volume(between(left, right), example_settings(1)), expected)


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


@pytest.mark.parametrize("count", [1, 33])
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (9, 2), (7, 3), (12, 5), (5, 12)])
@few
@given(data=st.data())
def test_cost_volume__equals_reference_on_narrow_and_tall_patches(shape, count, data):
    # Diagonals that leave the patch and enter it again, in every proportion of rows to columns.
    patches = reference.patch_pair(data.draw(st.integers(0, 2**32 - 1)), *shape, count, 5)
    states = [data.draw(reference.states(patch.shape)) for patch in patches]
    scene = reference.scene_of(patches, states=states, window=5, minimum=-3, count=count)
    np.testing.assert_array_equal(volume(scene), reference.volume_of(scene))


@pytest.mark.parametrize("seed", range(6))
def test_cost_volume__equals_reference_around_holes(seed):
    # Holes in the middle of the left image: paths of all directions end before them and restart behind them.
    random = np.random.default_rng(seed)
    patches = reference.patch_pair(random, 12, 22, 7, 3, "shifted" if seed % 2 else "noise")
    scene = reference.scene_of(patches, window=3, minimum=0, count=7)
    for _ in range(3):
        scene.left_state[random.integers(3, 11), random.integers(3, 20)] = random.integers(1, 4)
        scene.right_state[random.integers(3, 11), random.integers(3, 28)] = random.integers(1, 4)
    expected = reference.volume_of(scene)
    assert (expected == IMPOSSIBLE_COST).all(axis=2).any()
    np.testing.assert_array_equal(volume(scene), expected)


def test_cost_volume__penalties_at_their_limit():
    # 8 * (window^2 - 1 + P2) = 65528, the largest multiple of 8 in 16 bits. The sums of impossible candidates
    # are greater and may saturate: nobody reads them.
    p2 = IMPOSSIBLE_COST // 8 - 120
    rng = np.random.default_rng(1)
    left, right = reference.patch_pair(5, 5, 8, 6, 11, "noise")
    right_state = np.zeros(right.shape, np.uint8)
    right_state[rng.random(right.shape) < 0.005] = NO_DATA
    scene = SimpleNamespace(
        left=left,
        right=right,
        left_state=np.zeros(left.shape, np.uint8),
        right_state=right_state,
        window=11,
        minimum=0,
        count=6,
        p1=p2,
        p2=p2,
        regularized=True,
    )
    expected = reference.volume_of(scene)
    assert (expected == IMPOSSIBLE_COST).any()
    np.testing.assert_array_equal(volume(scene), expected)


@few
@given(scene=reference.scenes())
def test_cost_volume__possible_costs_stay_within_the_declared_span(scene):
    costs = volume(scene)
    assert costs[costs != IMPOSSIBLE_COST].max(initial=0) <= reference.span_of(scene)


@few
@given(scene=reference.scenes(), left_offset=st.integers(-500, 500), right_offset=st.integers(-500, 500))
def test_cost_volume__unchanged_by_a_constant_on_either_image(scene, left_offset, right_offset):
    before = volume(scene)
    scene.left, scene.right = scene.left + left_offset, scene.right + right_offset
    np.testing.assert_array_equal(before, volume(scene))


@few
@given(scene=reference.scenes())
def test_cost_volume__turns_with_the_images(scene):
    # The eight paths are symmetric: upside down, and seen in a mirror, where index k becomes count - 1 - k.
    def turned(step_rows, step_columns):
        flip = np.s_[::step_rows, ::step_columns]
        # contiguous: the Census transform is compiled again for other arrays, and has a test of its own for them
        images = {
            name: np.ascontiguousarray(getattr(scene, name)[flip])
            for name in ("left", "right", "left_state", "right_state")
        }
        return volume(SimpleNamespace(**{**vars(scene), **images}))

    np.testing.assert_array_equal(volume(scene), turned(-1, 1)[::-1])
    np.testing.assert_array_equal(volume(scene), turned(1, -1)[:, ::-1, ::-1])


@few
@given(scene=reference.scenes())
def test_cost_volume__without_penalties_is_eight_times_the_cost(scene):
    # With P1 = P2 = 0 a path forgets: L = C.
    plain = volume(scene, regularized=False).astype(int)
    free = volume(scene, regularized=True, p1=0, p2=0)
    np.testing.assert_array_equal(free, np.where(plain == IMPOSSIBLE_COST, IMPOSSIBLE_COST, 8 * plain))


@pytest.mark.parametrize("side", ["left_state", "right_state"])
def test_cost_volume__all_impossible(side):
    patches = reference.patch_pair(0, 3, 4, 7, 5)
    scene = reference.scene_of(patches, window=5, minimum=0, count=7)
    getattr(scene, side)[:] = NO_DATA
    assert (volume(scene) == IMPOSSIBLE_COST).all()


def test_cost_volume__empty_rows_cut_the_patch_in_two():
    # A no-data row as high as the window leaves nothing that passes: the halves equal those matched apart.
    left, right = reference.patch_pair(3, 8, 6, 9, 3)
    scene = SimpleNamespace(window=3, minimum=0, count=9, p1=8, p2=32, regularized=True)

    def part(rows):
        states = {
            "left_state": np.zeros(left.shape, np.uint8),
            "right_state": np.zeros(right.shape, np.uint8),
        }
        states["left_state"][4] = NO_DATA
        images = {"left": left[rows], "right": right[rows]}
        return volume(SimpleNamespace(**vars(scene), **images, **{n: s[rows] for n, s in states.items()}))

    whole = part(slice(None))
    np.testing.assert_array_equal(whole[:2], part(slice(0, 4)))
    assert (whole[2:5] == IMPOSSIBLE_COST).all()
    np.testing.assert_array_equal(whole[5:], part(slice(5, None)))


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


@pytest.mark.peer("onnxruntime", "mc_cnn")
@few
@given(scene=small_windows)
def test_cost_volume__penalties_without_gradients_are_constant(scene):
    scene.regularized, scene.p2 = True, 32
    tables = np.full((4, 3), scene.p1, np.uint16), np.full((4, 3), 32, np.uint16)
    gradients = gradients_of(scene, *tables, 0, 0)
    np.testing.assert_array_equal(varying_volume(scene, gradients), volume(scene))


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
        np.testing.assert_array_equal(getattr(wide.raw, name), products, name)
    inner = slice(before, before + right.state.shape[1])
    np.testing.assert_array_equal(wide.right.winner[:, inner], narrow.right.winner)
