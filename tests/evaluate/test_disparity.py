"""Figures of merit against a slow twin: of maps, runs on disk and real pairs, and as the command prints them."""

import json
import re
import shutil
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
import reference_evaluation
from finished import random_bands, without_intervals, write_run
from helpers import invoke, write_pair
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals import match_pair
from sat_intervals.config.pairs import find_pairs, group_beside
from sat_intervals.demo import make_scene
from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.disparity import evaluate, evaluate_run
from sat_intervals.evaluate.metrics import Criteria
from sat_intervals.evaluate.paper import SceneMetrics, table_1
from sat_intervals.match.postprocess import cut_rows
from sat_intervals.products import INVALID, OCCLUSION, Bands
from sat_intervals.tiling import Window

some = settings(max_examples=50, derandomize=True, deadline=None)
NAN = float("nan")


def same(found, expected, **tolerance):
    """Two reports hold the same figures."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for key in expected:
            same(found[key], expected[key], **tolerance)
    elif isinstance(expected, list):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            same(one, other, **tolerance)
    elif expected is None:
        assert found is None
    else:
        assert found == pytest.approx(expected, **tolerance)


def rows_of(scene):
    flags = np.where(scene.valid, 0, OCCLUSION).astype(np.uint16)
    return Bands(scene.disparity, scene.lower, scene.upper, scene.confidence, flags, scene.truth)


def cut_into(rows, heights):
    """The rows in strips, lastly what the heights leave."""
    edges = [0, *np.cumsum(heights).clip(max=rows.truth.shape[0]), rows.truth.shape[0]]
    return [cut_rows(rows, a, b) for a, b in pairwise(edges) if b > a]


@st.composite
def scenes(draw):
    """Maps of halves and quarters of a pixel, with holes, criteria to judge them by, and heights of strips."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = int(random.integers(1, 12)), int(random.integers(1, 12))
    minimum, maximum = -4, draw(st.sampled_from([-4, 4, 12]))
    disparity = random.integers(2 * minimum, 2 * maximum + 1, shape) / 2
    spread = draw(st.sampled_from([0, 3, 8]))
    lower = np.maximum(disparity - random.integers(0, spread + 1, shape) / 2, minimum)
    upper = np.minimum(disparity + random.integers(0, spread + 1, shape) / 2, maximum)
    truth = disparity + random.integers(-6, 9, shape) / 4 * draw(st.sampled_from([0, 1, 1, 5]))
    confidence = random.choice([0, 0.3, 0.55, 0.6, 0.601, 0.8, 1, NAN], shape).astype(np.float32)
    holes = draw(st.sampled_from([0, 0.2, 1]))
    lower[random.random(shape) < holes / 2] = NAN
    truth[random.random(shape) < holes] = NAN
    scene = SimpleNamespace(
        disparity=disparity.astype(np.float32),
        lower=lower.astype(np.float32),
        upper=upper.astype(np.float32),
        confidence=confidence,
        valid=random.random(shape) < 0.8,
        truth=truth,
    )
    depth, kernel = draw(st.integers(0, 3)), draw(st.sampled_from([1, 3, 5]))
    tolerance, nominal = draw(st.sampled_from([0.0, 0.25])), draw(st.sampled_from([None, 0.9]))
    criteria = Criteria(minimum, maximum, 0.6, kernel, depth, tolerance, nominal=nominal)
    return scene, criteria, draw(st.lists(st.integers(1, 5), max_size=6))


# ---- Maps --------------------------------------------------------------------------------------------------
@some
@given(scenes(), st.booleans(), st.booleans())
def test_evaluate__equals_the_slow_twin(drawn, remove_bias, with_rejected):
    scene, criteria, heights = drawn
    how = {"remove_bias": remove_bias, "with_rejected": with_rejected}
    found = evaluate(lambda: cut_into(rows_of(scene), heights), criteria, **how)
    expected = reference_evaluation.evaluate(scene, criteria, **how)
    # ratios of errors and widths are counted to 0.001, everything else here is exact
    same(found, expected, abs=0.0005 + 1e-9)
    for report in (found, expected):
        del report["low"]["relative_overestimation"], report["with_rejected"]
    same(found, expected, rel=1e-12)


