"""Calibrations of surface models in metres, from heights made up with a known error."""

import json
import re

import numpy as np
import pytest
import yaml
from helpers import invoke
from rasterio.transform import Affine
from surfaces import PLACE, write_raster, write_surface

from sat_intervals import SatIntervalsError
from sat_intervals.config import load_height_calibration
from sat_intervals.evaluate.surface_calibration import calibrate_surface

pytestmark = pytest.mark.usefixtures("thinned")

TAGS = {"INTERVAL": "quantiles", "RADIUS": "1 m", "COVERAGE": "0.9", "RUNS": "2026"}
TAGS |= {"HEIGHTS": "above the WGS 84 ellipsoid"}


def scene(folder, seed=0, rows=120, columns=150, scale=1.0):
    """A surface whose narrow intervals miss often and whose wide ones never do, and its reference."""
    random = np.random.default_rng(seed)
    truth = 100 + np.cumsum(random.normal(0, 0.1, (rows, columns)), axis=1)
    is_wide = random.random(truth.shape) < 0.3
    half = np.where(is_wide, 20, 0.5)
    height = truth + np.where(is_wide, random.normal(0, 3, truth.shape), random.normal(0, scale, truth.shape))
    model = write_surface(folder / "dsm.tif", height, height - half, height + half, TAGS)
    return model, write_raster(folder / "reference.tif", [truth])


def margins_of(calibration):
    return np.array([kind.margin for kind in calibration.classes])


def test_calibrate_surface__widens_narrow_intervals_and_narrows_wide_ones(tmp_path):
    found = calibrate_surface(*scene(tmp_path), "mine", registers=False)
    assert found.coverage == 0.9
    assert found.surface == {
        "CELL": "1 m", "PAIRS": "1", "INTERVAL": "quantiles", "RADIUS": "1 m", "COVERAGE": "0.9"
    }  # fmt: skip
    assert [kind.half_width_below for kind in found.classes] == [0.505, None] * 4
    for narrow, wide in zip(found.classes[::2], found.classes[1::2], strict=True):
        assert narrow.margin == pytest.approx(1.645 - 0.5, abs=0.25)
        assert wide.margin == pytest.approx(3 * 1.645 - 20, abs=2.5)
    assert sum(kind.cells for kind in found.classes) == 120 * 150
    before, expected = found.provenance["before"], found.provenance["expected"]
    assert before["coverage"] < 0.6
    assert expected["coverage"] == pytest.approx(0.9, abs=0.01)
    assert expected["lowest"] > 0.85
    assert expected["mean_half_width"] < 0.5 * before["mean_half_width"]


def test_calibrate_surface__covers_rough_ground_as_often_as_smooth(tmp_path):
    # Intervals are alike, errors of a rough half are larger, and so is the range of its heights.
    random = np.random.default_rng(0)
    truth = np.full((120, 160), 100.0)
    truth[:, 80:] += random.normal(0, 2, (120, 80))
    height = truth + random.normal(0, 0.3, truth.shape) * np.repeat([1, 4], 80)
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    reference = write_raster(tmp_path / "reference.tif", [truth])
    found = calibrate_surface(model, reference, "x", registers=False)
    smooth, *_, rough = found.classes
    assert smooth.relief_below < 3
    assert (smooth.margin, rough.margin) == (pytest.approx(0.49 - 1, abs=0.05), pytest.approx(1.97 - 1, abs=0.15))


def test_calibrate_surface__other_coverages(tmp_path):
    files = scene(tmp_path)
    margins = [
        margins_of(calibrate_surface(*files, "x", coverage=level, registers=False)) for level in (0.5, 0.8, 0.95)
    ]
    np.testing.assert_allclose([found[::2].mean() for found in margins], np.array([0.674, 1.282, 1.96]) - 0.5, atol=0.1)


def test_calibrate_surface__blocks_that_differ_show_in_the_lowest_coverage(tmp_path):
    # A sixteenth of the ground errs five times as much as the rest.
    random = np.random.default_rng(0)
    truth = np.full((160, 160), 100.0)
    error = random.normal(0, 1, truth.shape)
    error[:40, :40] *= 5
    model = write_surface(tmp_path / "dsm.tif", truth + error, truth + error - 1, truth + error + 1, TAGS)
    found = calibrate_surface(model, write_raster(tmp_path / "reference.tif", [truth]), "x", registers=False)
    assert found.provenance["expected"]["lowest"] < 0.4
    assert found.provenance["expected"]["coverage"] > 0.85


def test_calibrate_surface__cells_count_not_heights_of_a_finer_reference(tmp_path):
    random = np.random.default_rng(0)
    height = 100 + random.normal(0, 1, (9, 10))
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    fine = write_raster(tmp_path / "fine.tif", [np.full((36, 40), 100.0)], Affine(0.25, 0, PLACE.c, 0, -0.25, PLACE.f))
    with pytest.raises(SatIntervalsError, match=r"90 cells of .* 100 are needed for coverage 0.98: give a larger"):
        calibrate_surface(model, fine, "x", coverage=0.98, registers=False)
    found = calibrate_surface(model, fine, "x", coverage=0.8, registers=False)  # one factor: 90 < 4 x 50
    assert [kind.cells for kind in found.classes] == [90]
    assert found.provenance["expected"] is not None


