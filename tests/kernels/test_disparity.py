"""Winners, refinement, the right view, cross-checking, medians and validity against their slow twins."""

from types import SimpleNamespace

import numpy as np
import pytest
import reference
from helpers import matched
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sat_intervals.kernels.cost import Codes, between
from sat_intervals.kernels.disparity import cross_check, median
from sat_intervals.kernels.matching import match_costs
from sat_intervals.kernels.sweeps import Settings
from sat_intervals.products import (
    IMPOSSIBLE_COST,
    LEFT_WINDOW,
    MASKED,
    MISMATCH,
    NO_CANDIDATE,
    NO_DATA,
    NO_DISPARITY,
    NOT_REFINED,
    OCCLUSION,
    RANGE_INCOMPLETE,
    RIGHT_MASKED,
)
from sat_intervals.tiling import Window

bounded = settings(max_examples=30, derandomize=True, deadline=None)
few = settings(max_examples=20, derandomize=True, deadline=None)
COUNTS = (1, 31, 32, 33, 64, 70)
N = NO_DISPARITY
X = IMPOSSIBLE_COST


def bare(left_levels, right_levels, minimum=0, **options):
    """Match pixels without regularisation; costs are the differences of levels, X is a hole."""
    codes = []
    for levels in (left_levels, right_levels):
        levels = np.array(levels)
        hole = levels == X
        words = (1 << np.where(hole, 0, levels).astype(np.uint64)) - 1
        codes.append(Codes(words.astype(np.uint32)[np.newaxis], (hole * NO_DATA).astype(np.uint8)))
    count = codes[1].state.shape[1] - codes[0].state.shape[1] + 1
    scene = SimpleNamespace(window=5, minimum=minimum, count=count, p1=8, p2=32, regularized=False)
    parameters = Settings(**reference.settings_of(scene, **options))
    return match_costs(between(*codes), parameters, Window(0, 0, *codes[0].state.shape))[:2]


# ---- Winner and refinement ---------------------------------------------------------------------------------
CURVES = np.array([[9, 3, 5, 9], [4, 4, 4, 7], [X, 2, 6, 4]])  # three pixels, four disparities from -2


def test_match_costs__winner_and_refinement_worked_example():
    # 9 3 5 9: least at k = 1, d = -1; shift (9 - 5) / (2 (9 - 3)) = 1/3.
    # 4 4 4 7: the smallest of the ties, k = 0, d = -2, at the range's end: not refined.
    # . 2 6 4: k = 1, d = -1, beside an impossible candidate: not refined, and the range is incomplete.
    raw, _ = bare(np.zeros((3, 1), int), CURVES, minimum=-2)
    assert raw.winner.tolist() == [[-1], [-2], [-1]]
    assert raw.cost.tolist() == [[3], [4], [2]]
    assert raw.disparity.tolist() == [[np.float32(-1 + 1 / 3)], [-2], [-1]]
    assert raw.validity.tolist() == [[0], [NOT_REFINED], [NOT_REFINED | RANGE_INCOMPLETE]]
    volume = CURVES[:, np.newaxis]
    winner = reference.winner_takes_all(volume)
    disparity, refined = reference.vfit(volume, winner, -2)
    assert winner.tolist() == [[1], [0], [1]]
    np.testing.assert_array_equal(disparity, raw.disparity)
    assert refined.tolist() == [[True], [False], [False]]


def check_against_reference(scene, refine):
    raw, right_view = matched(scene, refine=refine)
    volume = reference.volume_of(scene)
    winner = reference.winner_takes_all(volume)
    disparity, refined = reference.vfit(volume, winner, scene.minimum)
    seen, costs = reference.right_winners(volume)
    left, right = (reference.window_state(state, scene.window) for state in (scene.left_state, scene.right_state))
    absolute = reference.absolute(winner, scene.minimum)
    np.testing.assert_array_equal(raw.winner, absolute)
    np.testing.assert_array_equal(raw.disparity, disparity if refine else np.where(winner < 0, np.nan, absolute))
    np.testing.assert_array_equal(raw.cost, volume.min(axis=2))
    np.testing.assert_array_equal(right_view.winner, reference.absolute(seen, scene.minimum))
    np.testing.assert_array_equal(right_view.cost, costs)
    # The pixels' own states are the caller's: left_masked is not set here.
    expected = reference.validity(np.zeros_like(left), left, right, refined & refine)
    np.testing.assert_array_equal(raw.validity, expected)
    assert [array.dtype for array in (raw.winner, raw.disparity, raw.cost)] == [np.int16, np.float32, np.uint16]


