"""Alpha-cuts, the regularisation of intervals, and the whole method against their slow twins."""

from types import SimpleNamespace

import numpy as np
import pytest
import reference
from helpers import calibration, matched
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.config import load_config
from sat_intervals.kernels.cost import Codes, between
from sat_intervals.kernels.intervals import regularize
from sat_intervals.kernels.matching import match_costs
from sat_intervals.kernels.sweeps import Settings
from sat_intervals.match.costs import cost_of
from sat_intervals.match.patch import PatchFrame, match_patch, patch_areas
from sat_intervals.match.postprocess import ConfidenceScale, RawRows, confidence_scale, postprocess_rows
from sat_intervals.prepare.in_memory import match_arrays
from sat_intervals.products import BOUND_STEPS, IMPOSSIBLE_COST, INVALID, NO_BOUND, NO_DATA, NO_DISPARITY, REJECTED
from sat_intervals.tiling import View, Window

bounded = settings(max_examples=25, derandomize=True, deadline=None)
few = settings(max_examples=20, derandomize=True, deadline=None)
some = settings(max_examples=25, derandomize=True, deadline=None)
COUNTS = (1, 31, 32, 33, 64, 70)
ALPHAS = ("0.9", "0.5", "0.98", "1", "0.01", "0.005")
N = NO_DISPARITY
X = IMPOSSIBLE_COST


def of_curves(curves, minimum, **options):
    """Raw products of one pixel a row with given cost curves of census 5 without SGM; X = impossible."""
    curves = np.array(curves)
    rows, count = curves.shape
    words = (1 << np.where(curves == X, 0, curves).astype(np.uint64)) - 1
    left = Codes(np.zeros((1, rows, 1), np.uint32), np.zeros((rows, 1), np.uint8))
    right = Codes(words.astype(np.uint32)[np.newaxis], np.where(curves == X, NO_DATA, 0).astype(np.uint8))
    scene = SimpleNamespace(window=5, minimum=minimum, count=count, p1=8, p2=32, regularized=False)
    return match_costs(
        between(left, right), Settings(**reference.settings_of(scene, **options)), Window(0, 0, rows, 1)
    )[0]


# ---- Alpha-cut ---------------------------------------------------------------------------------------------
CURVES = [[9, 3, 5, 9], [4, 4, 4, 7], [X, 2, 6, 4]]  # three pixels, four disparities from -2


def test_match_costs__interval_worked_example():
    # Census 5 without SGM: span 24; alpha .9: costs up to floor(2.4) = 2 above the least.
    #     9 3 5 9     cut -1 0; at -1 stands the least, so it is pushed out: -2 0
    #     4 4 4 7     cut -2 0; both ends have the least: -3 is beyond the range, so -2 1
    #     . 2 6 4     cut -1 1, whatever is between; -1 is pushed out, to the impossible -2: -2 1
    raw = of_curves(CURVES, -2)
    assert raw.lower.tolist() == raw.lower_low.tolist() == [[0], [0], [0]]  # counted from -2
    assert raw.upper.tolist() == raw.upper_low.tolist() == [[2], [3], [3]]
    assert {bound.dtype for bound in (raw.lower, raw.upper, raw.lower_low, raw.upper_low)} == {np.dtype(np.uint16)}
    lower, upper = reference.alpha_cut(np.array(CURVES)[:, np.newaxis], "0.9", 24, True)
    assert lower.tolist() == [[0], [0], [0]]
    assert upper.tolist() == [[2], [3], [3]]


def check_against_reference(scene, alpha, refine):
    raw = matched(scene, alpha=alpha, refine=refine)[0]
    bounds = reference.alpha_cut(reference.volume_of(scene), alpha, reference.span_of(scene), refine)
    for bound, expected in zip((raw.lower, raw.upper), bounds, strict=True):
        np.testing.assert_array_equal(bound, np.where(expected == reference.NONE, NO_BOUND, expected))