def test_calibrate_surface__of_a_sample_is_that_of_all_cells(tmp_path, monkeypatch):
    files = scene(tmp_path)
    whole = calibrate_surface(*files, "x", registers=False)
    monkeypatch.setattr("sat_intervals.evaluate.surface_calibration._MOST", 6000)
    part = calibrate_surface(*files, "x", registers=False)
    assert 3000 < sum(kind.cells for kind in part.classes) <= 6000
    np.testing.assert_allclose(margins_of(part), margins_of(whole), atol=1)


def test_calibrate_surface__moves_the_reference_unless_told_not_to(tmp_path):
    random = np.random.default_rng(3)
    row, column = np.indices((150, 160)).astype(np.float64)
    truth = 500 + 8 * np.sin(0.1 * column + 0.03 * row) + 5 * np.cos(0.08 * row - 0.02 * column)
    height = truth + 5 + random.normal(0, 0.3, truth.shape)
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    reference = write_raster(tmp_path / "reference.tif", [truth])
    moved = calibrate_surface(model, reference, "x")
    assert moved.registered
    assert moved.provenance["shift"][2] == pytest.approx(5, abs=0.1)
    assert margins_of(moved).max() < 0
    still = calibrate_surface(model, reference, "x", registers=False)
    assert not still.registered
    assert still.provenance["shift"] is None
    assert margins_of(still) == pytest.approx(4.4, abs=0.2)


def test_calibrate_surface__cells_in_one_pixel_of_a_coarser_reference_count_as_one(tmp_path):
    random = np.random.default_rng(0)
    height = 100 + random.normal(0, 1, (120, 150))
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    coarse = [write_raster(tmp_path / f"{n}.tif", [np.full((n, n), 100.0)], PLACE @ Affine.scale(side))
              for n, side in ((10, 30), (50, 10))]  # fmt: skip
    with pytest.raises(SatIntervalsError, match=r"20 cells of .* \(those in a pixel of 30 m count as one\), 30 are"):
        calibrate_surface(model, coarse[0], "x", registers=False)
    assert [kind.cells for kind in calibrate_surface(model, coarse[1], "x", registers=False).classes] == [180]


def test_calibrate_surface__another_datum_is_a_warning_where_the_reference_is_moved(tmp_path):
    random = np.random.default_rng(3)
    truth = 100 + random.normal(0, 0.3, (60, 60))
    model = write_surface(tmp_path / "dsm.tif", truth, truth - 1, truth + 1, TAGS)
    geoid = write_raster(tmp_path / "geoid.tif", [np.full((60, 60), 52.5)])
    (warning,) = calibrate_surface(model, geoid, "x").provenance["warnings"]
    assert "differ by 47.5 m in the median" in warning
    with pytest.raises(SatIntervalsError, match=r"differ by 47.5 m .* leave out --no-register"):
        calibrate_surface(model, geoid, "x", registers=False)


def test_calibrate_command__says_that_the_reference_was_not_moved(tmp_path):
    height = np.full((60, 60), 100.0)
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    few = write_raster(tmp_path / "few.tif", [np.full((6, 6), 100.0)])
    words = "calibrate", "--dsm", model, "--reference", few, "--coverage", 0.5, "--output", tmp_path / "few.yaml"
    result = invoke(*words)
    assert "the reference was not moved: too few common heights" in result.stderr
    assert not load_height_calibration(tmp_path / "few.yaml").registered
    assert "not moved" not in invoke(*words, "--no-register").stderr


def test_calibrate_command__writes_a_file_that_says_what_to_expect(tmp_path):
    model, reference = scene(tmp_path)
    words = "calibrate", "--dsm", model, "--reference", reference, "--no-register", "--output"
    result = invoke(*words, tmp_path / "heights.yaml", "--name", "city")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.splitlines()[-1] == str(tmp_path / "heights.yaml")
    assert "calibrated on the other blocks" in result.stdout
    loaded = load_height_calibration(tmp_path / "heights.yaml")
    assert loaded == calibrate_surface(model, reference, "city", registers=False)
    as_json = invoke(*words, tmp_path / "heights.yaml", "--coverage", 0.5, "--json", "--overwrite")
    assert json.loads(as_json.stdout)["coverage"] == 0.5
    before = (tmp_path / "heights.yaml").read_bytes()
    assert invoke(*words, tmp_path / "heights.yaml", "--coverage", 0.5, "--quiet", "--overwrite").stdout == ""
    assert (tmp_path / "heights.yaml").read_bytes() == before


