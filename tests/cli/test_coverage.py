"""`--coverage` and `--calibration` through the commands: match, plan, batch, evaluate, report, plot, resuming."""

import json

import pytest
import rasterio
import yaml
from helpers import calibration, invoke, write_pair

from sat_intervals import load_config
from sat_intervals.demo import make_scene
from sat_intervals.show import maps


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A pair with truth; beside it settings with an alpha, and a calibration."""
    folder = tmp_path_factory.mktemp("pair")
    settings = write_pair(folder, make_scene(110, 120), interval={"alpha": 0.8})
    own = calibration(load_config(settings), 36.25, 12.5, 0.9)
    (folder / "own.yaml").write_text(yaml.safe_dump(own))
    return folder


def given(pair, *more):
    return [pair / "left.tif", pair / "right.tif", *more, "--config", pair / "settings.yaml"]


@pytest.fixture(scope="module")
def run(pair, tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "out"
    done = invoke("match", *given(pair, out), "--coverage", 0.9, "--calibration", pair / "own.yaml")
    assert done.exit_code == 0, done.output
    return out


def test_match__coverage_replaces_the_alpha_of_a_file(run):
    interval = json.loads((run / "run.json").read_text())["settings"]["interval"]
    assert (interval["alpha"], interval["coverage"]) == (None, 0.9)
    assert interval["calibration"]["name"] == "flat"


def test_evaluate_report_plot__show_the_coverage_asked_for(run, pair, tmp_path, monkeypatch):
    report = json.loads(invoke("evaluate", run, "--json").output)
    assert report["nominal"] == 0.9
    assert report["all"]["interval_score"] >= report["all"]["mean_width"]
    assert "coverage asked for: 0.9" in invoke("evaluate", run).output
    assert invoke("report", run).exit_code == 0
    assert "nominalSentence" in (run / "report.html").read_text()
    at_80 = tmp_path / "at_80"
    assert invoke("match", *given(pair, at_80), "--coverage", 0.8, "--calibration", pair / "own.yaml").exit_code == 0
    both = invoke("evaluate", run, at_80)
    rows = {line.split()[0]: line.split()[1:] for line in both.output.splitlines() if line}
    assert rows[str(run)][:2] == ["0.900", f"{report['all']['accuracy']:.3f}"]
    assert rows[str(at_80)][0] == "0.800"
    assert rows["mean"][0] == "0.850"
    for name in ("draw_overview", "draw_errors"):
        monkeypatch.setattr(maps, name, lambda results, path, dpi: path.write_bytes(b"drawn"))
    judging = "--tolerance", 1, "--remove-bias", "--mask", pair / "truth.tif"
    drawn = invoke("plot", run, "--beside", at_80, "--pixel", 100, 100, "--dpi", 40, *judging)
    assert drawn.exit_code == 0, drawn.output
    assert str(run / "coverage.png") in drawn.output.split()


def test_plot__beside_takes_runs_of_the_same_pair(run, pair, tmp_path):
    other = tmp_path / "other"
    assert invoke("match", pair / "right.tif", pair / "left.tif", other, "--disparity", -4, 4).exit_code == 0
    drawn = invoke("plot", run, "--beside", other)
    assert drawn.exit_code == 2
    assert f"{other} is a run of other images than {run}: give runs of one pair" in drawn.stderr


def test_plan_and_batch__take_a_coverage(pair, tmp_path):
    options = ["--config", pair / "settings.yaml", "--coverage", 0.9, "--calibration", pair / "own.yaml"]
    planned = invoke("plan", pair / "left.tif", pair / "right.tif", *options)
    assert planned.exit_code == 0, planned.output
    row = f"{pair / 'left.tif'},{pair / 'right.tif'}"
    (tmp_path / "pairs.csv").write_text(f"name,left,right,interval.coverage\na,{row},\nb,{row},0.7\n")
    batch = invoke("batch", tmp_path / "pairs.csv", tmp_path / "out", *options)
    assert batch.exit_code == 0, batch.output
    tags = []
    for name in ("a", "b"):
        with rasterio.open(tmp_path / "out" / name / "intervals.tif") as file:
            tags.append(file.tags()["COVERAGE"][:3])
    assert tags == ["0.9", "0.7"]


def test_match__names_what_is_wrong_with_a_coverage(pair, tmp_path):
    def says(*options):
        done = invoke("match", *given(pair, tmp_path / "out"), *options)
        assert done.exit_code == 2
        return done.output

    own = "--calibration", pair / "own.yaml"
    assert "interval.coverage is 0.3, allowed: number >= 0.5, <= 0.99 or null" in says("--coverage", 0.3, *own)
    assert "calibration goes with coverage only" in says("--alpha", 0.9, *own)
    assert "alpha is 0.9 and coverage 0.9: leave one out" in says("--alpha", 0.9, "--coverage", 0.9)
    assert "belongs to other settings, cost.window is 5" in says("--coverage", 0.9, *own, "--set", "cost.window=7")