@pytest.mark.parametrize("refine", [True, False])
@bounded
@given(scene=reference.scenes())
def test_match_costs__equals_reference(refine, scene):
    check_against_reference(scene, refine)


@pytest.mark.parametrize("count", COUNTS)
@few
@given(data=st.data(), refine=st.booleans())
def test_match_costs__equals_reference_at_every_count(count, data, refine):
    check_against_reference(data.draw(reference.scenes(counts=(count,), rows=3, columns=9)), refine)


@bounded
@given(scene=reference.scenes(), data=st.data())
def test_match_costs__any_part_equals_the_whole(scene, data):
    # Only what is wanted differs, never a value; the right view is made of the core's pixels alone.
    raw, _ = matched(scene)
    rows, columns = raw.winner.shape
    output, core = Window(0, 0, rows, columns), None
    for _ in range(2):
        row = data.draw(st.integers(output.row, output.row_stop - 1))
        column = data.draw(st.integers(output.column, output.column_stop - 1))
        height = data.draw(st.integers(1, output.row_stop - row))
        width = data.draw(st.integers(1, output.column_stop - column))
        output, core = core or Window(row, column, height, width), Window(row, column, height, width)
    part, right_view = matched(scene, output, core)
    for name in raw._fields:
        np.testing.assert_array_equal(getattr(part, name), getattr(raw, name)[output.slices], name)
    seen, costs = reference.right_winners(reference.volume_of(scene)[core.slices])
    np.testing.assert_array_equal(right_view.winner, reference.absolute(seen, scene.minimum))
    np.testing.assert_array_equal(right_view.cost, costs)


# ---- The right view ----------------------------------------------------------------------------------------
def test_match_costs__right_view_worked_example():
    # Left levels 2 4 9, right levels 2 3 8 9, disparities -1 and 0. Costs S(c, k) = |left[c] - right[c + k]|:
    #     c = 0: 0 1     c = 1: 1 4     c = 2: 1 0
    # Right column 1 sees c = 1 at k = 0 and c = 0 at k = 1, both at cost 1: the largest d, 0.
    # Right column 2 sees c = 2 at cost 1 (d = -1) and c = 1 at cost 4 (d = 0).
    raw, right_view = bare([[2, 4, 9]], [[2, 3, 8, 9]], minimum=-1)
    assert raw.winner.tolist() == [[-1, -1, 0]]
    assert right_view.winner.tolist() == [[-1, 0, -1, 0]]
    assert right_view.cost.tolist() == [[0, 1, 1, 0]]
    volume = np.array([[[0, 1], [1, 4], [1, 0]]])
    seen, costs = reference.right_winners(volume)
    assert seen.tolist() == [[0, 1, 0, 1]]
    assert costs.tolist() == [[0, 1, 1, 0]]


# ---- Validity ----------------------------------------------------------------------------------------------
def test_match_costs__validity_worked_example():
    # Three rows of four pixels, disparities 0 and 1. Right states (0 usable, 1 no data, 2 masked):
    #     0 0 1 1 0     each pixel faces two:    0 0   0 1   1 1   1 0
    #     2 1 2 0 0                              2 1   1 2   2 0   0 0
    #     0 0 0 0 0                              0 0   0 0   0 0   0 0
    # and the left windows of row 2 are usable, no data, masked, both.
    left = Codes(np.zeros((1, 3, 4), np.uint32), np.zeros((3, 4), np.uint8))
    left.state[2] = [0, NO_DATA, MASKED, NO_DATA | MASKED]
    state = np.array([[0, 0, 1, 1, 0], [2, 1, 2, 0, 0], [0, 0, 0, 0, 0]], np.uint8)
    right = Codes(np.zeros((1, 3, 5), np.uint32), state)
    scene = SimpleNamespace(window=3, minimum=0, count=2, p1=1, p2=2, regularized=True)
    raw, *_ = match_costs(between(left, right), Settings(**reference.settings_of(scene)), Window(0, 0, 3, 4))
    part = RANGE_INCOMPLETE | NOT_REFINED
    expected = [
        [NOT_REFINED, part, NO_CANDIDATE, part],
        [RIGHT_MASKED, RIGHT_MASKED, part, NOT_REFINED],
        [NOT_REFINED, LEFT_WINDOW, LEFT_WINDOW, LEFT_WINDOW],
    ]
    assert raw.validity.tolist() == expected
    refined = np.zeros((3, 4), bool)
    usable = np.zeros((3, 4), np.uint8)
    assert reference.validity(usable, left.state, state, refined).tolist() == expected


