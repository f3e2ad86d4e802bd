"""Surface models against points: few, noisy, in tables as others write them."""

import numpy as np
import pytest
from helpers import invoke
from surfaces import PLACE, write_raster, write_surface

from sat_intervals import SatIntervalsError
from sat_intervals.config import load_height_calibration
from sat_intervals.evaluate.surface_accuracy import evaluate_surface
from sat_intervals.evaluate.surface_calibration import calibrate_surface

pytestmark = pytest.mark.peer("pyarrow", "pyogrio", "shapely")
TAGS = {"INTERVAL": "quantiles", "RADIUS": "1 m", "COVERAGE": "0.9", "RUNS": "2026"}
TAGS |= {"HEIGHTS": "above the WGS 84 ellipsoid"}


def write_points(path, column, row, height, **more):
    """A CSV file of points at the columns and rows of a surface of cells of 1 m; it has no CRS."""
    table = np.column_stack([PLACE.c + np.asarray(column), PLACE.f - np.asarray(row), height, *more.values()])
    header = ",".join(["x", "y", "height", *more])
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.6f")
    return path


def scene(folder, count, sigma, scale=1.0):
    """A surface with errors of a long tail beside half widths of 1 m, and noisy points on it; all true heights, too."""
    random = np.random.default_rng(5)
    truth = 100 + np.cumsum(random.normal(0, 0.1, (200, 200)), axis=1)
    height = truth + scale * random.standard_t(3, truth.shape)
    model = write_surface(folder / "dsm.tif", height, height - 1, height + 1, TAGS)
    row, column = random.integers(0, 200, (2, count))
    noisy = truth[row, column] + random.normal(0, sigma, count)
    return model, write_points(folder / "points.csv", column + 0.5, row + 0.5, noisy), abs(height - truth)


def test_evaluate_surface__compares_points_with_the_cell_they_fall_in(tmp_path):
    height = np.array([[10.0, 20, np.nan], [30, 40, 50]])
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    points = write_points(tmp_path / "p.csv", [0.1, 1.9, 2.5, 1.5, 7], [0.9, 0.1, 0.5, 1.5, 0.5], [10.5, 22, 30, 40, 1])
    classes = write_raster(tmp_path / "classes.tif", [[[1.0, 2, 2], [1, 2, 2]]])
    report = evaluate_surface(model, points, classes, registers=False)
    everything = report["all"]
    assert (everything["count"], everything["bias"]) == (3, pytest.approx(-2.5 / 3))
    assert (everything["coverage"], everything["completeness"]) == (pytest.approx(2 / 3), 0.75)
    assert [(kind["class"], kind["count"], kind["completeness"]) for kind in report["classes"]] == [
        (1, 1, 1.0), (2, 2, pytest.approx(2 / 3))
    ]  # fmt: skip
    assert report["slope"] == []
    assert report["points"] == {"count": 4, "sigma": 0}


def test_evaluate_surface__coverage_is_that_of_the_heights_behind_noisy_points(tmp_path):
    model, points, errors = scene(tmp_path, 3000, 1.5)
    with_noise, without = (evaluate_surface(model, points, registers=False, reference_sigma=one) for one in (0.0, 1.5))
    assert with_noise["all"]["coverage"] < 0.5
    assert without["all"]["coverage"] == pytest.approx((errors <= 1).mean(), abs=0.04)
    assert 0.01 < without["all"]["coverage_deviation"] < 0.04
    assert without["all"]["interval_score"] is None


def test_evaluate_surface__a_column_counts_before_the_option(tmp_path):
    height = np.full((1, 40), 10.0)
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    noise = np.random.default_rng(0).normal(0, 2, 40)
    place = np.arange(40) + 0.5
    points = write_points(tmp_path / "p.csv", place, 0 * place + 0.5, 10 + noise, sigma=0 * noise + 2)
    report = evaluate_surface(model, points, registers=False, reference_sigma=0.1)
    assert report["points"]["sigma"] == 2
    assert report["all"]["coverage"] > 0.9


def test_evaluate_surface__counts_exact_points_beside_noisy_ones_of_other_tiles(tmp_path, monkeypatch):
    monkeypatch.setattr("sat_intervals.evaluate.comparison._TILE", 64)
    height = np.full((1, 256), 10.0)
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    place = np.arange(256) + 0.5
    sigma = np.where(place < 64, 0.5, 0)
    points = write_points(tmp_path / "p.csv", place, 0 * place + 0.5, np.where(place < 128, 10, 20), sigma=sigma)
    assert evaluate_surface(model, points, registers=False)["all"]["coverage"] == pytest.approx(0.5, abs=0.05)


