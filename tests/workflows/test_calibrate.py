"""Calibrations of demo scenes: through the engine, against runs with them, and from mistaken inputs."""

import dataclasses
import json
from shutil import copytree

import numpy as np
import pytest
import rasterio
import yaml
from helpers import PLACE, invoke, write_pair

from sat_intervals import SatIntervalsError, match_arrays, match_pair, open_image
from sat_intervals.config import PRESETS, Cluster, calibration_of, load_calibration, load_config
from sat_intervals.config.calibration import COVERAGES
from sat_intervals.demo import make_scene
from sat_intervals.errors import ChangedInputError
from sat_intervals.evaluate.disparity import evaluate_run
from sat_intervals.kernels.confidence import surroundings
from sat_intervals.match.gauge import pairs_of
from sat_intervals.products import INVALID, REGULARIZED
from sat_intervals.raster import write_layer
from sat_intervals.run import measure
from sat_intervals.run.calibrate import check_scenes
from sat_intervals.run.job import open_job
from sat_intervals.run.measure import CalibrationScene, measure_scenes, truth_of
from sat_intervals.workflows.calibrate import Choices, scenes_of


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder of a pair, with its calibration in calibration.yaml and what the command printed in said."""
    folder = tmp_path_factory.mktemp("scene")
    write_pair(folder, make_scene(100, 140, seed=5))
    result = invoke("calibrate", folder, "--output", folder / "calibration.yaml")
    assert result.exit_code == 0, result.output
    (folder / "said").write_text(result.output)
    return folder


def read_masked(path):
    with rasterio.open(path) as file:
        return file.read(1, masked=True)


def calibrated(folder, output, *options):
    result = invoke("calibrate", folder, "--output", output, "--quiet", "--name", "one", *options)
    assert (result.exit_code, result.output) == (0, "")
    return output.read_bytes()


def begun(said, stage):
    """How often a stage of a command's progress begins."""
    return sum(line.startswith(f"{stage}: ") for line in said.splitlines())


def settings_with(folder, **interval):
    low, high = json.loads((folder / "meta.json").read_text())["disparity"]
    return {"disparity": {"minimum": low, "maximum": high}, "interval": interval}


@pytest.mark.parametrize("coverage", [0.5, 0.9, 0.99])
def test_calibrate__a_run_with_its_levels_has_the_coverage(scene, tmp_path, coverage):
    """On the pair of the calibration itself, in each class."""
    settings = settings_with(scene, coverage=coverage, calibration=str(scene / "calibration.yaml"))
    match_pair(scene / "left.tif", scene / "right.tif", tmp_path, settings)
    report = evaluate_run(tmp_path, scene / "truth.tif")
    for name in ("all", "high", "low"):
        assert report[name]["accuracy"] == pytest.approx(coverage, abs=0.02), name


def test_calibrate__smooth_ground_and_edges_each_have_the_coverage(scene):
    """On the pair of the calibration itself; edges have a larger factor."""
    calibration = load_calibration(scene / "calibration.yaml")
    settings = settings_with(scene, coverage=0.9, calibration=calibration)
    left, right, truth = (read_masked(scene / f"{name}.tif") for name in ("left", "right", "truth"))
    found = match_arrays(left, right, settings)
    disparity, valid = found.disparity.values, found.validity.values & INVALID == 0
    lowest, highest, whole = surroundings(disparity, valid, 9)
    edge = ~whole | (highest - lowest > 2)
    inside = (found.lower.values <= truth) & (truth <= found.upper.values)
    judged = valid & np.isfinite(truth.filled(np.nan)) & (found.validity.values & REGULARIZED == 0)
    for where in (edge, ~edge):
        assert inside[judged & where].mean() == pytest.approx(0.9, abs=0.02)
    assert calibration.levels[5].edge > calibration.levels[5].high


def test_calibrate__the_file_says_what_to_expect(scene):
    content = yaml.safe_load((scene / "calibration.yaml").read_text())
    expected = content["provenance"]["expected"]
    assert [row["coverage"] for row in expected] == [row["coverage"] for row in content["levels"]]
    nominal = next(row for row in expected if row["coverage"] == 0.9)
    assert 0.8 < nominal["all"] < 0.96
    assert nominal["lowest"] < nominal["all"]
    assert nominal["score"] > nominal["mean_width"] > nominal["median_width"] > 0
    assert f"{nominal['all']:.3f}" in (scene / "said").read_text()


