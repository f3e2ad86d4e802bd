"""Pairs whose rows do not correspond: measured, taken out, the same for any tiling, told and refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from helpers import hashes, invoke, write_pair

from sat_intervals import SatIntervalsError, match_arrays, match_pair
from sat_intervals.demo import make_scene
from sat_intervals.kernels.row_offsets import RowOffsets, shift_rows
from sat_intervals.raster import north_up, open_image, read_window, write_layer
from sat_intervals.results import open_results
from sat_intervals.tiling import Window

PLANE = 1.5, 0.002, -0.001  # rows at row and column 0, and for each row and column


def plane(row, column):
    return PLANE[0] + PLANE[1] * row + PLANE[2] * column


def moved(image, offset):
    """The image whose rows are lower by a function of the place; 0 is no data."""
    row, column = np.indices(image.shape).astype(np.float64)
    source = row.copy()
    for _ in range(20):
        source = row - offset(source, column)
    padded = np.pad(image, ((20, 20), (0, 0)), mode="edge").astype(np.float64)
    whole = np.floor(source - row).astype(np.int64)
    pixels, _ = shift_rows(padded, np.zeros(padded.shape, np.uint8), whole + 20, source - row - whole)
    return np.where(moved_state(image, offset), 0, np.clip(np.rint(pixels), 1, 65535)).astype(image.dtype)


def moved_state(image, offset):
    row, column = np.indices(image.shape)
    there = np.clip(np.rint(row - offset(row, column)).astype(int), 0, len(image) - 1)
    return image[there, column] == 0


@pytest.fixture(scope="module")
def scene():
    return make_scene(384, 448, seed=3)


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    """The pair, with the right image moved."""
    folder = tmp_path_factory.mktemp("rows")
    write_pair(folder, scene)
    with rasterio.open(folder / "right.tif") as file:
        kind = file.profile
    with rasterio.open(folder / "right.tif", "w", **kind) as file:
        file.write(moved(scene.right, plane), 1)
    return folder


@pytest.fixture(scope="module")
def runs(folder, scene):
    """What `match` prints with rows taken out, to the folder auto, and not, to the folder none."""
    search = "--disparity", scene.minimum, scene.maximum
    images = folder / "left.tif", folder / "right.tif"
    return {rows: invoke("match", *images, folder / rows, *search, "--rows", rows).stdout for rows in ("auto", "none")}


def report_of(out):
    return json.loads((out / "run.json").read_text())


def run(folder, out, scene, **settings):
    search = {"minimum": scene.minimum, "maximum": scene.maximum}
    return match_pair(folder / "left.tif", folder / "right.tif", out, {"disparity": search} | settings)


def good(out, scene):
    """Share of the true disparities that are found to a pixel."""
    with rasterio.open(out / "intervals.tif") as file:
        error = np.abs(file.read(1) - scene.truth)
    return (error <= 1).sum() / np.isfinite(scene.truth).sum()


@pytest.mark.usefixtures("runs")
def test_match_pair__takes_a_plane_of_rows_out(folder, scene, tmp_path):
    report, left = report_of(folder / "auto"), report_of(folder / "none")
    write_pair(tmp_path, scene)
    unmoved = run(tmp_path, tmp_path / "unmoved", scene)
    assert (left["rows"], unmoved["rows"]) == (None, None)
    rows = open_results(folder / "auto").rows
    row, column = np.mgrid[0:384:30, 0:448:30]
    assert np.abs(rows.at(row, column) - plane(row, column)).max() < 0.15
    found = report["survey"]["rows"]
    assert found["before"][0] > 1
    assert found["after"][0] < 0.1
    assert good(folder / "auto", scene) > good(tmp_path / "unmoved", scene) - 0.03
    assert good(folder / "none", scene) < 0.8 * good(folder / "auto", scene)
    assert any("rows differ by" in line and "match with --rows auto" in line for line in left["warnings"])
    assert not any("rows" in line for line in report["warnings"])


@pytest.mark.usefixtures("runs")
def test_match_pair__with_rows_taken_out_does_not_depend_on_tiles(folder, scene, tmp_path):
    run(folder, tmp_path / "tiles", scene, tiles={"size": 128}, cluster={"workers": 2})
    assert hashes(folder / "auto") == hashes(tmp_path / "tiles")
    with rasterio.open(folder / "left.tif") as left, rasterio.open(folder / "right.tif") as right:
        arrays = (np.ma.masked_equal(file.read(1), 0) for file in (left, right))
        whole = match_arrays(*arrays, {"disparity": {"minimum": scene.minimum, "maximum": scene.maximum}})
    with rasterio.open(folder / "auto" / "intervals.tif") as file:
        np.testing.assert_array_equal(file.read(1), whole["disparity"])
    assert json.loads(whole.attrs["rows"]) == report_of(folder / "auto")["rows"]


def test_read_window__no_data_grows_by_the_pixels_that_are_read(tmp_path):
    pixels = np.ones((20, 4), np.uint16)
    pixels[10, 1] = 0
    write_layer(tmp_path / "a.tif", pixels, 0, north_up(32631, x=0, y=0, pixel=1))
    image = replace(open_image(tmp_path / "a.tif"), rows=RowOffsets((0.5,), 20, 4))
    values, state = read_window(image, Window(0, 0, 20, 4))
    assert np.flatnonzero(state[:, 1]).tolist() == [0, 8, 9, 10, 11, 18, 19]
    assert np.flatnonzero(state[:, 0]).tolist() == [0, 18, 19]
    np.testing.assert_allclose(values[state == 0], 1)


def test_range_command__prints_the_rows(folder):
    result = invoke("range", folder / "left.tif", folder / "right.tif")
    assert result.exit_code == 0, result.output
    assert "rows of the two images" in result.stdout
    assert "taken out with rows auto" in result.stdout


def test_match_command__says_what_was_moved(runs):
    assert "rows of the right image moved" in runs["auto"]
    assert "rows of the right image moved" not in runs["none"]


def test_match_pair__refuses_a_pair_whose_rows_are_too_far_apart(scene, tmp_path):
    write_pair(tmp_path, scene)
    with rasterio.open(tmp_path / "right.tif", "r+") as file:
        file.write(moved(scene.right, lambda row, column: 14.0 + 0 * row), 1)
    with pytest.raises(SatIntervalsError, match=r"right.tif: not an epipolar pair: rows differ by 1\d"):
        run(tmp_path, tmp_path / "out", scene)
    left = run(tmp_path, tmp_path / "out", scene, rows="none")
    assert any("not an epipolar pair" in line for line in left["warnings"])
