"""Surface models against reference heights."""

import json

import numpy as np
import pytest
import rasterio
from helpers import invoke
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.transform import Affine
from surfaces import PLACE, write_raster, write_surface

from sat_intervals import SatIntervalsError
from sat_intervals.evaluate.surface_accuracy import evaluate_surface
from sat_intervals.match.histogram import Histogram

pytestmark = pytest.mark.usefixtures("thinned")


def test_evaluate_surface__worked_example(tmp_path):
    # Reference: 10 in the first columns, then up 1 m a cell: slope 0 at the first cell, atan(1/2) = 26.6 degrees at the
    # second (half of the way from 10 to 11 on either side), 45 at the third, 26.6 at the last, where the edge goes on.
    # Errors height - reference, in order: -1 .5 2 4, median (bias) 1.25; distances from it .75 .75 2.25 2.75, the lower
    # of the two in the middle .75; NMAD 1.4826 x .75. Inside: 10 in [9, 11], 11 in [10, 14]; not 10 in [8, 9.5], 12 in
    # [15, 17]: .5. Widths 2 1.5 4 2, median 2.
    reference = np.array([[10.0, 10, 11, 12]])
    height, lower, upper = [[10.5, 9, 13, 16]], [[9, 8, 10, 15]], [[11, 9.5, 14, 17]]
    report = evaluate_surface(
        write_surface(tmp_path / "dsm.tif", height, lower, upper),
        write_raster(tmp_path / "reference.tif", [reference]),
        registers=False,
    )
    everything = report["all"]
    assert (everything["count"], everything["coverage"], everything["median_half_width"]) == (4, 0.5, 1.0)
    assert (everything["bias"], everything["median"]) == (pytest.approx(1.375), pytest.approx(1.25))
    assert everything["nmad"] == pytest.approx(1.4826 * 0.75)
    assert {kind["from"]: kind["count"] for kind in report["slope"]} == {0: 1, 5: 0, 15: 2, 30: 0, 45: 1}
    assert {kind["from"]: kind["count"] for kind in report["half_width"]} == {0: 0, 0.5: 1, 1: 3, 2.5: 0, 5: 0, 10: 0}
    assert {key: report["half_width"][1][key] for key in ("from", "to", "count", "coverage", "median", "le90")} == {
        "from": 0.5, "to": 1.0, "count": 1, "coverage": 0.0, "median": -1.0, "le90": 1.0
    }  # fmt: skip
    # Squares 1 .25 4 16; of .5 1 2 4 the rank 2.7 for LE90; of -1 .5 2 4 the ranks .15 and 2.85. Missed by 0.5 and
    # 3 m; with a nominal coverage of .9 each counts twenty times: (9.5 + 20 x 3.5) / 4.
    assert everything["rmse"] == pytest.approx(np.sqrt(21.25 / 4))
    assert everything["le90"] == pytest.approx(3.4)
    assert everything["p95_p5"] == pytest.approx(3.7 - -0.775)
    assert everything["mean_half_width"] == pytest.approx(9.5 / 8)
    assert everything["interval_score"] is None
    with rasterio.open(tmp_path / "dsm.tif", "r+") as dataset:
        dataset.update_tags(COVERAGE="0.9")
    scored = evaluate_surface(tmp_path / "dsm.tif", tmp_path / "reference.tif", registers=False)
    assert (scored["nominal"], scored["nominal_is"], scored["warnings"]) == (0.9, "coverage", [])
    assert scored["all"]["interval_score"] == pytest.approx((9.5 + 20 * 3.5) / 4)
    assert scored["all"]["needed_half_width"] == everything["le90"]