# ---- Cross-checking ----------------------------------------------------------------------------------------
def test_cross_check__worked_example():
    # Disparities -1, 0, 1: pixel c faces right columns c, c + 1, c + 2.
    #     winner    -1  0  1  .        right   -1  .  -1  0  -1  1
    # c = 0 points to column 0, which says -1: kept. c = 1 points to column 2, -1, within 1: kept. c = 2 to
    # column 4, -1, two away: rejected; column 2 says -1 at index 0, it points back: mismatch. c = 3 has none.
    #     winner     1  1  0 -1        right    0  0  -1  .  -1  1
    # c = 0: column 2 says -1; column 1 says 0 at index 1: mismatch. c = 1: column 3 has none; columns 1 to 3
    # say 0 -1 . where -1 0 1 would point back: occlusion. c = 2: column 2 says -1 at index 0: mismatch.
    # c = 3: column 5 says 1 at index 2: mismatch.
    winner = np.array([[-1, 0, 1, N], [1, 1, 0, -1]], np.int16)
    right = np.array([[-1, N, -1, 0, -1, 1], [0, 0, -1, N, -1, 1]], np.int16)
    expected = [[0, 0, MISMATCH, 0], [MISMATCH, OCCLUSION, MISMATCH, MISMATCH]]
    checked = cross_check(winner, right, -1, 1)
    assert checked.dtype == np.uint16
    assert checked.tolist() == expected
    assert reference.cross_check(winner, right, -1, 1).tolist() == expected


@st.composite
def winners(draw):
    """Winners of both views over a common range, some missing."""
    minimum, count = draw(st.integers(-40, 10)), draw(st.sampled_from([1, 2, 3, 8, 33]))
    rows, columns = draw(st.integers(1, 4)), draw(st.integers(1, 8))
    disparity = st.integers(minimum, minimum + count - 1) | st.just(N)
    left = draw(hnp.arrays(np.int16, (rows, columns), elements=disparity, fill=disparity))
    right = draw(hnp.arrays(np.int16, (rows, columns + count - 1), elements=disparity, fill=disparity))
    return left, right, minimum


@bounded
@given(views=winners(), tolerance=st.integers(0, 3))
def test_cross_check__equals_reference(views, tolerance):
    expected = reference.cross_check(*views, tolerance)
    np.testing.assert_array_equal(cross_check(*views, tolerance), expected)


def test_cross_check__far_disparities_do_not_overflow():
    # The ends of the largest range, 32000 apart, and a right pixel without a winner: neither confirms.
    count = 32001
    right = np.full((1, count + 1), NO_DISPARITY, np.int16)
    winner = np.array([[16000, 16000]], np.int16)
    right[0, count - 1] = -16000
    expected = [[OCCLUSION, OCCLUSION]]
    assert cross_check(winner, right, -16000, 1).tolist() == expected
    assert reference.cross_check(winner, right, -16000, 1).tolist() == expected


# ---- Median ------------------------------------------------------------------------------------------------
def test_median__worked_example():
    # The 9 is rejected: it keeps its value and nobody uses it. (0, 0) is the median of 1 2 5; (0, 3) of
    # 3 4 7 8: 5.5; (1, 2) of 1 2 2 3 4 6 7 8: 3.5.
    #     1 2 3 4       2   3   4   5.5
    #     5 9 7 8       2   9   3.5 3.5
    #     0 6 2 1       5   5   6   4.5
    values = np.array([[1, 2, 3, 4], [5, 9, 7, 8], [0, 6, 2, 1]], np.float32)
    kept = values != 9
    expected = [[2, 3, 4, 5.5], [2, 9, 3.5, 3.5], [5, 5, 6, 4.5]]
    filtered = median(values, kept, 3)
    assert filtered.dtype == np.float32
    assert filtered.tolist() == expected
    assert reference.median(values, kept, 3).tolist() == expected


@st.composite
def bands(draw):
    """An image, which pixels are kept, from few to all, and a window's size."""
    shape = draw(st.integers(1, 8)), draw(st.integers(1, 9) | st.integers(30, 70))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kept = random.random(shape) < draw(st.sampled_from([0.3, 0.7, 0.97, 1]))
    # Few different values, or hardly two that are equal.
    few_values = draw(st.booleans())
    values = random.integers(-9, 9, shape) / 2 if few_values else random.normal(0, 9, shape)
    return values.astype(np.float32), kept, draw(st.sampled_from([3, 3, 5, 7]))


@bounded
@given(band=bands())
def test_median__equals_reference(band):
    values, kept, size = band
    values[~kept & (values < 0)] = np.nan
    np.testing.assert_array_equal(median(values, kept, size), reference.median(values, kept, size))