EXAMPLE = SimpleNamespace(
    truth=np.array([[1, 2, 3, NAN, 5], [0, 1, 7, 2, 4]]),
    disparity=np.array([[1, 2.5, 6, 4, 5], [0.5, 4, 5, 2, 0]], np.float32),
    lower=np.array([[0, 3, 2, 3, 4], [0, 0, 4, 2, 0]], np.float32),
    upper=np.array([[2, 4, 8, 6, 6], [1, 4, 8, 2, 2]], np.float32),
    confidence=np.array([[0.9, 0.5, 0.5, 0.4, 0.7], [0.2, 1.0, 0.6, 0.9, 0.3]], np.float32),
    valid=np.array([[1, 1, 1, 1, 1], [1, 1, 1, 1, 0]], bool),
)


def test_evaluate__worked_example():
    # Search range -2 .. 8; low up to confidence .6, kernel 1, depth 1. Judged are 8 valid pixels of known truth.
    #   inside  y n y . y / y y y y     7 of 8; widths 2 1 6 . 2 / 1 4 4 0, their median 2 of 10, their mean 20 / 8
    #   low     . L L L . / L . L . L   segments of columns 1-3 above, and 0, 2, 4 below: the first and column 2 touch
    #   high    4 of 4, widths 2 2 4 0: median 2, mean 2;   low   3 of 4, widths 1 6 1 4: median 2.5, mean 3
    #   errors  0 .5 3 . 0 / .5 3 2 0 (4)    three above 1, none above 3
    #   area    3 on the touching segments, .5 on column 0 below
    #   1 - area / width: 1 - 3/1 = -2, 1 - 3/6 = .5, 1 - .5/1 = .5, 1 - 3/4 = .25: median .375
    #   with the rejected pixel, a miss of error 4 alone in its area, width 2: 1 - 4/2 = -1, median .25
    #   disparity - truth: 0 .5 3 . 0 / .5 3 -2 0: median .25
    #   the miss is by 1; at a nominal coverage of .75 it adds 2 / .25 to the widths: 2.5 + 8 / 8, 2, 3 + 8 / 4
    criteria = Criteria(-2, 8, 0.6, 1, 1, nominal=0.75)
    report = evaluate(lambda: [rows_of(EXAMPLE)], criteria, with_rejected=True)
    names = ("count", "accuracy", "relative_size", "mean_width", "median_width", "interval_score")
    assert report["all"] == dict(zip(names, (8, 0.875, 0.2, 2.5, 2, 3.5), strict=True))
    assert report["high"] == dict(zip(names, (4, 1, 0.2, 2, 2, 2), strict=True))
    low = report["low"]
    assert low == dict(zip(names, (4, 0.75, 0.25, 3, 2.5, 5), strict=True)) | {"relative_overestimation": 0.375}
    assert (report["bad1"], report["bad3"], report["truth_outside_range"]) == (0.375, 0, 0)
    assert report["with_rejected"]["all"]["count"] == 9
    assert report["with_rejected"]["low"]["accuracy"] == 0.6
    assert report["with_rejected"]["low"]["relative_overestimation"] == 0.25
    # confidences .2 .5 .5 .6 .7 .9 .9 1: the middles of their ranks .5, 2, 3.5, 4.5, 6, 7.5 of 8 are in six deciles
    assert [decile["confidence"][0] for decile in report["deciles"]] == [0.2, 0.5, 0.6, 0.7, 0.9, 1.0]
    assert [decile["count"] for decile in report["deciles"]] == [1, 2, 1, 1, 2, 1]
    assert [decile["accuracy"] for decile in report["deciles"]] == [1, 0.5, 1, 1, 1, 1]
    assert evaluate(lambda: [rows_of(EXAMPLE)], criteria, remove_bias=True)["bias"] == 0.25