@pytest.mark.process
def test_calibrate__workers_do_not_change_a_byte(scene, tmp_path):
    one = calibrated(scene, tmp_path / "one.yaml", "--tile-size", 64, "--workers", 1)
    said = invoke("calibrate", scene, "--output", tmp_path / "four.yaml", "--name", "one", "--tile-size", 64).output
    assert (begun(said, "matching at levels"), begun(said, "matching tiles")) == (1, 0)
    assert one == calibrated(scene, tmp_path / "two.yaml", "--tile-size", 64, "--workers", 2)
    assert one == calibrated(scene, tmp_path / "processes.yaml", "--tile-size", 64, "--cluster", "processes")
    assert len(list(tmp_path.iterdir())) == 4  # no tiles are left


def test_calibrate__a_finished_run_equals_its_pair(scene, tmp_path):
    """The run is matched again from its images, with its own settings, but over its whole search range."""
    settings = settings_with(scene, alpha=0.7)
    settings["disparity"]["local"] = True
    match_pair(scene / "left.tif", scene / "right.tif", tmp_path / "run", settings)
    found = yaml.safe_load(calibrated(tmp_path / "run", tmp_path / "one.yaml"))
    expected = yaml.safe_load((scene / "calibration.yaml").read_text())
    assert (found["name"], expected["name"]) == ("one", "calibration")
    assert (found["levels"], found["key"]) == (expected["levels"], expected["key"])


def test_calibrate__bias_and_tolerance_make_up_for_a_shifted_truth(scene, tmp_path):
    """A constant error of the truth, and truths rounded to whole pixels, cost no width."""
    with rasterio.open(scene / "truth.tif") as file:
        truth = file.read(1)
    write_layer(tmp_path / "truth.tif", np.rint(truth + 1).astype(np.float32), np.nan, PLACE)
    low, high = json.loads((scene / "meta.json").read_text())["disparity"]
    rows = [f"{scene}/left.tif,{scene}/right.tif,{tmp_path}/truth.tif,{low},{high},0.5,true"]
    (tmp_path / "pairs.csv").write_text("left,right,truth,minimum,maximum,tolerance,remove_bias\n" + "\n".join(rows))
    shifted = yaml.safe_load(calibrated(tmp_path / "pairs.csv", tmp_path / "shifted.yaml"))
    exact = yaml.safe_load((scene / "calibration.yaml").read_text())
    assert shifted["levels"][5]["high"] <= 1.05 * exact["levels"][5]["high"]


def with_truth(scene, folder, truth):
    """A copy of a pair with another truth."""
    for name in ("left.tif", "right.tif", "meta.json"):
        (folder / name).symlink_to(scene / name)
    write_layer(folder / "truth.tif", truth.astype(np.float32), np.nan, PLACE)
    return folder


def one_line(result):
    assert result.exit_code == 2, result.output
    assert result.output.count("\n") == 1
    assert result.output.startswith("sat-intervals: ")
    return result.output


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        (np.zeros((30, 40)), "30 x 40 pixels"),
        (np.full((100, 140), np.nan), "0 known truths, at least 1000"),
        (np.where(np.arange(100 * 140) == 9000, -5, np.nan).reshape(100, 140), "1 known truths, at least 1000"),
        (np.full((100, 140), 500), "14000 of 14000 truths are outside the search range"),
    ],
)
def test_calibrate__a_wrong_truth_is_one_line(scene, tmp_path, truth, words):
    folder = with_truth(scene, tmp_path, truth)
    line = one_line(invoke("calibrate", folder, "--output", tmp_path / "calibration.yaml", "--quiet"))
    assert words in line
    assert "truth.tif" in line