def test_evaluate_surface__completeness_counts_reference_heights_without_a_height(tmp_path):
    # Ten reference heights: two without a height, one of them on the slope; errors of .4 three times, of 3 twice.
    reference = np.array([[5.0, 5, 5, 5, 5, 5, 5, 5, 7, 9]])
    height = np.array([[np.nan, 5.4, 5.4, 5.4, 8, 8, 5, 5, 7, np.nan]])
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1)
    truth = write_raster(tmp_path / "reference.tif", [reference])
    classes = write_raster(tmp_path / "classes.tif", [np.array([[7.0, 7, 1, 1, 1, 1, 1, 1, 1, 1]])])
    report = evaluate_surface(model, truth, classes, registers=False)
    assert (report["all"]["completeness"], report["all"]["within"]) == (0.8, 0.6)
    flat, *_, steep = (kind for kind in report["slope"] if kind["count"])
    assert (flat["completeness"], flat["within"]) == (pytest.approx(6 / 7), pytest.approx(4 / 7))
    assert steep["completeness"] == pytest.approx(2 / 3)
    assert [kind["completeness"] for kind in report["classes"]] == [7 / 8, 1 / 2]
    assert all(kind["completeness"] is None for kind in report["half_width"])
    assert evaluate_surface(model, truth, registers=False, within=0.1)["all"]["within"] == pytest.approx(0.3)


def test_evaluate_surface__standard_error_of_the_coverage_is_that_between_blocks(tmp_path):
    # Of 16 blocks of 100 cells 8 are inside and 8 outside: as uncertain as 16 coins, not as 1600.
    height = np.kron(np.indices((4, 4)).sum(axis=0) % 2, np.ones((10, 10))) * 9.0
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1)
    report = evaluate_surface(model, write_raster(tmp_path / "reference.tif", [0 * height]), registers=False)["all"]
    assert (report["coverage"], report["coverage_deviation"]) == (0.5, pytest.approx(0.5 / np.sqrt(15)))


def test_evaluate_surface__ranking_is_the_area_between_sparsification_curves(tmp_path):
    # Errors 4 3 2 1; half widths rank them as 3 4 1 2 do, relief, over all cells, is the same everywhere.
    reference, error = np.zeros((1, 4)), np.array([[4.0, 3, 2, 1]])
    half = np.array([[3.0, 4, 1, 2]])
    model = write_surface(tmp_path / "dsm.tif", error, error - half, error + half)
    truth = write_raster(tmp_path / "reference.tif", [reference])
    # Means of the 1, 2, 3 and 4 smallest, over 2.5: by errors .4 .6 .8 1, by widths .8 .6 28/30 1; trapezoids of 1/4.
    best, by_width = 0.25 * (0.4 + 0.5 + 0.7 + 0.9), 0.25 * (0.8 + 0.7 + 23 / 30 + 29 / 30)
    ranking = evaluate_surface(model, truth, registers=False)["ranking"]
    assert ranking["half_width"] == pytest.approx(by_width - best)
    perfect = write_surface(tmp_path / "best.tif", error, error - error, error + error)
    assert evaluate_surface(perfect, truth, registers=False)["ranking"]["half_width"] == pytest.approx(0)


def test_evaluate_surface__a_reference_of_this_tool_is_no_truth(tmp_path):
    height = np.array([[1.0, 2]])
    model, other = (
        write_surface(tmp_path / name, height, height - 1, height + 1, {"RUNS": "2026"}) for name in ("a.tif", "b.tif")
    )
    (line,) = evaluate_surface(model, other, registers=False)["warnings"]
    assert f"{other} is a surface of this tool, too: errors that both share do not show" in line
    assert "sat-intervals change" in line


def test_evaluate_surface__warns_of_a_surface_that_is_upside_down(tmp_path):
    height = np.arange(20.0)[np.newaxis]
    surface = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1)
    with rasterio.open(surface, "r+") as dataset:
        dataset.update_tags(COVERAGE="0.9")
    (line,) = evaluate_surface(surface, write_raster(tmp_path / "a.tif", [19 - height]), registers=False)["warnings"]
    assert line.startswith("the intervals contain 10 % of the reference heights, where 90 % are expected: check")
    assert not evaluate_surface(surface, write_raster(tmp_path / "b.tif", [height]), registers=False)["warnings"]


