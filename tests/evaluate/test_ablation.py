"""Products of a whole volume against the slow twins; the ablation against runs, the paper and Pandora."""

import json

import numpy as np
import pytest
import rasterio
import reference
import reference_evaluation
from helpers import invoke, write_pair
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals import match_arrays
from sat_intervals.config import load_config
from sat_intervals.config.pairs import Pair, find_pairs
from sat_intervals.demo import make_scene
from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate import ablation
from sat_intervals.evaluate.ablation import ablate_pair
from sat_intervals.evaluate.disparity import criteria_of, evaluate
from sat_intervals.evaluate.paper import METHODS, SceneMetrics, table_2
from sat_intervals.kernels.curves import read_alpha_cuts, read_baseline, read_right_winners, read_winners
from sat_intervals.match import memory
from sat_intervals.match.memory import PROCESS_BYTES, volume_bytes
from sat_intervals.products import IMPOSSIBLE_COST, NO_DISPARITY, Bands

some = settings(max_examples=40, derandomize=True, deadline=None)
X = IMPOSSIBLE_COST
SPAN = 448


@st.composite
def volumes(draw):
    """Aggregated costs with ties, holes and pixels without any candidate."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = tuple(int(random.integers(1, most)) for most in (5, 7, 9))
    volume = random.integers(0, draw(st.sampled_from([3, 60, SPAN + 1])), shape).astype(np.uint16)
    volume[random.random(shape) < draw(st.sampled_from([0, 0.3]))] = X
    volume[random.random(shape[:2]) < draw(st.sampled_from([0, 0.2]))] = X
    return volume


def from_indices(index, minimum):
    return np.where(index < 0, NO_DISPARITY, index + minimum)


# ---- One volume --------------------------------------------------------------------------------------------
@some
@given(volumes(), st.sampled_from([0, -7]), st.booleans())
def test_read_winners__equals_the_slow_twin(volume, minimum, refine):
    weights = load_config({"preset": "paper", "disparity": {"minimum": 0, "maximum": 1}}).ambiguity_weights
    winner, disparity, ambiguity = read_winners(volume, minimum, weights, refine)
    expected = reference.winner_takes_all(volume.astype(np.int64))
    np.testing.assert_array_equal(winner, from_indices(expected, minimum))
    refined, _ = reference.vfit(volume.astype(np.int64), expected, minimum)
    whole = np.where(expected < 0, np.nan, expected + minimum).astype(np.float32)
    np.testing.assert_array_equal(disparity, refined if refine else whole)
    np.testing.assert_array_equal(ambiguity, reference.ambiguity(volume.astype(np.int64), "0.7", "0.01", SPAN))


@some
@given(volumes(), st.sampled_from([0, -7]))
def test_read_right_winners__equals_the_slow_twin(volume, minimum):
    index, _ = reference.right_winners(volume.astype(np.int64))
    expected = reference.absolute(index, minimum)
    np.testing.assert_array_equal(read_right_winners(volume, minimum), expected)


@some
@given(volumes(), st.sampled_from(["0.5", "0.8", "0.9", "0.98", "1"]), st.booleans())
def test_read_alpha_cuts__equals_the_slow_twin(volume, alpha, refine):
    found = read_alpha_cuts(volume, -3, reference.cut_level(alpha, SPAN), refine)
    expected = reference.alpha_cut(volume.astype(np.int64), alpha, SPAN, refine)
    for bound, index in zip(found, expected, strict=True):
        np.testing.assert_array_equal(bound, from_indices(index, -3))


@some
@given(volumes())
def test_read_baseline__equals_the_slow_twin(volume):
    for bound, index in zip(read_baseline(volume, -3, 1, 10), reference_evaluation.baseline(volume, X), strict=True):
        np.testing.assert_array_equal(bound, from_indices(index, -3))


def test_read_baseline__worked_example():
    # similarity (highest - cost) / (highest - lowest), of possible candidates only, at least .9:
    #     10 30 11 12    1 0 .95 .9       all but the second: disparities -2 to 1
    #     10 30  X 13    1 0 .  .85       only the first
    #      5  5  5  X    0 / 0 by nothing: all that are possible
    #      X  X  X  X    none
    volume = np.array([[[10, 30, 11, 12]], [[10, 30, X, 13]], [[5, 5, 5, X]], [[X, X, X, X]]], np.uint16)
    lower, upper = read_baseline(volume, -2, 1, 10)
    np.testing.assert_array_equal(lower.ravel(), [-2, -2, -2, NO_DISPARITY])
    np.testing.assert_array_equal(upper.ravel(), [1, -2, 0, NO_DISPARITY])


# ---- A pair ------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def scene():
    return make_scene(90, 110, seed=5)


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    """The scene as a folder of a pair."""
    folder = tmp_path_factory.mktemp("pair")
    write_pair(folder, scene)
    return folder


def judged(scene, config):
    """Figures of merit of `match_arrays` on the scene."""
    left, right = (np.ma.masked_equal(image, 0) for image in (scene.left, scene.right))
    bands = match_arrays(left, right, config)
    names = ("disparity", "lower", "upper", "confidence", "validity")
    rows = Bands(*(bands[name].values for name in names), scene.truth.astype(np.float64))
    return evaluate(lambda: [rows], criteria_of(config))["all"]


@pytest.mark.parametrize("method", ["fast", "accurate"])
def test_ablate_pair__equals_runs_with_those_settings(scene, folder, method, monkeypatch):
    monkeypatch.setattr(ablation, "_STRIP_PIXELS", 7 * 110)
    (pair,) = find_pairs([folder])
    search = {"minimum": scene.minimum, "maximum": scene.maximum}
    config = load_config({"preset": "paper", "disparity": search, "cross_check": {"method": method}})
    report = ablate_pair(pair, config)
    assert list(report) == ["cost", *METHODS]
    assert report["0.9 regularised"] == judged(scene, config)
    for alpha in (0.5, 0.8, 0.9, 0.98):
        alone = load_config(config, {"interval": {"alpha": alpha}, "regularization": None})
        assert report[str(alpha)] == judged(scene, alone)
    widths = [report[name]["mean_width"] for name in ("0.5", "0.8", "0.9", "0.98")]
    assert widths == sorted(widths, reverse=True)
    assert len({report[name]["count"] for name in METHODS}) == 1
    assert report["baseline"]["accuracy"] < report["0.98"]["accuracy"]


def test_ablate_pair__says_what_it_cannot_use(folder, monkeypatch):
    (pair,) = find_pairs([folder])
    search = {"minimum": pair.minimum, "maximum": pair.maximum}
    with pytest.raises(SatIntervalsError, match="regularization is null, but the ablation needs it"):
        ablate_pair(pair, {"disparity": search, "regularization": None})
    with rasterio.open(pair.truth) as file:
        profile = file.profile | {"height": 89}
    with rasterio.open(folder / "short.tif", "w", **profile):
        pass
    files = {"left": pair.left, "right": pair.right, "truth": folder / "short.tif"}
    with pytest.raises(SatIntervalsError, match=r"short.tif has 89 x 110 pixels, .*left.tif 90 x 110"):
        ablate_pair(Pair("short", "all", **files, **search))
    volume = volume_bytes(90, 110, load_config({"disparity": search}))
    monkeypatch.setattr(memory, "usable_memory", lambda: PROCESS_BYTES + volume)  # none for the bands
    with pytest.raises(SatIntervalsError, match=r"90 x 110 pixels x .* this process may use 0.3 GB: cut the pair"):
        ablate_pair(pair)


def test_command__prints_json_and_a_table(folder):
    report = ablate_pair(*find_pairs([folder]))
    result = invoke("ablate", folder, "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout) == report
    assert result.stderr == f"matching {folder}\n"
    result = invoke("ablate", folder, "-q")
    assert result.stderr == ""
    label, scenes, _, *figures = result.stdout.splitlines()[2].split()
    assert (label, scenes) == ("all", "1")
    assert figures == [f"{report[name]['accuracy']:.3f}" for name in METHODS]


# ---- Real pairs --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("year", [2003, 2005])
def test_ablate_pair__reproduces_the_reference(shared_data, year):
    scenes = []
    for pair in find_pairs(sorted(shared_data.glob(f"mb{year}_*"))):
        search = {"minimum": pair.minimum, "maximum": pair.maximum}
        accurate = {"preset": "paper", "disparity": search, "cross_check": {"method": "accurate"}}
        scenes.append(SceneMetrics(pair.name, pair.group, ablate_pair(pair, accurate)))
    ours, paper, known = table_2(scenes)
    assert (ours.label, paper.label, known.label) == (f"middlebury{year}", "paper", "reference")
    for method in METHODS:
        assert ours.figures[method] == pytest.approx(known.figures[method], abs=0.01)
    for method in ("0.5", "0.9 regularised") if year == 2003 else ("0.8", "0.9 regularised"):
        assert ours.figures[method] == pytest.approx(paper.figures[method], abs=0.01)