def test_calibrate_command__a_surface_that_it_cannot_use_is_one_line(tmp_path):
    model, reference = scene(tmp_path, rows=40, columns=50)
    height = np.full((40, 50), 100.0)
    flat = write_raster(tmp_path / "flat.tif", [height])

    def surface(name, tags, half=1.0):
        return write_surface(tmp_path / name, height, height - half, height + half, tags)

    calibrated = surface("calibrated.tif", TAGS | {"CALIBRATION": "x"})
    cut = surface("cut.tif", TAGS | {"MAX_WIDTH": "5 m"})
    complete = surface("complete.tif", TAGS | {"FILLED": "voids up to 20 m from their rims"})
    alpha = surface("alpha.tif", {"ALPHA": "0.9"})
    no_bounds = surface("heights.tif", TAGS, np.nan)
    away = write_raster(tmp_path / "away.tif", [height], Affine(1, 0, 5, 0, -1, 5))
    (tmp_path / "mine.yaml").write_text("mine: 1\n")
    given = ["--dsm", model, "--reference", reference]
    for words, message in (
        ([], "give PAIRS, or --dsm and --reference"),
        ([tmp_path, *given], "calibrate one of them at a time"),
        ([tmp_path, "--no-register"], "--no-register goes with --dsm"),
        ([*given, "--tolerance", 1], "--tolerance applies to pairs, not to --dsm"),
        ([*given, "--preset", "satellite"], "--preset applies to pairs, not to --dsm"),
        ([*given, "--set", "tiles.overlap=100"], "--set applies to pairs, not to --dsm"),
        ([*given, "--coverage", 2], "coverage is 2, allowed: 0.5 to 0.99"),
        ([*given, "--coverage", 0.99, "--output", reference], "would be written: choose another output"),
        ([*given, "--output", tmp_path / "mine.yaml"], "mine.yaml exists: choose another name or --overwrite"),
        ([*given, "--output", tmp_path / "no" / "x.yaml"], "give --output a file in an existing folder"),
        (["--dsm", calibrated, "--reference", flat], "was made with --calibration: make it without"),
        (["--dsm", cut, "--reference", flat], "was made with --max-width: make it without"),
        (["--dsm", complete, "--reference", flat], "was made with --fill: make it without"),
        (["--dsm", alpha, "--reference", flat], "its runs were matched without one: give --coverage"),
        (["--dsm", no_bounds, "--reference", flat], "0 cells of"),
        (["--dsm", model, "--reference", away], "give a reference of the same place"),
    ):
        output = [] if "--output" in words else ["--output", tmp_path / "heights.yaml"]
        result = invoke("calibrate", *words, *output)
        assert result.exit_code == 2, (words, result.output)
        assert message in result.stderr, (message, result.stderr)
        assert result.stderr.count("\n") == 1
        assert not (tmp_path / "heights.yaml").exists()


def test_load_height_calibration__what_it_cannot_use_is_one_line(tmp_path):
    file = tmp_path / "heights.yaml"
    model, reference = scene(tmp_path, rows=40, columns=50)
    given = calibrate_surface(model, reference, "x", registers=False).model_dump(mode="json")
    rows = given["classes"]
    for content, message in (
        ({"name": "x", "key": {}, "levels": []}, "is a calibration of disparities: give it to match"),
        ({"preset": "satellite"}, "has settings, not a calibration"),
        ({}, "name: field required"),
        (given | {"classes": rows[:-1]}, "half_width_below is to be null in the last class"),
        (given | {"classes": [*rows, rows[0] | {"half_width_below": None}]}, "relief_below is to be null in the last"),
        (given | {"classes": [rows[1], *rows]}, "half_width_below is to be null in the last class"),
        (given | {"classes": [rows[0], *rows]}, "half_width_below falls from 0.505 to 0.505"),
        ({key: given[key] for key in given if key != "version"}, "is of an earlier version, with margins by width"),
        (given | {"classes": [rows[-1] | {"margin": "1 m"}]}, "classes.0.margin: input should be a valid number"),
        (given | {"coverage": 1.0}, "coverage: input should be less than 1"),
        ([1], "holds [1], allowed: keys version, name, coverage"),
    ):
        file.write_text(yaml.safe_dump(content))
        with pytest.raises(SatIntervalsError) as error:
            load_height_calibration(file)
        assert re.search(f"{file}.*{re.escape(message)}", str(error.value))  # on one line
    file.write_text(yaml.safe_dump(given | {"surface": given["surface"] | {"INTERVAL": "envelope"}}))
    with pytest.raises(
        SatIntervalsError, match=r"other surfaces, INTERVAL is envelope in the calibration and quantiles in the surface"
    ):
        load_height_calibration(file).check_surface(given["surface"])
    assert invoke("match", "a", "b", tmp_path, "--coverage", 0.9, "--calibration", file).stderr.count(
        "is a calibration of heights: give it to dsm --calibration"
    )
