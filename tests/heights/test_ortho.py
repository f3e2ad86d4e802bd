"""Ortho-images: raw images resampled to a surface, without the cells that it hides."""

import json
import shutil

import numpy as np
import pytest
from cameras import cameras, sensor_words
from helpers import invoke, refused, write_pair
from surfaces import write_geoid, write_raster

from sat_intervals.demo import make_scene
from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.dsm import check_sensors
from sat_intervals.heights.ortho import hidden, median_of, write_ortho_of
from sat_intervals.heights.rectify import rectified_files
from sat_intervals.raster import Projection, read_layers, read_place
from sat_intervals.results import open_run

CELL = 0.5
WORDS = "--resolution", CELL, "--crs", "EPSG:32631"


@pytest.fixture(scope="module")
def scene():
    return make_scene(240, 300, seed=4)


@pytest.fixture(scope="module")
def made(tmp_path_factory, scene):
    """A folder of `surface` of a raw pair."""
    from raw import raw_pair

    folder = tmp_path_factory.mktemp("ortho")
    result = invoke("surface", *raw_pair(folder / "raw", scene), folder / "out", *WORDS, "--altitude", 20, "--ortho")
    assert result.exit_code == 0, result.output
    return folder / "out"


@pytest.mark.parametrize(("sight", "expected"), [((0, 0.5), np.s_[5:8, 6:10]), ((-0.25, 0), np.s_[8:10, 10:13])])
def test_hidden__is_behind_a_tower(sight, expected):
    surface = np.zeros((29, 33))
    surface[12:15, 17:20] = 8.5  # rows 5 to 7 and columns 10 to 12 of the middle
    surface[20, 3:] = np.nan
    found = np.zeros((15, 19), bool)
    found[expected] = True
    np.testing.assert_array_equal(hidden(surface, (15, 19), np.array(sight)), found)


def test_hidden__is_what_a_march_of_each_cell_finds():
    random = np.random.default_rng(0)
    surface, margin = random.uniform(0, 6, (30, 34)), 9
    surface[random.random(surface.shape) < 0.1] = np.nan
    sight = np.array([-0.7, 0.9])
    expected = np.zeros((12, 16), bool)
    for row, column in np.ndindex(expected.shape):
        for cells in range(1, margin + 1):
            there = margin + row + round(cells * -0.7 / 0.9), margin + column + cells
            expected[row, column] |= surface[there] > surface[margin + row, margin + column] + cells / 0.9
    np.testing.assert_array_equal(hidden(surface, expected.shape, sight), expected)
    assert 0.1 < expected.mean() < 0.9


def test_median_of__leaves_out_unknown_values():
    values = np.array([[1, 4, np.nan], [3, np.nan, np.nan], [7, 8, np.nan]])
    np.testing.assert_array_equal(median_of(values), [3, 6, np.nan])


@pytest.mark.peer("shareloc")
def test_surface__ortho_shows_the_left_image_where_the_ground_is(made, scene):
    from raw import heights_of

    x, y, _ = heights_of(scene)
    grey = scene.left[np.isfinite(scene.truth)].astype(float)
    (rows, columns), place = read_place(made / "ortho.tif")
    assert (read_place(made / "dsm.tif")[0], place.crs) == ((rows, columns), read_place(made / "dsm.tif")[1].crs)
    cells = np.stack([(place.affine.f - y) / CELL, (x - place.affine.c) / CELL]).astype(int)
    inside = ((cells >= 0) & (cells < [[rows], [columns]])).all(axis=0)
    there = read_layers(made / "ortho.tif", band=1)[tuple(cells[:, inside])]
    known = np.isfinite(there)
    assert known.mean() > 0.6
    assert np.corrcoef(there[known], grey[inside][known])[0, 1] > 0.9
    height = read_layers(made / "dsm.tif", band=1)
    ortho = read_layers(made / "ortho.tif", band=1)
    assert not np.isfinite(ortho[np.isnan(height)]).any()
    assert 0 < np.isnan(ortho[np.isfinite(height)]).mean() < 0.1  # hidden, or outside the image
    right = read_layers(made / "ortho.tif", band=2)
    seen = np.isfinite(ortho) & np.isfinite(right)
    assert seen.mean() > 0.6
    assert np.corrcoef(ortho[seen], right[seen])[0, 1] > 0.9
    assert (np.isnan(ortho) != np.isnan(right)).any()  # what one image sees, another need not