def test_evaluate__without_confidence_all_is_high():
    scene = SimpleNamespace(**vars(EXAMPLE) | {"confidence": np.full((2, 5), NAN, np.float32)})
    report = evaluate(lambda: [rows_of(scene)], Criteria(-2, 8, 0.6, 5, 2))
    assert report["high"] == report["all"]
    assert report["low"]["count"] == 0
    assert report["low"]["relative_overestimation"] is None
    assert report["deciles"] == []


# ---- Runs on disk ------------------------------------------------------------------------------------------
def write(path, pixels, nodata):
    profile = {"driver": "GTiff", "height": pixels.shape[0], "width": pixels.shape[1], "count": 1}
    transform = rasterio.Affine(0.5, 0, 300000, 0, -0.5, 4800000)
    with rasterio.open(path, "w", dtype=pixels.dtype, nodata=nodata, transform=transform, **profile) as file:
        file.write(pixels, 1)


def small_pair(folder, seed, group="synthetic"):
    """A folder of a pair of 70 x 90 pixels, as `find_pairs` takes it."""
    folder.mkdir()
    write_pair(folder, make_scene(70, 90, seed=seed), group=group)
    return folder


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    return small_pair(tmp_path_factory.mktemp("pair") / "one", 1)


def settings_of(folder, **more):
    (pair,) = find_pairs([folder])
    return {"preset": "paper", "disparity": {"minimum": pair.minimum, "maximum": pair.maximum}, **more}


@pytest.fixture(scope="module")
def run(pair, tmp_path_factory):
    """A run that kept rejected pixels."""
    out = tmp_path_factory.mktemp("run") / "out"
    match_pair(pair / "left.tif", pair / "right.tif", out, settings_of(pair, products={"keep_rejected": True}))
    return out


def read(path):
    with rasterio.open(path) as file:
        return file.read()


def scene_of(out, truth):
    disparity, lower, upper, confidence = read(out / "intervals.tif")
    valid = read(out / "validity.tif")[0] & INVALID == 0
    bands = {"disparity": disparity, "lower": lower, "upper": upper, "confidence": confidence}
    return SimpleNamespace(**bands, valid=valid, truth=truth)


def criteria_of(out, tolerance=0.0):
    report = json.loads((out / "run.json").read_text())["settings"]
    names = {"kernel", "threshold", "depth"}
    low = {name: value for name, value in report["regularization"].items() if name in names}
    return SimpleNamespace(**report["disparity"], **low, tolerance=tolerance, nominal=0.9)


def test_evaluate_run__equals_the_slow_twin(pair, run, tmp_path, monkeypatch):
    truth = read(pair / "truth.tif")[0]
    mask = np.random.default_rng(0).integers(0, 2, truth.shape).astype(np.uint8)
    write(tmp_path / "mask.tif", mask, None)
    found = evaluate_run(run, mask=tmp_path / "mask.tif", tolerance=0.25, remove_bias=True)
    assert (found.pop("cost"), found.pop("nominal_is")) == ("census", "alpha")
    scene = scene_of(run, np.where(mask != 0, truth, np.nan))
    expected = reference_evaluation.evaluate(scene, criteria_of(run, 0.25), remove_bias=True, with_rejected=True)
    assert expected["all"]["count"] < expected["with_rejected"]["all"]["count"]
    assert found["bias"] == pytest.approx(expected["bias"], abs=0.0005)
    same(found, expected, abs=0.003)  # of the bias, which decides where the truth lies in its interval

    monkeypatch.setattr("sat_intervals.results._STRIP", 9 * 90)
    monkeypatch.setattr("sat_intervals.evaluate.disparity._PIXELS", 4 * 90)
    in_strips = evaluate_run(run, mask=tmp_path / "mask.tif", tolerance=0.25, remove_bias=True)
    same({name: in_strips[name] for name in found}, found)