def test_calibrate__mistaken_arguments_are_one_line(scene, tmp_path):
    output = "--output", tmp_path / "new.yaml"
    assert "classes of confidence" in one_line(invoke("calibrate", scene, *output, "--config", off(tmp_path)))
    assert "given 2 times for 1 runs and pairs" in one_line(
        invoke("calibrate", scene, *output, *2 * ("--truth", "a.tif"))
    )
    assert "applies only with --dsm" in one_line(invoke("calibrate", scene, *output, "--coverage", 0.9))
    assert "existing folder" in one_line(invoke("calibrate", scene, "--output", tmp_path / "no" / "new.yaml"))
    assert "truth.tif" in one_line(invoke("calibrate", scene, "--output", scene / "truth.tif"))
    assert "is an input" in one_line(invoke("calibrate", scene, "--output", scene / "meta.json"))
    own, given = tmp_path / "own.yaml", tmp_path / "given.yaml"
    own.write_text(yaml.safe_dump(calibration_of(load_config({"interval": {"coverage": 0.9}})).model_dump(mode="json")))
    given.write_text(yaml.safe_dump({"interval": {"coverage": 0.9, "calibration": str(own)}}))
    assert "own.yaml is an input" in one_line(
        invoke("calibrate", scene, "--output", own, "--config", given, "--overwrite")
    )
    (tmp_path / "other.yaml").write_text("mine")
    assert "other.yaml exists: choose another name" in one_line(
        invoke("calibrate", scene, "--output", tmp_path / "other.yaml")
    )
    assert not (tmp_path / "new.yaml").exists()


@pytest.fixture
def few(monkeypatch):
    """Two levels of the sweep."""
    monkeypatch.setattr(measure, "pairs_of", lambda thresholds: pairs_of(thresholds)[:1])


@pytest.mark.usefixtures("few")
def test_measure_scenes__deletes_the_tiles_of_a_killed_calibration(scene, tmp_path):
    for level in range(20):
        tiles = tmp_path / ".calibrate/0" / str(level) / "tiles"
        tiles.mkdir(parents=True)
        (tiles / "manifest.json").write_text("{}")  # of no run: it could not be resumed
    measure_scenes(scenes_of([scene], (), Choices()), tmp_path, lambda stage, done, total: None)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("few")
def test_measure_scenes__ends_where_an_image_changes(scene, tmp_path):
    pair = copytree(scene, tmp_path / "pair")
    scenes = scenes_of([pair], (), Choices())

    def change(stage, done, total):
        if stage == "tiles":
            with rasterio.open(pair / "left.tif", "r+") as file:
                file.write(np.ones(file.shape, file.dtypes[0]), 1)

    with pytest.raises(ChangedInputError, match=r"left\.tif was changed during the run \(left\.\w+ was"):
        measure_scenes(scenes, tmp_path, change)
    assert list(tmp_path.iterdir()) == [pair]


def off(folder):
    file = folder / "off.yaml"
    file.write_text("regularization: null\n")
    return file


def test_check_scenes__needs_the_search_range_as_numbers(scene):
    left, right = (open_image(scene / f"{side}.tif") for side in ("left", "right"))
    scene = CalibrationScene("one", "one", left, right, truth_of(left, scene / "truth.tif"), load_config({}))
    with pytest.raises(SatIntervalsError, match="one: the search range is auto, but calibrate needs it as numbers"):
        check_scenes([scene])


def test_match__warns_of_a_coverage_that_the_calibration_does_not_reach(scene, tmp_path):
    content = yaml.safe_load((scene / "calibration.yaml").read_text())
    content["levels"][8]["reached"] = False
    (tmp_path / "short.yaml").write_text(yaml.safe_dump(content))
    arguments = "match", scene / "left.tif", scene / "right.tif", tmp_path / "out", "--disparity", -10, 10
    options = "--calibration", tmp_path / "short.yaml", "--strict", "--coverage", 0.98
    result = invoke(*arguments, *options)
    assert result.exit_code == 1
    assert "the pairs of calibration calibration do not reach coverage 0.98 at any level" in result.output
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert any("do not reach coverage 0.98" in line for line in report["warnings"])
    assert report["calibration"]["reached"] is False


