"""Intervals from volumes of other matchers: our own volume, a slow twin, forms of volumes, what is refused."""

import numpy as np
import pytest
import reference
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from volumes import softmax, volume_of

from sat_intervals import SatIntervalsError, intervals_of, load_config, match_arrays
from sat_intervals.demo import make_scene
from sat_intervals.kernels.disparity import cross_check
from sat_intervals.products import IMPOSSIBLE_COST, INVALID, MISMATCH, NO_CANDIDATE, OCCLUSION

FIRST, LAST = -8, 20
DISPARITIES = np.arange(FIRST, LAST + 1)
PAPER = load_config({"preset": "paper", "disparity": {"minimum": FIRST, "maximum": LAST}})
# Single curves: no step that looks at neighbours.
RAW = {"cross_check": None, "median": None, "regularization": None, "ambiguity": {"normalization": "range"}}


@pytest.fixture(scope="module")
def pair():
    scene = make_scene(120, 160, seed=3)
    return tuple(np.ma.masked_equal(image.astype(np.float32), 0) for image in (scene.left, scene.right))


@pytest.fixture(scope="module")
def ours(pair):
    return match_arrays(*pair, PAPER)


@pytest.fixture(scope="module")
def volume(pair):
    return volume_of(*pair, PAPER, sgm=True)


def same(one, other):
    """Compare every byte of two datasets."""
    assert list(one) == list(other)
    for name in one:
        assert one[name].dtype == other[name].dtype
        np.testing.assert_array_equal(one[name].data, other[name].data, err_msg=name)


def test_intervals_of__equals_match_arrays_on_our_volume(ours, volume):
    found = intervals_of(volume, DISPARITIES, kind="cost", span=PAPER.cost_span, valid=ours["validity"])
    same(found, ours)
    assert 0.3 < np.isfinite(ours["disparity"].data).mean() < 1
    assert (ours["validity"].data & (OCCLUSION | MISMATCH) != 0).any()


def test_intervals_of__runs_our_sgm_on_matching_costs(ours, pair):
    costs, span, sgm = volume_of(*pair, PAPER), 24, {"p1": PAPER.sgm.p1, "p2": PAPER.sgm.p2}
    found = intervals_of(costs, DISPARITIES, kind="cost", span=span, valid=ours["validity"], config={"sgm": sgm})
    same(found, ours)
    default = intervals_of(costs, DISPARITIES, kind="cost", span=span, config={"sgm": True})
    same(default, intervals_of(costs, DISPARITIES, kind="cost", span=span, config={"sgm": {"p1": 12, "p2": 72}}))


def random_volume(seed, shape=(7, 9, 6), impossible=0.2):
    random = np.random.default_rng(seed)
    found = random.integers(0, 12, shape).astype(np.float32)
    found[random.random(shape) < impossible] = np.nan
    return found


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 40), impossible=st.sampled_from([0, 0.3, 0.9]))
def test_intervals_of__reads_curves_as_the_slow_twin(seed, count, impossible):
    # whatever candidates are impossible, as no pair of images would make them
    values = random_volume(seed, (7, 9, count), impossible)
    values[0, 0] = 1
    found = intervals_of(values, np.arange(count) - 4, kind="cost", span=11, config=RAW)
    volume = np.where(np.isnan(values), IMPOSSIBLE_COST, 10 * values).astype(np.uint16)
    config = load_config({"preset": "paper", "disparity": {"minimum": -4, "maximum": count - 5}} | RAW)
    etas = np.arange(70) / 100 * 110
    weights = (70 - np.searchsorted(np.floor(etas + 1e-9), np.arange(111))).astype(np.uint16)
    above = np.where(np.isnan(values), 0, volume - volume.min(axis=2, keepdims=True))
    disparity, _ = reference.vfit(volume.astype(int), reference.winner_takes_all(volume), -4)
    impossible = np.isnan(values).sum(axis=2)
    known = np.isfinite(disparity)
    np.testing.assert_array_equal(found["disparity"], disparity)
    ambiguous = weights[above].sum(axis=2)[known] / config.largest_ambiguity
    np.testing.assert_allclose(found["confidence"].data[known], 1 - ambiguous, atol=1e-6)
    bounds = reference.alpha_cut(volume, "0.9", 110, True)
    for name, bound in zip(("lower", "upper"), bounds, strict=True):
        np.testing.assert_array_equal(found[name].data[known], bound[known] - 4)
    np.testing.assert_array_equal(found["validity"].data & INVALID, np.where(known, 0, NO_CANDIDATE))
    np.testing.assert_array_equal(found["validity"].data & 4 != 0, known & (impossible > 0))


def as_dataset(volume):
    coords = {"row": range(volume.shape[0]), "col": range(volume.shape[1]), "disp": DISPARITIES}
    cost_volume = xr.DataArray(volume, coords, ("row", "col", "disp"))
    return xr.Dataset({"cost_volume": cost_volume}, attrs={"type_measure": "min", "cmax": 57.0})