def test_evaluate_run__of_a_region_takes_its_truth_or_the_whole(pair, tmp_path):
    window = Window(20, 30, 40, 50)
    match_pair(pair / "left.tif", pair / "right.tif", tmp_path / "out", settings_of(pair), window=window)
    part = read(pair / "truth.tif")[0][window.slices]
    write(tmp_path / "part.tif", np.where(np.isnan(part), -999, part).astype(np.float32), -999)
    whole = evaluate_run(tmp_path / "out", pair / "truth.tif")
    assert whole["all"]["count"] > 100
    assert evaluate_run(tmp_path / "out", tmp_path / "part.tif") == whole
    assert whole["with_rejected"] is None
    write(tmp_path / "other.tif", part[1:], NAN)
    with pytest.raises(SatIntervalsError, match="39 x 50 pixels, the left image 70 x 90, the run 40 x 50"):
        evaluate_run(tmp_path / "out", tmp_path / "other.tif")


def test_evaluate_run__says_what_is_missing(tmp_path):
    bands, validity, _ = random_bands(20, 30)
    out = write_run(tmp_path, bands, validity)
    with pytest.raises(SatIntervalsError, match=r"no truth.tif beside its left image .*left.tif: give a truth"):
        evaluate_run(out)
    assert group_beside(tmp_path / "left.tif") == "all"
    (tmp_path / "off").mkdir()
    with pytest.raises(SatIntervalsError, match="has no intervals"):
        evaluate_run(without_intervals(tmp_path / "off"))


def test_evaluate__warns_of_a_truth_of_another_left_image(run, pair, tmp_path):
    truth, left = tmp_path / "truth.tif", json.loads((run / "run.json").read_text())["inputs"]["left"]
    shutil.copy(pair / "truth.tif", truth)
    for made_for, said in ((left["sha256"], ""), (64 * "0", f"{truth} was made for another left image than")):
        with rasterio.open(truth, "r+") as file:
            file.update_tags(LEFT_SHA256=made_for)
        done = invoke("evaluate", run, "--truth", truth, "--quiet")
        assert done.exit_code == 0
        assert said in done.stderr
        assert bool(said) == bool(done.stderr)


# ---- Tables and pairs --------------------------------------------------------------------------------------
def report_of(accuracy):
    area = {"accuracy": accuracy, "relative_size": 0.1, "relative_overestimation": None}
    return {"cost": "census", "all": area, "high": area, "low": area, "with_rejected": None}


def test_table_1__means_by_group_and_cost():
    names = ("a", "town", "census"), ("b", "satellite", "census"), ("c", "town", "census"), ("a", "town", "mccnn")
    accuracies = (0.8, 0.9, 0.95, 0.7)
    rows = table_1(
        SceneMetrics(name, group, report_of(accuracy) | {"cost": cost})
        for (name, group, cost), accuracy in zip(names, accuracies, strict=True)
    )
    assert [row.label for row in rows] == ["town census", "town mccnn", "satellite census"]
    assert rows[0].figures["acc."] == pytest.approx(0.875)
    assert rows[0].figures["overest."] is None
    assert [(row.scenes, row.at_objective) for row in rows] == [(2, 1), (1, 0), (1, 1)]


PAIR = "left,right,truth,minimum,maximum"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("meta.json", "[", "meta.json cannot be read"),
        ("meta.json", "3", "meta.json holds int"),
        ("meta.json", '{"disparity": [1]}', r"disparity is \[1\], needed: \[minimum, maximum\]"),
        ("other", "", "meta.json missing; a pair is a folder of left.tif, right.tif, truth.tif, meta.json"),
        ("pairs.csv", "left,right,minimum,maximum\na,b,1,2\n", "row 1 lacks truth: give a list of pairs, each with"),
        ("pairs.csv", f"{PAIR}\n", "pairs.csv holds no pairs: give a list of pairs, each with left, right"),
        ("pairs.csv", f"{PAIR},name\na,b,c,1,2,x\n./a,b,c,1,2,y\n", "/a is given 2 times: give it once"),
        ("pairs.csv", f"{PAIR}\na,b,c,1,x\n", "row 1: maximum is 'x': input should be a valid integer"),
        ("pairs.csv", f"{PAIR}\na,b,c,1,2\na,d,e,3,4\n", "2 pairs or runs are called a: give each its own name"),
    ],
)
def test_find_pairs__says_what_is_wrong(tmp_path, name, text, message):
    for image in ("left", "right", "truth"):
        (tmp_path / f"{image}.tif").touch()
    (tmp_path / name).write_text(text)
    with pytest.raises(SatIntervalsError, match=message):
        find_pairs([tmp_path / name if name == "pairs.csv" else tmp_path])