def test_open_job__tiles_depend_on_the_levels_of_a_calibration_only(scene, tmp_path):
    """A calibration with another name or provenance resumes a run, one with other levels does not."""
    content = yaml.safe_load((scene / "calibration.yaml").read_text())

    def job(coverage, **changes):
        settings = settings_with(scene, coverage=coverage, calibration=content | changes)
        return open_job(scene / "left.tif", scene / "right.tif", tmp_path / "out", settings)

    one, other, higher = job(0.9), job(0.9, name="other", provenance={}), job(0.95)
    assert one.manifest == other.manifest != higher.manifest
    assert one.name != other.name  # the name is in the files


def test_calibrate__a_run_is_matched_again_on_this_machine(scene, tmp_path):
    """Whatever the run's cluster was, unless the options name one."""
    settings = settings_with(scene) | {"cluster": {"workers": 2, "store": str(tmp_path / "store")}}
    match_pair(scene / "left.tif", scene / "right.tif", tmp_path / "out", settings)
    for given in ({}, {"cluster": {"workers": 1}}):
        (scene,) = scenes_of([tmp_path / "out"], (), Choices(overrides=given))
        assert scene.config.cluster == Cluster(**given.get("cluster", {}))


def test_check_scenes__needs_another_group_to_judge_with(scene, tmp_path):
    folders = [tmp_path / "one", tmp_path / "other"]
    for folder in folders:
        copytree(scene, folder)
    line = one_line(invoke("calibrate", *folders, "--by-group", "--output", tmp_path / "new.yaml"))
    assert "all 2 pairs are of group" in line


@pytest.mark.parametrize("tolerance", [0, 0.5])
def test_check_scenes__warns_of_a_truth_in_whole_pixels(scene, tmp_path, caplog, tolerance):
    folder = copytree(scene, tmp_path / "pair")
    with rasterio.open(folder / "truth.tif", "r+") as file:
        file.write(np.rint(file.read()))
    check_scenes(scenes_of([folder], (), Choices(tolerance=tolerance)))
    assert ("pair has whole pixels only: try --tolerance 0.5" in caplog.text) == (tolerance == 0)


def test_check_scenes__refuses_a_scene_that_counts_twice(scene, tmp_path):
    for out in (tmp_path / "one", tmp_path / "other"):
        match_pair(scene / "left.tif", scene / "right.tif", out, settings_with(scene, coverage=0.9))
    line = one_line(invoke("calibrate", tmp_path / "one", tmp_path / "other", "--output", tmp_path / "new.yaml"))
    assert f"{tmp_path}/one and {tmp_path}/other are the same scene: give each scene once" in line
    (one,) = scenes_of([scene], (), Choices())
    third = open_image(copytree(scene, tmp_path / "third") / "right.tif")
    check_scenes([one, dataclasses.replace(one, name="a triplet", group="another", right=third)])


MCCNN = [pytest.param(preset, marks=pytest.mark.peer("onnxruntime")) for preset in PRESETS if "mccnn" in preset]


@pytest.mark.parametrize("preset", [preset for preset in PRESETS if "mccnn" not in preset] + MCCNN)
def test_calibration_of__each_preset_has_a_built_in_one(preset):
    config = load_config({"preset": preset, "disparity": {"minimum": 0, "maximum": 9}, "interval": {"coverage": 0.9}})
    assert calibration_of(config).name == preset


@pytest.mark.parametrize("preset", PRESETS)
def test_load_calibration__built_in_ones_come_from_the_command_and_expect_more_of_higher_coverages(preset):
    found = load_calibration(preset)
    for levels in found.levels:
        assert (round(levels.high, 3), round(levels.low, 2)) == (levels.high, levels.low)
        assert (levels.edge is not None) == ("satellite" in preset)
    figures = found.provenance["expected"]
    assert [row["coverage"] for row in figures] == list(COVERAGES)
    for name in ("all", "high", "low", "mean_width", "median_width"):
        assert sorted(row[name] for row in figures) == [row[name] for row in figures], name
    assert all(abs(row["all"] - row["coverage"]) < 0.03 for row in figures)
    assert len(found.provenance["pairs"]) == {"many": 6}.get(preset, 14 if "satellite" in preset else 12)