@pytest.mark.parametrize("count", COUNTS)
@few
@given(data=st.data())
def test_match_costs__interval_equals_reference_at_every_count(count, data):
    scene = data.draw(reference.scenes(counts=(count,), rows=3, columns=6))
    check_against_reference(scene, data.draw(st.sampled_from(ALPHAS)), True)


# ---- Sub-pixel cuts ----------------------------------------------------------------------------------------
def test_match_costs__subpixel_cut_worked_example():
    # Level 2.5, steps of 1/64 above the first disparity.
    #     9 3 5 9    limit 5.5: down from 1 by 2.5 / 6, up from 2 by 0.5 / 4: 64 - ceil(26.67) = 37, 128 + 8
    #     4 4 4 7    limit 6.5: from the end of the range; up from 2 by 2.5 / 3: 128 + ceil(53.33) = 182
    #     . 2 6 4    limit 4.5: beside the impossible candidate, and at the end of the range: 64, 192
    raw = of_curves(CURVES, -2, refine=False, cuts=(2.5, 0.0), steps=64)
    assert raw.lower.tolist() == [[37], [0], [64]]
    assert raw.upper.tolist() == [[136], [182], [192]]
    # Level 0 is the winner, ties included; with refinement the V-fit (1 + 1 / 3, 0.5, unrefined) is inside.
    assert raw.lower_low.tolist() == [[64], [0], [64]]
    assert raw.upper_low.tolist() == [[64], [128], [64]]
    refined = of_curves(CURVES, -2, cuts=(2.5, 0.0), steps=64)
    assert refined.upper_low.tolist() == [[86], [128], [64]]


LEVELS = st.integers(0, 1200).map(lambda quarters: reference.Fraction(quarters, 4))


@pytest.mark.parametrize("refine", [True, False])
@bounded
@given(scene=reference.scenes(), levels=st.tuples(LEVELS, LEVELS), steps=st.sampled_from([64, 4]))
def test_match_costs__subpixel_cuts_equal_reference(refine, scene, levels, steps):
    raw = matched(scene, refine=refine, cuts=levels, steps=steps)[0]
    found = raw.winner != N
    for level, bounds in zip(levels, ((raw.lower, raw.upper), (raw.lower_low, raw.upper_low)), strict=True):
        expected = reference.subpixel_cut(reference.volume_of(scene), level, steps, refine)
        for bound, of_reference in zip(bounds, expected, strict=True):
            np.testing.assert_array_equal(bound[found], of_reference[found])


@few
@given(scene=reference.scenes(), levels=st.tuples(LEVELS, LEVELS))
def test_match_costs__a_higher_level_never_narrows_and_the_disparity_is_inside(scene, levels):
    low, high = sorted(levels)
    raw = matched(scene, cuts=(high, low), steps=64)[0]
    found = raw.winner != N
    for narrow, wide in ((raw.lower_low, raw.lower), (raw.upper, raw.upper_low)):
        assert (wide[found] <= narrow[found]).all()
    disparity = (raw.disparity[found] - scene.minimum) * np.float64(64)
    assert (raw.lower_low[found] <= disparity + 1e-3).all()  # the disparity is rounded to float32
    assert (raw.upper_low[found] >= disparity - 1e-3).all()
    assert (raw.upper[found] <= 64 * (scene.count - 1)).all()