def test_evaluate_surface__needs_a_ground_where_the_surface_has_a_height(tmp_path):
    nan, reference = np.nan, write_raster(tmp_path / "reference.tif", [[[1.0, -9999, 2]]])
    known = write_surface(tmp_path / "known.tif", [[1.0, nan, 2]], [[0.0, nan, 1]], [[2.0, nan, 3]])
    assert evaluate_surface(known, reference, registers=False)["all"]["count"] == 2
    whole = write_surface(tmp_path / "whole.tif", [[1.0, 1, 2]], [[0.0, 0, 1]], [[2.0, 2, 3]])
    with pytest.raises(SatIntervalsError, match=r"reference\.tif has heights such as -9999 m, which no ground has"):
        evaluate_surface(whole, reference, registers=False)


def relief(row, column):
    return 500 + 8 * np.sin(0.1 * column + 0.03 * row) + 5 * np.cos(0.08 * row - 0.02 * column)


def test_evaluate_surface__registers_on_relief_and_says_what_it_moved(tmp_path):
    row, column = np.indices((150, 160)).astype(np.float64)
    truth = relief(row, column)
    model = write_surface(tmp_path / "dsm.tif", truth, truth - 0.5, truth + 0.5)
    # the reference is 3 m too far west, 2 m too far north and 5 m too low; half as coarse
    fine = np.indices((420, 440)) / 2 - 30 + 0.5 / 2 - 0.5
    heights = relief(fine[0] - -2, fine[1] + 3) - 5
    place = Affine(0.5, 0, PLACE.c - 30, 0, -0.5, PLACE.f + 30)
    reference = write_raster(tmp_path / "reference.tif", [heights], place)
    report = evaluate_surface(model, reference)
    found = report["registration"]
    assert found["is_horizontal"]
    np.testing.assert_allclose(found["shift"], (3, -2, 5), atol=0.1)
    assert report["before"]["median"] == pytest.approx(5, abs=0.3)
    assert report["before"]["coverage"] < 0.05
    assert report["all"]["le90"] < 0.4  # four heights a cell, on slopes of 40 degrees
    assert report["all"]["coverage"] > 0.95
    alone = evaluate_surface(model, reference, registers=False)
    assert alone["registration"] is None
    assert alone["all"] == alone["before"] == report["before"]


def test_evaluate_command__warns_of_another_datum(tmp_path):
    row, column = np.indices((90, 100)).astype(np.float64)
    truth = relief(row, column)
    model = write_surface(tmp_path / "dsm.tif", truth, truth - 0.5, truth + 0.5)
    for away, words in ((31.0, "differ by -31.0 m in the median, as heights above a geoid and"), (-4.0, "")):
        result = invoke("evaluate", "--dsm", model, "--reference", write_raster(tmp_path / "r.tif", [truth + away]))
        assert result.exit_code == 0
        assert ("above a geoid" in result.stdout) == bool(words)
        assert words in result.stdout


def test_evaluate_surface__registers_a_reference_of_a_small_part_of_the_surface(tmp_path, monkeypatch):
    # Of the blocks of 16 cells every third was tried, and none of them is in the reference.
    monkeypatch.setattr("sat_intervals.kernels.registration._LARGEST", 16)
    row, column = np.indices((320, 320)).astype(np.float64)
    truth = relief(row, column)
    model = write_surface(tmp_path / "dsm.tif", truth, truth - 0.5, truth + 0.5)
    reference = write_raster(tmp_path / "part.tif", [truth[16:48, 16:48] - 5], PLACE @ Affine.translation(16, 16))
    assert evaluate_surface(model, reference)["registration"]["shift"][2] == pytest.approx(5, abs=0.1)


