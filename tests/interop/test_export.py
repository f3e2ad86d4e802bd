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


def read(path):
    with rasterio.open(path) as dataset:
        return dataset.read()


def files_of(form, bands, valid):
    """Names of the files of a format, with their bands and no-data value."""
    disparity, lower, upper, confidence = bands
    ground = np.where(valid, disparity, 0), np.zeros(SHAPE)
    cars = {"epi_disp": disparity, "epi_disp_ambiguity": 1 - confidence}
    cars |= {"epi_disp_interval_bounds_inf": lower, "epi_disp_interval_bounds_sup": upper}
    s2p = {"rectified_disp": disparity, "rectified_disp_confidence": confidence}
    return {
        "cars": {f"{name}.tif": ([np.where(valid, band, -9999)], -9999) for name, band in cars.items()}
        | {"epi_disp_mask.tif": ([255 * valid], None)},
        "otb": {"disparity.tif": (ground, None), "mask.tif": ([255 * valid], None)},
        "asp": {"run-F.tif": ((*ground, valid), None)},
        "s2p": {f"{name}.tif": ([np.where(valid, band, np.nan)], np.nan) for name, band in s2p.items()}
        | {"rectified_mask.png": ([valid], None)},
    }[form]


@pytest.mark.parametrize("form", ["cars", "otb", "asp", "s2p"])
def test_export__writes_the_files_of_each_tool(run, tmp_path, form):
    out, bands, valid = run
    written = exported(out, form, tmp_path / "there" / "run" if form == "asp" else tmp_path / "there")
    expected = files_of(form, bands, valid)
    assert sorted(map(Path, written)) == sorted((tmp_path / "there").iterdir())
    assert {Path(name).name for name in written} == expected.keys()
    for name, (pixels, nodata) in expected.items():
        assert_array_equal(read(tmp_path / "there" / name), pixels)
        with rasterio.open(tmp_path / "there" / name) as dataset:
            assert dataset.dtypes[0] == ("uint8" if "mask" in name else "float32")
            assert_array_equal([dataset.nodata], [nodata])
            assert dataset.crs is None


def test_export__has_no_file_for_what_a_run_has_not(tmp_path):
    out = without_intervals(tmp_path)
    assert [Path(file).name for file in exported(out, "cars", tmp_path / "cars")] == [
        "epi_disp.tif", "epi_disp_ambiguity.tif", "epi_disp_mask.tif"
    ]  # fmt: skip


def test_export__asp_needs_a_prefix(run, tmp_path):
    result = invoke("export", run[0], tmp_path, "--to", "asp")
    assert result.exit_code == 2
    assert f"is a folder: give a prefix for ASP's file, such as {tmp_path / 'run'}" in result.stderr


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
    assert_array_equal(read(tmp_path / "s2p" / "rectified_disp.tif")[0], expected)
    assert_array_equal(read(tmp_path / "s2p" / "rectified_mask.png")[0], np.isfinite(expected))
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