# ---- Regularisation ----------------------------------------------------------------------------------------
def test_regularize__worked_example():
    # Low pixels (x) make five segments a to e, depth 1, quantile .9.
    #     x x . x      a a . b      lower  0 1 9 2    upper  2 3 9 4
    #     . x . x      . c . d             9 5 9 3           9 13 9 6
    #     . . . x      . . . e             9 9 9 7           9 9 9 8
    # A(a) = A(c) = {a, c}: lower 0 1 5, the 10 % quantile lies at .2: 0.2; upper 2 3 13 at 1.8: 11.
    # A(b) = {b, d}: 2 3 at .1: 2.1; 4 6 at .9: 5.8. A(d) = {b, d, e}: 2 3 7 at .2: 2.2; 4 6 8 at 1.8: 7.6.
    # A(e) = {d, e}: 3 7 at .1: 3.4; 6 8 at .9: 7.8.
    low = np.array([[1, 1, 0, 1], [0, 1, 0, 1], [0, 0, 0, 1]], bool)
    lower = np.array([[0, 1, 9, 2], [9, 5, 9, 3], [9, 9, 9, 7]], np.float32)
    upper = np.array([[2, 3, 9, 4], [9, 13, 9, 6], [9, 9, 9, 8]], np.float32)
    new_lower = np.array([[0.2, 0.2, 9, 2.1], [9, 0.2, 9, 2.2], [9, 9, 9, 3.4]], np.float32)
    new_upper = np.array([[11, 11, 9, 5.8], [9, 11, 9, 7.6], [9, 9, 9, 7.8]], np.float32)
    for result in (
        regularize(lower, upper, low, 0, 1, 0.9, (0, 3), 2),
        reference.regularize(lower, upper, low, 1, 0.9),
    ):
        np.testing.assert_allclose(result[0], new_lower, rtol=1e-6)
        np.testing.assert_allclose(result[1], new_upper, rtol=1e-6)
        assert result[0].dtype == result[1].dtype == np.float32


def test_regularize__long_segments():
    # Across the whole width of a wide image, comb-like: every second pixel low in the row above.
    columns = 5001
    low = np.zeros((3, columns), bool)
    low[1] = True
    low[0, ::2] = True
    lower = np.arange(3 * columns, dtype=np.float32).reshape(3, columns)
    new_lower, new_upper = regularize(lower, lower, low, 0, 2, 0.9, (0, 3), 2)
    area = lower[low].astype(np.float64)
    assert new_lower[low].tolist() == pytest.approx([np.quantile(area, 0.1)] * low.sum())
    assert new_upper[low].tolist() == pytest.approx([np.quantile(area, 0.9)] * low.sum())
    np.testing.assert_array_equal(new_lower[~low], lower[~low])


@st.composite
def strips(draw, rows=7, columns=12):
    """Bounds and low pixels of a strip, sparse to dense, with no interval (NaN) at some that are not low."""
    shape = draw(st.integers(1, rows)), draw(st.integers(1, columns))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    low = random.random(shape) < draw(st.sampled_from([0.3, 0.5, 0.8, 0.95]))
    lower = draw(reference.halves(shape))
    upper = lower + draw(reference.halves(shape, 0, 12))
    empty = ~low & (random.random(shape) < 0.3)
    return np.where(empty, np.nan, lower), np.where(empty, np.nan, upper), low


quantiles = st.sampled_from([0.5, 0.75, 0.8, 0.9, 0.97, 1.0])
# The least that `reference.halves` draws.
MINIMUM = -8


@bounded
@given(strip=strips(), depth=st.integers(0, 4), quantile=quantiles)
def test_regularize__equals_reference(strip, depth, quantile):
    lower, upper, low = strip
    rows = len(low)
    result = regularize(lower, upper, low, MINIMUM, depth, quantile, (0, rows), 2)
    expected = reference.regularize(lower, upper, low, depth, quantile)
    np.testing.assert_allclose(result, expected, rtol=1e-6, atol=1e-6)
    assert result[0].dtype == result[1].dtype == np.float32


@bounded
@given(strip=strips(), depth=st.integers(0, 3), quantile=quantiles, data=st.data())
def test_regularize__a_halo_of_depth_rows_is_enough(strip, depth, quantile, data):
    lower, upper, low = strip
    first = data.draw(st.integers(0, len(low) - 1))
    last = data.draw(st.integers(first + 1, len(low)))
    whole = regularize(lower, upper, low, MINIMUM, depth, quantile, (0, len(low)), 2)
    start, stop = max(0, first - depth), min(len(low), last + depth)
    halo = np.s_[start:stop]
    part = regularize(lower[halo], upper[halo], low[halo], MINIMUM, depth, quantile, (first - start, last - start), 2)
    np.testing.assert_array_equal(part[0], whole[0][first:last])
    np.testing.assert_array_equal(part[1], whole[1][first:last])