FORMS = {
    "float64": lambda volume: (volume.astype(np.float64), DISPARITIES, "cost"),
    "masked": lambda volume: (np.ma.masked_invalid(volume), DISPARITIES, "cost"),
    "dataset of Pandora": lambda volume: (as_dataset(volume), None, None),
    "other order": lambda volume: (as_dataset(volume)["cost_volume"].transpose("disp", "col", "row"), None, "cost"),
    "similarity": lambda volume: (448 - volume, DISPARITIES, "similarity"),
    "scaled": lambda volume: (volume / 448 - 3, DISPARITIES, "cost"),
}


@pytest.mark.parametrize("form", FORMS)
def test_intervals_of__takes_volumes_in_many_forms(form, volume):
    values, disparities, kind = FORMS[form](volume)
    span = (-3.0, -2.0) if form == "scaled" else 448
    expected = intervals_of(volume, DISPARITIES, kind="cost", span=448)
    found = intervals_of(values, disparities, kind=kind, span=span)
    if form != "scaled":
        same(found, expected)
    for name in expected:  # scaled values are rounded to 1 / 50 000 of the span
        np.testing.assert_allclose(found[name], expected[name], atol=5e-3)
    assert found["lower"].dims == ("y", "x")


def test_intervals_of__does_not_depend_on_the_part_of_an_image(volume):
    config = {"cross_check": None, "median": None, "regularization": None, "ambiguity": {"p1": 0.0, "p99": 1500.0}}
    whole = intervals_of(volume, DISPARITIES, kind="cost", span=448, config=config)
    for rows in (slice(0, 50), slice(50, None)):
        for columns in (slice(0, 70), slice(70, None)):
            part = intervals_of(volume[rows, columns], DISPARITIES, kind="cost", span=448, config=config)
            same(part, whole[{"y": rows, "x": columns}])


@pytest.mark.parametrize("step", [0.5, 0.25])
def test_intervals_of__takes_fractions_of_pixels(step):
    values = random_volume(5, (20, 40, 25))
    whole = intervals_of(values, np.arange(25), kind="cost", span=11, config={"cross_check": None})
    found = intervals_of(values, 3.1 + step * np.arange(25), kind="cost", span=11, config={"cross_check": None})
    for name in ("disparity", "lower", "upper"):
        np.testing.assert_allclose(found[name], 3.1 + step * whole[name], atol=1e-5)
    checked = intervals_of(values, step * np.arange(25), kind="cost", span=11)
    every, last = round(1 / step), int(24 * step)
    costs = np.where(np.isnan(values), IMPOSSIBLE_COST, values).astype(np.int64)
    right = reference.absolute(reference.right_winners(costs[:, :, ::every])[0], 0).astype(np.int16)
    winner = np.clip(np.floor(step * costs.argmin(axis=2) + 0.5), 0, last).astype(np.int16)
    np.testing.assert_array_equal(
        checked["validity"].data & (OCCLUSION | MISMATCH), cross_check(winner, right, 0, PAPER.cross_check.tolerance)
    )


def right_volume(volume):
    """The right image's volume, along the diagonals of the left one; candidates are ``-d``, ascending."""
    rows, columns, count = volume.shape
    found = np.full((rows, columns, count), np.nan, volume.dtype)
    for k, disparity in enumerate(DISPARITIES):
        first, last = max(0, disparity), min(columns, columns + disparity)
        found[:, first:last, count - 1 - k] = volume[:, first - disparity : last - disparity, k]
    return found


def test_intervals_of__cross_checks_against_a_right_volume(volume):
    alone = intervals_of(volume, DISPARITIES, kind="cost", span=448)
    same(intervals_of(volume, DISPARITIES, kind="cost", span=448, right=right_volume(volume)), alone)
    wrong = intervals_of(volume, DISPARITIES, kind="cost", span=448, right=right_volume(volume)[::-1])
    assert np.isfinite(wrong["disparity"]).mean() < 0.7 * np.isfinite(alone["disparity"]).mean()


def test_intervals_of__cross_checks_probabilities_against_a_right_volume(volume):
    probability = softmax(np.where(np.isfinite(volume), volume, np.inf), 2)
    right = np.full((volume.shape[0], volume.shape[1], DISPARITIES.size), np.nan)
    for index, disparity in enumerate(-DISPARITIES[::-1]):  # the right pixel at column x sees the left one at x + it
        columns = np.arange(volume.shape[1])
        inside = (columns + disparity >= 0) & (columns + disparity < volume.shape[1])
        right[:, inside, index] = probability[:, columns[inside] + disparity, DISPARITIES.size - 1 - index]
    total = np.nansum(right, axis=2, keepdims=True)
    right /= np.where(total > 0, total, np.nan)
    how = {"kind": "probability", "disparities": DISPARITIES}
    found, alone = intervals_of(probability, right=right, **how), intervals_of(probability, **how)
    rejected = [(one["validity"].data & (OCCLUSION | MISMATCH)) != 0 for one in (found, alone)]
    assert 0.01 < rejected[0].mean() < 0.5
    assert (rejected[0] == rejected[1]).mean() > 0.98