def test_evaluate_surface__by_classes_of_a_raster(tmp_path):
    model = write_surface(tmp_path / "dsm.tif", [[1.0, 2, 3, 4]], [[0.0] * 4], [[9.0] * 4])
    reference = write_raster(tmp_path / "reference.tif", [[[1.0, 1, 1, 1]]])
    classes = write_raster(tmp_path / "classes.tif", [[[7.0, 7, 2, np.nan]]])
    report = evaluate_surface(model, reference, classes, registers=False)
    assert [(kind["class"], kind["count"], kind["bias"]) for kind in report["classes"]] == [(2, 1, 2.0), (7, 2, 0.5)]
    with pytest.raises(SatIntervalsError, match=r"heights.tif has values such as 1.5.*give a raster of classes"):
        evaluate_surface(model, reference, write_raster(tmp_path / "heights.tif", [[[1.5] * 4]]), registers=False)


@pytest.mark.peer("xdem")
def test_evaluate_surface__has_the_nmad_and_both_le90_of_peers(tmp_path):
    import geoutils
    import xdem

    random = np.random.default_rng(5)
    truth = random.normal(500, 20, (300, 400))
    height = truth + random.standard_t(3, truth.shape) * 0.7 + 0.3
    height[random.random(height.shape) < 0.2] = np.nan
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1)
    ours = evaluate_surface(model, write_raster(tmp_path / "reference.tif", [truth]), registers=False)["all"]
    alone = xdem.DEM(str(write_raster(tmp_path / "alone.tif", [height])))
    difference = alone - xdem.DEM(str(tmp_path / "reference.tif"))
    values = difference.data.compressed()
    assert ours["count"] == values.size
    assert ours["nmad"] == pytest.approx(float(geoutils.stats.nmad(values)), abs=2e-3)
    assert ours["p95_p5"] == pytest.approx(float(geoutils.stats.estimators.linear_error(values)), abs=2e-3)
    assert ours["le90"] == pytest.approx(float(np.percentile(np.abs(values), 90)), abs=2e-3)
    assert ours["rmse"] == pytest.approx(float(np.sqrt(np.mean(np.square(values, dtype=np.float64)))), rel=1e-4)


def test_evaluate_surface__half_a_cell_of_shift_averages_no_noise_away(tmp_path):
    random = np.random.default_rng(4)
    row, column = np.indices((150, 160)).astype(np.float64)
    truth, moved = (
        heights + 0.5 * random.normal(size=row.shape)
        for heights in (relief(row, column), relief(row + 2.5, column + 2.5))
    )
    model = write_surface(tmp_path / "dsm.tif", truth, truth - 0.5, truth + 0.5)
    found = evaluate_surface(model, write_raster(tmp_path / "reference.tif", [moved]))
    np.testing.assert_allclose(found["registration"]["shift"][:2], (2.5, -2.5), atol=0.1)
    assert found["all"]["nmad"] == pytest.approx(0.5 * np.sqrt(2), rel=0.05)


@pytest.mark.peer("xdem")
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_evaluate_surface__moves_the_reference_as_xdem_does(tmp_path, noise):
    import xdem

    random = np.random.default_rng(4)
    row, column = np.indices((150, 160)).astype(np.float64)
    truth = relief(row, column)
    truth = truth + noise * random.normal(size=truth.shape)
    model = write_surface(tmp_path / "dsm.tif", truth, truth - 0.5, truth + 0.5)
    moved = relief(row + 2, column + 3) - 5
    reference = write_raster(tmp_path / "reference.tif", [moved + noise * random.normal(size=moved.shape)])
    ours = evaluate_surface(model, reference)["registration"]
    fit = xdem.coreg.NuthKaab().fit(
        xdem.DEM(str(write_raster(tmp_path / "alone.tif", [truth]))), xdem.DEM(str(reference))
    )
    theirs = [fit.meta["outputs"]["affine"][name] for name in ("shift_x", "shift_y", "shift_z")]
    np.testing.assert_allclose(ours["shift"], theirs, atol=0.1)
    assert (np.abs(np.subtract(ours["shift"], (3, -2, 5))) <= 3 * np.array(ours["deviation"])).all()