# ---- The whole method --------------------------------------------------------------------------------------
@st.composite
def configs(draw):
    """Settings of all steps, each on in most cases."""

    def on(section):
        return section if draw(st.sampled_from([True, True, True, True, False])) else None

    minimum = draw(st.sampled_from([-9, -3, 0, 4]))
    ambiguity, interval = on({}), on({"alpha": draw(st.sampled_from([0.9, 0.5, 0.98]))})
    if ambiguity is not None:
        scale = draw(st.sampled_from([{}, {}, {"normalization": "range"}, {"p1": 75.0, "p99": 250.5}]))
        ambiguity |= scale | draw(st.sampled_from([{}, {"eta_max": 0.3, "eta_step": 0.07}]))
    regularization = {
        "threshold": draw(st.sampled_from([0.6, 0.3, 0.9])),
        "kernel": draw(st.sampled_from([1, 5])),
        "depth": draw(st.integers(0, 3)),
        "quantile": draw(st.sampled_from([0.9, 0.75])),
    }
    cross_check = {
        "method": draw(st.sampled_from(["fast", "accurate"])),
        "tolerance": draw(st.integers(0, 2)),
    }
    config = load_config(
        {
            "preset": "paper",
            "disparity": {"minimum": minimum, "maximum": minimum + draw(st.integers(0, 9))},
            "cost": {"window": draw(st.sampled_from([3, 5]))},
            "sgm": on({"p1": 4, "p2": draw(st.integers(4, 40))}),
            "ambiguity": ambiguity,
            "interval": interval,
            "refinement": on({}),
            "cross_check": on(cross_check),
            "median": on({"size": draw(st.sampled_from([3, 5]))}),
            "regularization": None if ambiguity is None or interval is None else on(regularization),
            "products": {"keep_rejected": draw(st.booleans())},
        }
    )
    if config.regularization is None or draw(st.booleans()):
        return config
    levels = draw(st.integers(0, 99)) / 4, draw(st.integers(0, 199)) / 4
    own = calibration(config, *levels, draw(st.sampled_from([0.9, 0.6, None])))
    return load_config(config, {"interval": {"coverage": 0.9, "calibration": own}})


def image_pair(seed, disparity, holes=0):
    """Two images of different widths, the left ground moved by two disparities in the right one; states."""
    random = np.random.default_rng(seed)
    rows, columns = random.integers(9, 13), random.integers(12, 20)
    ground = random.integers(0, 30, (rows, 80)).astype(np.float32)
    left, right = (
        ground[:, 30 : 30 + columns].copy(),
        ground[:, 30 : 30 + columns + random.integers(-3, 4)].copy(),
    )
    for r in range(rows):
        if r % 5 == 0:
            d = random.integers(disparity.minimum, disparity.maximum + 1)
        right[r] = ground[r, 30 - d : 30 - d + right.shape[1]]
    right += random.integers(0, 3, right.shape)
    states = [np.zeros(image.shape, np.uint8) for image in (left, right)]
    for state in states:
        for _ in range(holes):
            state[random.integers(state.shape[0]), random.integers(state.shape[1])] = random.integers(1, 4)
    return left, right, *states


def view(image, state, window):
    """An image in a window that may go beyond it."""
    margin = 200
    there = window.relative_to(Window(-margin, -margin, 0, 0)).slices
    image, state = np.pad(image, margin)[there], np.pad(state, margin, constant_values=NO_DATA)[there]
    return View(window, image.copy(), state.copy())  # contiguous, as those that are read


def check(bands, validity, expected, config):
    """Compare the bands disparity, lower, upper, confidence, and validity, with the reference's.

    A quantile close to a multiple of 1/64 px may be rounded outwards to the next one.
    """
    step = 1e-6 if config.bound_steps == 1 else 1 / BOUND_STEPS
    disparity, lower, upper, confidence = bands
    np.testing.assert_array_equal(validity, expected.validity)
    np.testing.assert_array_equal(disparity, expected.disparity)
    np.testing.assert_allclose(lower, expected.lower, rtol=1e-6, atol=step)
    np.testing.assert_allclose(upper, expected.upper, rtol=1e-6, atol=step)
    np.testing.assert_allclose(confidence, expected.confidence, rtol=1e-6, atol=1e-6)