def test_find_pairs__of_a_table(tmp_path):
    (tmp_path / "pairs.csv").write_text(
        "name,truth,left,right,minimum,maximum,group\none,t.tif,l.tif,r.tif,-3,4,city\n,t.tif,l.tif,/r.tif,0,1,\n"
    )
    one, two = find_pairs([tmp_path / "pairs.csv"])
    with_mark = tmp_path / "marked.csv"  # as spreadsheets write it
    with_mark.write_bytes(b"\xef\xbb\xbf" + (tmp_path / "pairs.csv").read_bytes())
    assert find_pairs([with_mark]) == [one, two]
    assert (one.name, one.group, one.minimum, one.maximum) == ("one", "city", -3, 4)
    assert (one.left, str(two.right)) == (tmp_path / "l.tif", "/r.tif")
    assert (two.name, two.group) == ("l.tif", "all")


# ---- The command -------------------------------------------------------------------------------------------
def command(*arguments):
    result = invoke(*arguments)
    return result.exit_code, result.stdout, result.stderr


def test_command__says_that_nothing_is_judged(run, tmp_path):
    with rasterio.open(run / "validity.tif") as dataset:
        write(tmp_path / "nowhere.tif", np.zeros(dataset.shape, np.uint8), 255)
    status, text, _ = command("evaluate", run, "--mask", tmp_path / "nowhere.tif")
    assert status == 0
    assert "no valid pixel has a known truth: check truth and mask" in text


def test_command__suggests_a_tolerance_for_a_truth_of_whole_pixels(run, pair, tmp_path):
    with rasterio.open(pair / "truth.tif") as dataset:
        write(tmp_path / "whole.tif", np.rint(dataset.read(1)), float("nan"))
    assert command("evaluate", run)[2] == ""
    says = f"warning: the truth of {run} has whole pixels only: try --tolerance 0.5\n"
    assert command("evaluate", run, "--json", "--truth", tmp_path / "whole.tif")[2] == says
    assert command("evaluate", run, "--truth", tmp_path / "whole.tif", "--tolerance", "0.5")[2] == ""


def test_command__advises_to_remove_a_bias(run, pair, tmp_path):
    with rasterio.open(pair / "truth.tif") as dataset:
        write(tmp_path / "moved.tif", dataset.read(1) + 1.7, float("nan"))
    status, text, said = command("evaluate", run, "--truth", tmp_path / "moved.tif")
    found = float(re.search(r"median of disparity - truth: ([+-]\d\.\d+) px", text)[1])
    assert (status, found) == (0, pytest.approx(-1.7, abs=0.1))
    assert f"warning: {run}: the median of disparity - truth is -1." in said
    assert "try --remove-bias" in said


def test_command__prints_one_run(run, pair):
    status, text, _ = command("evaluate", run, "--truth", pair / "truth.tif", "--tolerance", "0.25", "--remove-bias")
    assert status == 0
    lines = text.splitlines()
    assert lines[0] == str(run)
    assert lines[2].startswith("valid pixels ")
    figures = evaluate_run(run, tolerance=0.25, remove_bias=True)
    assert lines[2].split()[2:5] == [str(figures["all"]["count"])] + [
        f"{figures['all'][name]:.3f}" for name in ("accuracy", "mean_width")
    ]
    assert any(line.startswith("alpha: 0.9; interval score: width, and 2 / (1 - that)") for line in lines)
    assert "truth up to 0.25 px outside an interval counts as inside" in lines
    assert f"median of disparity - truth: {figures['median_error']:+.3f} px" in lines
    assert f"added to the truth before: {figures['bias']:+.3f} px" in lines
    has_note = figures["high"]["accuracy"] < figures["low"]["accuracy"] - 0.005
    assert len(lines[lines.index("by decile of confidence") :]) == 2 + len(figures["deciles"]) + has_note