@pytest.mark.peer("shareloc", "matplotlib")
def test_surface__ortho_is_known_by_plot_and_stac(made, tmp_path):
    out = shutil.copytree(made, tmp_path / "out")
    assert "ortho.png" in invoke("plot", out).output
    assert invoke("stac", out).exit_code == 0
    assets = json.loads((out / "stac.json").read_text())["assets"]
    assert [band["name"] for band in assets["ortho"]["bands"]] == ["left", "right"]
    assert assets["ortho"]["proj:shape"] == assets["dsm"]["proj:shape"]


@pytest.mark.peer("shareloc")
def test_check_sensors__looks_for_areas_before_matching(made, tmp_path, caplog):
    (rows, columns), place = read_place(made / "dsm.tif")
    inside = np.zeros((1, rows, columns))
    inside[0, 20:40, 20:40] = 1
    files = rectified_files(made / "left.tif", made / "right.tif")
    for name, moved in (("here", 0), ("away", 90_000)):
        mask = write_raster(tmp_path / f"{name}.tif", inside, place.moved(moved, 0).transform)
        check_sensors(files, CELL, "EPSG:32631", SurfaceChoices(mask=mask))
    assert [record.args[0].name for record in caplog.records] == ["away.tif"]


@pytest.mark.peer("shareloc")
def test_dsm__ortho_is_the_same_above_a_geoid_and_of_a_moved_surface(made, tmp_path):
    expected = read_layers(made / "ortho.tif", band=1)
    geoid = write_geoid(tmp_path / "geoid.tif", 49.5)
    words = *WORDS, "--geoid", geoid, "--ortho", "--output", tmp_path / "above.tif"
    assert invoke("dsm", made, *words).exit_code == 0
    np.testing.assert_allclose(read_layers(tmp_path / "ortho.tif", band=1), expected, atol=2)
    refused(("dsm", made, *words, "--output", tmp_path / "other.tif"), "ortho.tif exists", "--overwrite")
    bands, (_, place) = read_layers(made / "dsm.tif"), read_place(made / "dsm.tif")
    bands[:3] += 3
    (tmp_path / "moved").mkdir()
    moved = write_raster(tmp_path / "moved" / "dsm.tif", bands, place.moved(2, -1).transform)
    write_ortho_of(open_run(made), moved, Projection("EPSG:32631"), (2, -1, 3), lambda *_: None)
    np.testing.assert_allclose(read_layers(moved.with_name("ortho.tif"), band=1), expected, atol=2)


@pytest.mark.peer("shareloc")
def test_dsm__ortho_needs_the_raw_images(made, scene, tmp_path):
    write_pair(tmp_path, scene)
    pair, sensors = (tmp_path / "left.tif", tmp_path / "right.tif"), cameras(tmp_path, *scene.truth.shape)
    words = *WORDS, *sensor_words(sensors)
    unknown = f"{pair[0]} was not rectified by sat-intervals, so its raw image is unknown: leave out ortho"
    refused(("surface", *pair, tmp_path / "out", *words, "--ortho"), unknown)
    assert not (tmp_path / "out").exists()
    shutil.copytree(made, tmp_path / "made")
    record = json.loads((made / "rectify.json").read_text())
    record["inputs"]["left"]["path"] = "/raw/gone.tif"
    (tmp_path / "made" / "rectify.json").write_text(json.dumps(record))
    gone = "/raw/gone.tif, an image of the run, is missing: move it back"
    refused(("dsm", tmp_path / "made", *WORDS, "--ortho"), gone)