@some
@given(seed=st.integers(0, 2**32 - 1), config=configs(), holes=st.integers(0, 3))
def test_postprocess_rows__of_a_patch_equals_reference(seed, config, holes):
    left, right, left_state, right_state = image_pair(seed, config.disparity, holes)
    frame = PatchFrame.of_whole(Window(0, 0, *left.shape))
    cost, areas = cost_of(config), patch_areas(frame, config)
    windows = cost.windows(areas)
    views = view(left, left_state, windows[0]), view(right, right_state, windows[1])
    patch = match_patch(frame, cost.of_areas(views, areas), config)
    raw, rows = patch.raw, RawRows.of(patch.raw, patch.right)
    scale = ConfidenceScale(np.nan, np.nan)
    if config.ambiguity is not None:
        histogram = np.bincount(raw.ambiguity[raw.winner != N], minlength=config.largest_ambiguity + 1)
        scale = confidence_scale(config.ambiguity, histogram)
    final = postprocess_rows(rows, 0, len(left), scale, config)
    expected = reference.match_arrays(left, right, left_state, right_state, config)
    check(final[:4], final.validity, expected, config)


@settings(max_examples=30, derandomize=True, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), config=configs(), holes=st.integers(0, 3), flat=st.sampled_from(["", "r", "lr", ""])
)
def test_match_arrays__equals_reference(seed, config, holes, flat):
    left, right, left_state, right_state = image_pair(seed, config.disparity, holes)
    for image in {"": (), "r": (right,), "lr": (left, right)}[flat]:
        image[:, seed % 14 :] = 7  # there texture ends
    left[left_state != 0] = np.nan
    right[right_state != 0] = np.inf
    found = match_arrays(left, right, config)
    expected = reference.match_arrays(left, right, left_state * 0, right_state * 0, config)
    bands = [found[name].values for name in ("disparity", "lower", "upper", "confidence")]
    check(bands, found["validity"].values, expected, config)
    hidden = INVALID & ~REJECTED if config.products.keep_rejected else INVALID
    shown = (found["validity"].values & hidden) == 0
    disparity, lower, upper, _ = bands
    np.testing.assert_array_equal(np.isfinite(disparity), shown)
    np.testing.assert_array_equal(np.isfinite(lower), shown & (config.interval is not None))
    if config.interval is not None:
        assert (lower[shown] <= disparity[shown]).all()
        assert (disparity[shown] <= upper[shown]).all()


@pytest.mark.parametrize("more", [{}, {"sgm": None}, {"cross_check": {"method": "accurate"}}])
@pytest.mark.parametrize(("minimum", "maximum"), [(0, 60), (-30, 30), (-60, 0)])
def test_match_arrays__of_images_without_texture_is_certain_of_nothing(minimum, maximum, more):
    flat = np.full((40, 200), 65535, np.uint16)
    found = match_arrays(flat, flat, {"preset": "paper", "disparity": {"minimum": minimum, "maximum": maximum}} | more)
    valid = found["validity"].values & INVALID == 0
    assert valid.any()
    assert (found["lower"].values[valid] == minimum).all()
    assert (found["upper"].values[valid] == maximum).all()
    assert (found["confidence"].values[valid] == 0).all()


def test_match_arrays__of_nothing_is_nothing():
    empty = np.full((6, 9), np.nan, np.float32)
    config = load_config({"preset": "paper", "disparity": {"minimum": -2, "maximum": 1}})
    found = match_arrays(empty, empty, config)
    state = np.zeros(empty.shape, np.uint8)
    expected = reference.match_arrays(empty, empty, state, state, config)
    assert np.isnan(expected.confidence).all()
    bands = [found[name].values for name in ("disparity", "lower", "upper", "confidence")]
    check(bands, found["validity"].values, expected, config)