@pytest.mark.parametrize("form", ["bool", "flags"])
def test_intervals_of__masked_pixels_are_as_those_without_values(volume, form):
    masked = np.zeros(volume.shape[:2], np.bool_)
    masked[30:60, 40:90] = True
    probability = softmax(np.where(np.isfinite(volume), volume, np.inf), 2)
    valid = ~masked if form == "bool" else np.where(masked, np.uint16(INVALID), np.uint16(0))
    found = intervals_of(probability, DISPARITIES, kind="probability", valid=valid)
    gaps = np.where(masked[..., np.newaxis], np.nan, probability)
    expected = intervals_of(gaps, DISPARITIES, kind="probability")
    for name in ("disparity", "lower", "upper"):
        np.testing.assert_array_equal(found[name].data, expected[name].data)


def test_intervals_of__cuts_probabilities_by_the_largest_of_a_pixel(volume):
    probabilities = softmax(volume, 60)
    found = intervals_of(probabilities, DISPARITIES, kind="probability", config=RAW)
    known = np.isfinite(found["lower"].data)
    np.testing.assert_array_equal(known, np.isfinite(volume).any(axis=2))
    inside = probabilities >= 0.9 * probabilities.max(axis=2, keepdims=True)
    lower = np.where(inside.any(axis=2), FIRST + inside.argmax(axis=2), 0)
    near = np.abs(found["lower"].data - lower)[known]
    assert near.max() <= 1  # of a winner at the bound, for V-fit
    assert (found["lower"].data == lower)[known & (lower < found["disparity"].data - 0.5)].all()


ARRAY = random_volume(1)
REFUSED = {
    "NaN": (lambda: (np.full((4, 5, 6), np.nan), range(6), {}), "no finite value"),
    "two": (lambda: (ARRAY[:, :, :2], range(2), {}), "the volume has 2 disparities, at least 3"),
    "outside": (lambda: (ARRAY, range(6), {"span": 10}), "of 378 values are outside 0 to 10"),
    "sums": (lambda: (ARRAY / 99, range(6), {"kind": "probability", "span": None}), "do not sum to 1 within 0.001"),
    "number": (lambda: (ARRAY, range(5), {}), "5 disparities are given, but the volume has 6"),
    "valid": (lambda: (ARRAY, range(6), {"valid": np.ones((4, 4), bool)}), r"valid is \(4, 4\) of bool: give \(7, 9\)"),
    "right": (lambda: (ARRAY, range(6), {"right": ARRAY[:4]}), "the right volume has 4 rows, the left one 7"),
    "uneven": (lambda: (ARRAY, [0, 1, 2, 3, 5, 6], {}), "ascending, even steps"),
    "descending": (lambda: (ARRAY, range(6, 0, -1), {}), "ascending, even steps"),
    "kind": (lambda: (ARRAY, range(6), {"kind": None}), "kind is None: give cost, similarity or probability"),
    "span": (lambda: (ARRAY, range(6), {"span": None}), "span is missing"),
    "no span": (lambda: (ARRAY, range(6), {"span": 0}), "span is 0"),
    "flat": (lambda: (ARRAY[0], range(6), {}), "give rows, columns, disparities"),
    "coverage": (lambda: (ARRAY, range(6), {"config": {"interval": {"coverage": 0.9}}}), "calibrate_volumes"),
    "diagonals": (lambda: (ARRAY, np.arange(6) * 0.3, {}), "give right, or cross_check null"),
    "sgm": (
        lambda: (softmax(ARRAY, 1), range(6), {"kind": "probability", "span": None, "config": {"sgm": True}}),
        "sgm is given with probabilities",
    ),
    "penalties": (
        lambda: (ARRAY, range(6), {"config": {"sgm": {"penalty": "mc_cnn_fast", "p1": 5, "p2": 33, "span": 90}}}),
        "sgm.penalty is mc_cnn_fast, allowed: constant with cost.method volume",
    ),
    "large p2": (
        lambda: (ARRAY, range(6), {"config": {"sgm": {"p2": 1e6}}}),
        "sgm.p2 is 1000000.0, allowed: <= 90090 with cost.method volume, so that costs summed over 8 paths fit",
    ),
    "dimensions": (lambda: (xr.DataArray(ARRAY, dims=("a", "b", "c")), None, {}), "give row, col and disp"),
    "dataset": (lambda: (xr.Dataset({"costs": 1}), None, {}), "has costs, but no cost_volume"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_intervals_of__refuses_in_one_line(name):
    make, message = REFUSED[name]
    volume, disparities, options = make()
    with pytest.raises(SatIntervalsError, match=message) as caught:
        intervals_of(volume, disparities, **({"kind": "cost", "span": 11} | options))
    assert "\n" not in str(caught.value)