def test_command__matches_pairs_and_prints_a_table(pair, run, tmp_path):
    other = small_pair(tmp_path / "two", 2)
    rows = [(pair, "one"), (other, "two")]
    (tmp_path / "pairs.csv").write_text(
        "left,right,truth,minimum,maximum,name,group\n"
        + "".join(
            f"{folder}/left.tif,{folder}/right.tif,{folder}/truth.tif,{p.minimum},{p.maximum},{name},{p.group}\n"
            for folder, name in rows
            for p in find_pairs([folder])
        )
    )
    status, text, shown = command("evaluate", tmp_path / "pairs.csv", run, "--preset", "paper", "--json")
    assert status == 0
    lines = [line for line in shown.splitlines() if not line.startswith("sat-intervals: ")]
    assert lines == ["matching one", "matching two"]
    reports = json.loads(text)
    assert list(reports) == ["one", "two", str(run)]
    assert reports["one"] == reports[str(run)]
    status, text, shown = command("evaluate", pair, other, "--preset", "paper", "--quiet")
    assert status == 0
    assert not [line for line in shown.splitlines() if not line.startswith("sat-intervals: ")]
    label, scenes, reached, accuracy, *_ = text.splitlines()[2].split()
    assert (label, scenes) == ("synthetic", "2")
    assert "alpha, measured coverage, widths, interval score and disparity - truth (px)" in text
    accuracies = [reports[name]["all"]["accuracy"] for name in ("one", "two")]
    assert int(reached) == sum(value >= 0.9 for value in accuracies)
    assert accuracy == f"{np.mean(accuracies):.3f}"


@pytest.mark.parametrize("value", ["nan", "inf", "-1"])
def test_command__refuses_a_tolerance_that_is_no_number(run, value):
    status, _, shown = command("evaluate", run, "--tolerance", value)
    assert (status, shown.count("\n")) == (2, 1)
    assert "Invalid value for '--tolerance'" in shown


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["RUN", "--config", "nope.yaml"], "--config applies to pairs, but every OUT is a finished run: leave it out"),
        (["PAIR", "PAIR"], "2 pairs or runs are called .*/one: give each its own name"),
        (["PAIR", "--config", "OFF"], "off.yaml: interval is null, but evaluate needs intervals: leave it on"),
        (["nothere.csv"], "nothere.csv cannot be read: No such file or directory: give a list of pairs"),
        (["RUN", "TMP"], "is neither a pair nor a finished run: give a folder"),
        (["RUN", "--truth", "x.tif", "--truth", "y.tif"], "--truth is given 2 times for 1 runs and pairs"),
    ],
)
def test_command__refuses_before_it_matches(run, pair, tmp_path, arguments, says):
    (tmp_path / "off.yaml").write_text("interval: null\nregularization: null\n")
    names = {"RUN": run, "PAIR": pair, "OFF": tmp_path / "off.yaml", "TMP": tmp_path}
    for name, place in names.items():
        arguments = [argument.replace(name, str(place)) for argument in arguments]
    status, _, shown = command("evaluate", *arguments)
    assert (status, shown.count("\n")) == (2, 1)
    assert re.search(says, shown.strip())


# ---- Real pairs --------------------------------------------------------------------------------------------
REFERENCE = {2003: (0.975, 0.035), 2005: (0.959, 0.026)}
PAPER = {2003: (0.973, 0.033), 2005: (0.963, 0.026)}


@pytest.mark.parametrize("year", [2003, 2005])
@pytest.mark.parametrize("flags", [[], ["--set", "cross_check.method=accurate"]])
def test_command__reproduces_the_paper(shared_data, year, flags):
    folders = sorted(shared_data.glob(f"mb{year}_*"))
    status, text, _ = command("evaluate", *folders, "--preset", "paper", *flags)
    assert status == 0
    label, scenes, reached, accuracy, size, *_ = text.splitlines()[2].split()
    assert (label, scenes, reached) == (f"middlebury{year}", str(len(folders)), str(len(folders)))
    for known in (REFERENCE[year], PAPER[year]):
        assert float(accuracy) == pytest.approx(known[0], abs=0.01)
        assert float(size) == pytest.approx(known[1], abs=0.01)