def test_evaluate_surface__moves_points_to_the_surface(tmp_path):
    row, column = np.indices((150, 160)).astype(np.float64)
    random = np.random.default_rng(3)

    def truth(column, row):
        return 500 + 8 * np.sin(0.1 * column + 0.03 * row) + 5 * np.cos(0.08 * row - 0.02 * column)

    height = truth(column, row) + random.normal(0, 0.1, row.shape)
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    x, y = random.uniform(10, 140, (2, 4000))
    points = write_points(tmp_path / "p.csv", x + 2.5, y + 0.5, truth(x, y) - 5)
    found = evaluate_surface(model, points)["registration"]
    assert found["shift"] == [pytest.approx(-2, abs=0.2), pytest.approx(0, abs=0.2), pytest.approx(5, abs=0.1)]


def test_calibrate_surface__few_points_have_one_factor(tmp_path):
    model, points, errors = scene(tmp_path, 100, 0)
    found = calibrate_surface(model, points, "x", registers=False)
    assert [kind.cells for kind in found.classes] == [100]
    assert 0.84 < (errors <= found.factor).mean() < 0.96
    assert found.provenance["expected"]["coverage"] == pytest.approx(0.9, abs=0.06)


def test_calibrate_surface__margins_are_those_of_the_heights_behind_noisy_points(tmp_path):
    model, points, errors = scene(tmp_path, 400, 2.0)
    blind, found = (calibrate_surface(model, points, "x", registers=False, reference_sigma=one) for one in (None, 2.0))
    assert blind.classes[0].margin > 2.5
    assert (errors <= found.factor).mean() == pytest.approx(0.91, abs=0.04)
    assert found.provenance["points"] == {"count": 400, "sigma": 2.0}


def test_calibrate_command__says_how_many_points_a_precise_coverage_takes(tmp_path):
    model, points, _ = scene(tmp_path, 100, 1.0)
    words = "--dsm", model, "--reference", points, "--reference-sigma", 1, "--no-register"
    result = invoke("calibrate", *words, "--output", tmp_path / "heights.yaml")
    assert result.exit_code == 0, result.stderr
    factor = load_height_calibration(tmp_path / "heights.yaml").factor
    assert f"half widths are multiplied by {factor:g}, for coverage 0.9" in result.stdout
    assert "100 points give the coverage with a standard error of 0.0" in result.stdout
    result = invoke("evaluate", *words)
    assert "coverage is that of the true heights, other figures include errors of the points (standard" in result.stdout
    assert "one of 0.02 takes about" in result.stdout


def test_evaluate_command__points_that_it_cannot_use_get_one_line(tmp_path):
    height = np.full((5, 5), 10.0)
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    raster = write_raster(tmp_path / "reference.tif", [height])
    away = write_points(tmp_path / "away.csv", [50], [50], [1])
    negative = write_points(tmp_path / "negative.csv", [1], [1], [10], sigma=[-1])
    for words, message in (
        (["--reference", raster, "--reference-sigma", 1], "is a raster: a sigma of its heights is for points"),
        (["--reference", away], "no point of"),
        (["--reference", negative], "negative.csv is -1: give standard deviations in metres"),
        (["--reference", tmp_path / "none.csv"], "give a file of points"),
    ):
        result = invoke("evaluate", "--dsm", model, *words)
        assert (result.exit_code, result.stderr.count("\n")) == (2, 1), result.output
        assert message in result.stderr
    assert "--reference-sigma goes with --dsm" in invoke("evaluate", tmp_path, "--reference-sigma", 1).stderr


def test_evaluate_surface__refuses_points_above_a_geoid_beside_a_surface_above_the_ellipsoid(tmp_path):
    import shapely
    from pyogrio.raw import write

    height = np.full((5, 5), 10.0)
    geometry = shapely.to_wkb(shapely.points([[PLACE.c + 1, PLACE.f - 1, 10.0]]))
    field = [np.array([1.0])]
    write(tmp_path / "p.gpkg", geometry, field, ["id"], geometry_type="Point Z", crs="EPSG:32631+5773")
    model = write_surface(tmp_path / "dsm.tif", height, height - 1, height + 1, TAGS)
    with pytest.raises(SatIntervalsError, match="has heights of EGM96 height"):
        evaluate_surface(model, tmp_path / "p.gpkg", registers=False)
    model = write_surface(tmp_path / "geoid.tif", height, height - 1, height + 1, TAGS | {"HEIGHTS": "above egm96.gtx"})
    assert evaluate_surface(model, tmp_path / "p.gpkg", registers=False)["all"]["count"] == 1