def test_evaluate_surface__reference_of_another_grid_and_strips(tmp_path, monkeypatch):
    random = np.random.default_rng(0)
    height = random.normal(50, 3, (23, 31))
    height[random.random(height.shape) < 0.1] = np.nan
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 2)
    # Twice as fine and one metre further out: each of the four heights in a cell is judged by the cell's interval.
    fine = random.normal(50, 3, (50, 66))
    place = Affine(0.5, 0, PLACE.c - 1, 0, -0.5, PLACE.f + 1)
    reference = write_raster(tmp_path / "reference.tif", [fine], place)
    truth, height = fine[2:-2, 2:-2].astype(np.float32), np.repeat(np.repeat(height, 2, axis=0), 2, axis=1)
    known = np.isfinite(height)
    whole = evaluate_surface(model, reference, registers=False)
    assert whole["all"]["count"] == known.sum()
    inside = ((height - 1 <= truth) & (truth <= height + 2))[known]
    assert whole["all"]["coverage"] == pytest.approx(inside.mean(), abs=2e-3)
    assert whole["all"]["median"] == pytest.approx(np.median((height - truth)[known]), abs=0.01)
    monkeypatch.setattr("sat_intervals.evaluate.comparison._TILE", 14**2)
    assert evaluate_surface(model, reference, registers=False) == whole


def test_evaluate_surface__slope_is_that_of_the_references_own_grid(tmp_path):
    # A plane that rises 0.1 a metre, 5.7 degrees, known every 8 m, under cells of 1 m.
    coarse = 0.1 * 8 * np.broadcast_to(np.arange(12.0), (10, 12))
    height = np.broadcast_to(0.1 * (np.arange(96.0) - 3.5), (80, 96))
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1)
    place = Affine(8, 0, PLACE.c, 0, -8, PLACE.f)
    report = evaluate_surface(model, write_raster(tmp_path / "reference.tif", [coarse], place), registers=False)
    counts = [kind["count"] for kind in report["slope"]]
    assert counts[0] == 10 * 80  # beside the reference's outermost centres, where it is flat
    assert counts[1] == 86 * 80
    assert counts[2:] == [0, 0, 0]


def test_evaluate_surface__takes_scale_and_offset_of_the_reference(tmp_path):
    model = write_surface(tmp_path / "dsm.tif", [[100.5, 101]], [[100.0, 100]], [[102.0, 102]])
    reference = write_raster(tmp_path / "reference.tif", [[[15.0, 10]]])
    with rasterio.open(reference, "r+") as dataset:
        dataset.scales, dataset.offsets = (0.1,), (100.0,)
    report = evaluate_surface(model, reference, registers=False)["all"]
    assert (report["count"], report["coverage"], report["bias"]) == (2, 1.0, pytest.approx(-0.5, abs=0.51))


