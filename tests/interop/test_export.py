"""The files of other tools, field by field."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from finished import PLACE, random_bands, without_intervals, write_run
from helpers import invoke
from numpy.testing import assert_array_equal
from rasterio.transform import Affine

from sat_intervals.products import INVALID

# Epipolar images have no georeferencing.
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SHAPE = 530, 90  # more than a row of blocks


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run, its bands and which pixels are valid."""
    bands, validity, _ = random_bands(*SHAPE)
    folder = tmp_path_factory.mktemp("run")
    return write_run(folder, bands, validity), bands, validity & INVALID == 0


def exported(out, form, target):
    result = invoke("export", out, target, "--to", form)
    assert result.exit_code == 0, result.output
    return result.output.splitlines()


def look(path):
    """Bands, type, no-data value and CRS of a file."""
    with rasterio.open(path) as dataset:
        return dataset.read(), dataset.dtypes[0], dataset.nodata, dataset.crs


def test_export__cars(run, tmp_path):
    out, bands, valid = run
    names = ["epi_disp", "epi_disp_interval_bounds_inf", "epi_disp_interval_bounds_sup", "epi_disp_ambiguity"]
    written = exported(out, "cars", tmp_path / "cars")
    assert written == [str(tmp_path / "cars" / f"{name}.tif") for name in [*names, "epi_disp_mask"]]
    assert sorted(path.name for path in (tmp_path / "cars").iterdir()) == sorted(
        f"{name}.tif" for name in [*names, "epi_disp_mask"]
    )
    for name, band in zip(names, (*bands[:3], 1 - bands[3]), strict=True):
        pixels, dtype, nodata, crs = look(tmp_path / "cars" / f"{name}.tif")
        assert (pixels.shape, dtype, nodata, crs) == ((1, *SHAPE), "float32", -9999, None)
        assert_array_equal(pixels[0], np.where(valid, band, -9999))
    mask, dtype, nodata, _ = look(tmp_path / "cars" / "epi_disp_mask.tif")
    assert (dtype, nodata) == ("uint8", None)
    assert_array_equal(mask[0], np.where(valid, 255, 0))


def test_export__has_no_file_for_what_a_run_has_not(tmp_path):
    out = without_intervals(tmp_path)
    assert [Path(file).name for file in exported(out, "cars", tmp_path / "cars")] == [
        "epi_disp.tif", "epi_disp_ambiguity.tif", "epi_disp_mask.tif"
    ]  # fmt: skip


def test_export__asp_needs_a_prefix(run, tmp_path):
    result = invoke("export", run[0], tmp_path, "--to", "asp")
    assert result.exit_code == 2
    assert f"is a folder: give a prefix for ASP's file, such as {tmp_path / 'run'}" in result.stderr


def test_export__asp(run, tmp_path):
    out, bands, valid = run
    assert exported(out, "asp", tmp_path / "stereo" / "run") == [str(tmp_path / "stereo" / "run-F.tif")]
    pixels, dtype, nodata, crs = look(tmp_path / "stereo" / "run-F.tif")
    assert (pixels.shape, dtype, nodata, crs) == ((3, *SHAPE), "float32", None, None)
    assert_array_equal(pixels, [np.where(valid, bands[0], 0), np.zeros(SHAPE), valid])


def test_export__s2p(run, tmp_path):
    out, bands, valid = run
    names = ["rectified_disp.tif", "rectified_disp_confidence.tif", "rectified_mask.png"]
    exported(out, "s2p", tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    for name, band in zip(names[:2], (bands[0], bands[3]), strict=True):
        pixels, dtype, nodata, _ = look(tmp_path / name)
        assert (dtype, np.isnan(nodata)) == ("float32", True)
        assert_array_equal(pixels[0], np.where(valid, band, np.nan))
    mask, dtype, _, _ = look(tmp_path / "rectified_mask.png")
    assert dtype == "uint8"
    assert_array_equal(mask[0], valid)


def test_export__otb(run, tmp_path):
    out, bands, valid = run
    exported(out, "otb", tmp_path)
    pixels, dtype, _, _ = look(tmp_path / "disparity.tif")
    assert dtype == "float32"
    assert_array_equal(pixels, [np.where(valid, bands[0], 0), np.zeros(SHAPE)])
    assert_array_equal(look(tmp_path / "mask.tif")[0][0], np.where(valid, 255, 0))


@pytest.mark.parametrize("row", [0, 600, 40])
def test_export__a_region_lies_at_its_place_in_the_left_image(tmp_path, row):
    bands, validity, _ = random_bands(30, 20)
    out = write_run(tmp_path, bands, validity)
    report = json.loads((out / "run.json").read_text())
    report["inputs"]["left"] |= {"height": 630, "width": 50}
    report["tiles"]["region"] |= {"row": row, "column": 7}
    (out / "run.json").write_text(json.dumps(report))
    exported(out, "s2p", tmp_path / "s2p")
    expected = np.full((630, 50), np.nan, np.float32)
    expected[row : row + 30, 7:27] = np.where(validity & INVALID == 0, bands[0], np.nan)
    assert_array_equal(look(tmp_path / "s2p" / "rectified_disp.tif")[0][0], expected)
    assert_array_equal(look(tmp_path / "s2p" / "rectified_mask.png")[0][0], np.isfinite(expected))
    exported(out, "otb", tmp_path / "otb")
    for name in ("disparity.tif", "mask.tif"):
        with rasterio.open(tmp_path / "otb" / name) as dataset:
            assert (dataset.transform, dataset.crs) == (PLACE.transform @ Affine.translation(-7, -row), None)


def test_export__replaces_files_with_overwrite_only(run, tmp_path):
    (tmp_path / "mask.tif").write_text("mine")
    refused = invoke("export", run[0], tmp_path, "--to", "otb")
    assert (refused.exit_code, [file.name for file in tmp_path.iterdir()]) == (2, ["mask.tif"])
    assert "mask.tif exists: choose another name or --overwrite" in refused.stderr
    assert invoke("export", run[0], tmp_path, "--to", "otb", "--overwrite").exit_code == 0
    with rasterio.open(tmp_path / "mask.tif") as dataset:
        assert dataset.tags()["EXPORT"] == "otb"


def test_export__refuses_what_is_no_run_and_what_it_does_not_know(run, tmp_path):
    for words, message in (
        ([str(tmp_path), "to", "--to", "cars"], "give the folder of a finished run"),
        ([str(run[0]), str(tmp_path), "--to", "micmac"], "'micmac' is not one of"),
        ([str(run[0]), str(tmp_path)], "Missing option '--to'. Choose from: cars, otb"),
    ):
        result = invoke("export", *words)
        assert result.exit_code == 2
        assert message in result.stderr
        assert result.stderr.count("\n") == 1