@settings(deadline=None)
@given(st.lists(st.integers(-900, 900), min_size=1, max_size=40))
def test_histogram__deviation_is_the_median_distance_from_the_median(values):
    values = np.array(values) / 100
    histogram = Histogram(-10, 10, 100)
    histogram.add(values)
    distances = np.sort(np.abs(values - np.median(values)))
    assert histogram.deviation() == pytest.approx(distances[(values.size - 1) // 2], abs=1e-9)


def test_evaluate_command__of_a_surface(tmp_path):
    model = write_surface(tmp_path / "dsm.tif", [[1.0, 2]], [[0.0, 1]], [[2.0, 3]])
    reference = write_raster(tmp_path / "reference.tif", [[[1.5, 9]]])
    result = invoke("evaluate", "--dsm", model, "--reference", reference)
    assert result.exit_code == 0
    assert result.stdout.splitlines()[2].split() == [
        "all", "cells", "2", "-3.750", "-3.750", "4.818", "4.962", "6.350", "5.850", "0.500", "0.500", "1.000", "1.000",
        "-", "1.000", "0.500"
    ]  # fmt: skip
    assert result.stdout.splitlines()[-1] == "the reference was not moved: too few common heights"
    alone = invoke("evaluate", "--dsm", model, "--reference", reference, "--no-register")
    assert "not moved" not in alone.stdout
    figures = json.loads(invoke("evaluate", "--dsm", model, "--reference", reference, "--json").stdout)
    assert (figures["all"]["count"], figures["nominal"], figures["nominal_is"]) == (2, None, None)
    assert "coverage asked for: unknown, so no interval scores" in result.stdout.splitlines()
    with rasterio.open(model, "r+") as dataset:
        dataset.update_tags(ALPHA="0.9")
    assert "alpha: 0.9; interval score: width" in invoke("evaluate", "--dsm", model, "--reference", reference).stdout


@pytest.mark.peer("matplotlib")
def test_evaluate_command__writes_figures_and_pictures(tmp_path):
    row, column = np.indices((60, 70)).astype(np.float64)
    truth = relief(row, column)
    model = write_surface(tmp_path / "dsm.tif", truth + 0.1, truth - 0.5, truth + 0.5)
    words = "evaluate", "--dsm", model, "--reference", write_raster(tmp_path / "reference.tif", [truth])
    folder = tmp_path / "new" / "pictures"
    result = invoke(*words, "--pictures", folder, "--no-register")
    assert result.exit_code == 0, result.output
    written = [folder / f"dsm-{name}" for name in ("accuracy.json", "accuracy.md", "reliability.png", "errors.png",
                                                     "profile.png")]  # fmt: skip
    assert result.stdout.splitlines()[-5:] == [str(path) for path in written]
    assert json.loads(written[0].read_text())["all"]["median"] == pytest.approx(0.1)
    assert "| all cells | 4200 | 0.100 |" in written[1].read_text()
    assert all(path.stat().st_size > 5000 for path in written[2:])
    refused = invoke(*words, "--pictures", folder)
    assert (refused.exit_code, refused.stdout) == (2, "")
    assert f"{written[0]} exists: choose another name or --overwrite" in refused.stderr
    again = invoke(*words, "--pictures", folder, "--quiet", "--overwrite")
    assert again.exit_code == 0
    assert "all cells" in again.stdout
    assert "dsm-accuracy" not in again.stdout
    assert "dsm.tif is not a folder: choose another name" in invoke(*words, "--pictures", model).stderr
    for line, message in (((0, 0, 1, 1), "does not cross"), ((PLACE.c, PLACE.f, PLACE.c + 70, PLACE.f - 60), "")):
        result = invoke(*words, "--pictures", tmp_path, "--overwrite", "--line", *line)
        assert result.exit_code == (2 if message else 0)
        assert message in result.stderr


def test_evaluate_command__what_it_cannot_use_gets_one_line(tmp_path):
    model = write_surface(tmp_path / "dsm.tif", [[1.0, 2]], [[0.0, 1]], [[2.0, 3]])
    away = write_raster(tmp_path / "away.tif", [[[1.5, 9]]], Affine(1, 0, 5, 0, -1, 5))
    feet = write_raster(tmp_path / "feet.tif", [[[3000.0, 3003]]])
    nowhere = write_raster(tmp_path / "nowhere.tif", [[[1.5, 9]]], crs=None)
    for words, message in (
        ([], "Missing argument 'OUT...'"),
        (["--dsm", model], "--dsm and --reference go together"),
        ([tmp_path, "--dsm", model, "--reference", away], "evaluate one of them at a time"),
        (["--dsm", tmp_path / "none.tif", "--reference", away], "none.tif"),
        (["--dsm", model, "--reference", away], "give a reference of the same place"),
        (["--dsm", model, "--reference", nowhere], "has no CRS or is not north up"),
        (["--dsm", feet, "--reference", model], "is not a surface model of sat-intervals dsm: give one"),
        (["--dsm", model, "--reference", feet], "differ by 500 m or more in the median: check that both are metres"),
        (["--dsm", model, "--reference", feet, "--tolerance", "5"], "--tolerance applies to runs and pairs, not to"),
    ):
        result = invoke("evaluate", *words)
        assert result.exit_code == 2, result.output
        assert message in result.stderr
        assert result.stderr.count("\n") == 1
