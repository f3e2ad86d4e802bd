"""Surfaces of many images in one call: accuracy, intervals, equal bytes, deaths, and what is refused."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import rasterio
from helpers import COMMAND, invoke, refused, wait_until
from numpy.testing import assert_array_equal
from raw import raw_pair
from sweeps import CRS, OPTIONS, WORDS

from sat_intervals import SatIntervalsError, surface
from sat_intervals.config import load_height_calibration
from sat_intervals.demo import PIXEL, make_scene
from sat_intervals.kernels.conformal import Margins, relief_of
from sat_intervals.match.ground import BLOCK
from sat_intervals.products import SURFACE
from sat_intervals.raster import Georeferencing, north_up, read_layers, write_layer
from sat_intervals.raster.vertical import horizontal

pytestmark = pytest.mark.peer("shareloc")


def files_of(out):
    return [(out / name).read_bytes() for name in ("dsm.tif", "validity.tif")]


def test_surface_of_many__is_near_the_truth_in_most_cells(sweep):
    height, lower, upper, *_ = read_layers(sweep.out / "dsm.tif").astype(float)
    scene = np.isfinite(sweep.truth)
    known = scene & np.isfinite(height)
    assert known.sum() >= 0.85 * scene.sum()
    error = (height - sweep.truth)[known]
    level = np.median(error)  # shifts of the images along the heights are not known
    assert np.median(np.abs(error - level)) < 0.35
    assert 0.85 < ((lower - level <= sweep.truth) & (sweep.truth <= upper - level))[known].mean() < 0.97


def test_surface_of_many__bands_are_those_of_every_surface(sweep):
    height, lower, upper, count, confidence, agreement = read_layers(sweep.out / "dsm.tif")
    known = np.isfinite(height)
    assert (lower <= height)[known].all()
    assert (height <= upper)[known].all()
    assert set(np.unique(count[known])) <= {2, 3, 4, 5}
    assert ((confidence >= 0) & (confidence <= 1))[known].all()
    for band in (lower, upper, count, confidence):
        assert np.isnan(band[~known]).all()
    assert np.isnan(agreement).all()
    with rasterio.open(sweep.out / "dsm.tif") as surface, rasterio.open(sweep.out / "validity.tif") as validity:
        tags = surface.tags()
        assert surface.descriptions == tuple(band.name for band in SURFACE)
        assert (surface.transform, horizontal(surface.crs)) == (validity.transform, validity.crs)
    assert {"IMAGES": "5", "COVERAGE": "0.9", "HEIGHTS": "above the WGS 84 ellipsoid"}.items() <= tags.items()
    assert tags["DISPARITY_CALIBRATION"].startswith("many ")
    assert sweep.report["counts"]["valid"] == known.sum()


def test_surface_of_many__has_the_same_bytes_for_any_tiles_and_says_that_it_was_complete(sweep, tmp_path, caplog):
    out, settings = tmp_path / "out", {"tiles": {"size": 64}}  # of the preset many
    report = surface(sweep.images, out, settings, **OPTIONS, keep_tiles=True)
    assert (out / "tiles" / "tiles").is_dir()
    assert files_of(out) == files_of(sweep.out)
    assert json.loads((out / "run.json").read_text()) == report
    assert surface(sweep.images, out, settings, **OPTIONS) == report
    assert f"the run in {out} was already complete" in caplog.text
    assert "complete" in invoke("status", out).stdout
    assert not (out / "tiles").exists()
    (out / "dsm.tif").unlink()
    with pytest.raises(SatIntervalsError, match=r"dsm.tif"):
        surface(sweep.images, out, settings, **OPTIONS)


def test_surface_of_many__is_completed_the_same_in_a_batch_and_knows_with_what(sweep, tmp_path):
    cells = sweep.report["sweep"]["cells"]
    mask = np.zeros((cells["rows"], cells["columns"]), np.uint8)
    mask[60:70, 60:70] = 1
    write_layer(tmp_path / "mask.tif", mask, 255, north_up(CRS, cells["left"], cells["top"], PIXEL))
    words = *map(str, sweep.images), tmp_path / "out", *WORDS, "--fill", "--mask", tmp_path / "mask.tif"
    result = invoke("surface", *words, "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    measured, bands = (read_layers(out / "dsm.tif") for out in (sweep.out, tmp_path / "out"))
    filled = np.isfinite(bands[0]) & np.isnan(measured[0])
    assert filled.sum() == report["sweep"]["completed"]["filled"] > 100
    assert np.isnan(bands[0][60:70, 60:70]).all()
    assert_array_equal((bands[3] == 0), filled)
    kept = np.isfinite(measured[0]) & (mask == 0)
    assert_array_equal(bands[:, kept], measured[:, kept])
    assert f"cells filled from their rims: {filled.sum()}" in invoke("surface", *words, "--overwrite").stdout
    assert "was already complete" in invoke("surface", *words).stderr
    refused(("surface", *words, "--fill-distance", 5), "holds another run")
    row = {"name": "out", "images": [str(image) for image in sweep.images], "resolution": PIXEL, "crs": CRS}
    (tmp_path / "rows.json").write_text(json.dumps([row | {"fill": 20, "mask": "mask.tif"}]))
    assert invoke("batch", tmp_path / "rows.json", tmp_path / "batch").exit_code == 0
    assert files_of(tmp_path / "batch" / "out") == files_of(tmp_path / "out")
    # without matching again
    later = "dsm", sweep.out, "--fill", "--mask", tmp_path / "mask.tif", "--output"
    result = invoke(*later, tmp_path / "later.tif")
    assert result.exit_code == 0, result.output
    assert f"cells filled from their rims: {filled.sum()}" in result.stdout
    assert_array_equal(read_layers(tmp_path / "later.tif"), bands)
    with rasterio.open(tmp_path / "later.tif") as one, rasterio.open(tmp_path / "out" / "dsm.tif") as other:
        kinds = [(each.crs, each.transform, each.descriptions, each.compression) for each in (one, other)]
        assert kinds[0] == kinds[1]
        assert one.tags() == other.tags() | {"RUNS": one.tags()["RUNS"]}
    refused(("dsm", sweep.out, "--output", tmp_path / "none.tif"), "give fill, flatten or mask, and no more")
    refused((*later, tmp_path / "none.tif", "--resolution", 1), "resolution is for runs of two images")
    refused((*later, sweep.out / "dsm.tif", "--overwrite"), "dsm.tif is an input")


def test_surface_of_many__finds_the_heights_on_a_part_of_a_large_grid(sweep, tmp_path):
    cells, around = sweep.report["sweep"]["cells"], 8 * BLOCK
    place = north_up(CRS, cells["left"] - around * PIXEL, cells["top"] + around * PIXEL, PIXEL)
    grid, size = tmp_path / "grid.tif", 2 * around
    write_layer(grid, np.zeros((size, size), np.uint8), 255, place)
    report = surface(sweep.images, tmp_path / "out", resolution=grid)
    expected = read_layers(sweep.out / "dsm.tif")
    found = read_layers(tmp_path / "out" / "dsm.tif")
    assert found.shape == (6, size, size)
    assert report["sweep"]["heights"] == pytest.approx(sweep.report["sweep"]["heights"], abs=1)
    inside = np.s_[:, around : around + cells["rows"], around : around + cells["columns"]]
    away = np.abs(found[inside][0] - expected[0])
    assert np.nanmedian(away) < 0.05
    assert np.isfinite(away).sum() > 0.9 * np.isfinite(expected[0]).sum()
    found[inside] = np.nan
    assert np.isnan(found).all()


def test_surface_of_many__covers_an_extent_and_moves_bounds_by_margins(sweep, tmp_path):
    margins, truth = tmp_path / "heights.yaml", sweep.out.parent / "truth.tif"
    result = invoke("calibrate", "--dsm", sweep.out / "dsm.tif", "--reference", truth, "--output", margins)
    assert result.exit_code == 0, result.output
    cells = sweep.report["sweep"]["cells"]
    left, top, side = cells["left"], cells["top"], cells["resolution"]
    extent = left + 50 * side, top - 150 * side, left + 169.5 * side, top - 49.5 * side
    plain, calibrated = (surface(sweep.images, tmp_path / "plain", **OPTIONS, extent=extent), None)
    command = "surface", *sweep.images, tmp_path / "calibrated", *WORDS, "--height-calibration", margins
    result = invoke(*command, "--extent", *extent)
    assert result.exit_code == 0, result.output
    calibrated = json.loads((tmp_path / "calibrated" / "run.json").read_text())
    own = {"left": left + 50 * side, "top": top - 49 * side, "resolution": side, "rows": 101, "columns": 120}
    assert plain["sweep"]["cells"] == calibrated["sweep"]["cells"] == pytest.approx(own)
    before, after = (read_layers(tmp_path / name / "dsm.tif") for name in ("plain", "calibrated"))
    np.testing.assert_array_equal(after[[0, 3, 4]], before[[0, 3, 4]])
    calibration = load_height_calibration(margins)
    expected = Margins(*calibration.table()).widened(*before[:3], relief_of(before[0]))
    np.testing.assert_allclose(after[1:3], expected, atol=1e-4)
    assert np.unique((after - before)[1].round(3)).size > 2
    half = calibrated["counts"]["median_interval_width"] * calibrated["sweep"]["step"] / 2
    assert half == pytest.approx(np.nanmedian(after[2] - after[1]) / 2, abs=0.02)
    with rasterio.open(tmp_path / "calibrated" / "dsm.tif") as dataset:
        assert dataset.tags()["CALIBRATION"] == f"heights {calibration.sha256}"
    common = {"resolution": PIXEL, "crs": CRS, "height_calibration": str(margins)}
    names = [str(image) for image in sweep.images]
    rows = [
        {"name": "many", "images": names, "extent": " ".join(map(str, extent))} | common,
        {"name": "two", "images": names[:2], "altitude": 20} | common,
    ]
    (tmp_path / "rows.json").write_text(json.dumps(rows))
    assert invoke("batch", tmp_path / "rows.json", tmp_path / "batch").exit_code == 1
    states = json.loads((tmp_path / "batch" / "batch.json").read_text())
    assert states["many"]["state"] == "done"
    assert "belongs to other surfaces" in states["two"]["error"]
    np.testing.assert_array_equal(read_layers(tmp_path / "batch" / "many" / "dsm.tif"), after)
    refused((*command, "--resolution", 2 * PIXEL), "belongs to other surfaces, CELL is")
    refused((*command[:-2], "--extent", 9, 0, 1, 5), "extent is 9 0 1 5: give left")


@pytest.mark.process
def test_surface_of_many__survives_kill_9_and_has_the_same_bytes_on_processes(sweep, tmp_path):
    out = tmp_path / "out"
    words = ["surface", *sweep.images, out, *WORDS, "--tile-size", 64, "--cluster", "processes", "--workers", 2]
    command = [str(word) for word in (COMMAND, *words, "--quiet", "--keep-tiles")]

    def done():
        return {file.name: file.stat().st_mtime_ns for file in (out / "tiles" / "tiles").glob("[0-9]*.npz")}

    process = subprocess.Popen(command)
    try:
        wait_until(lambda: len(done()) >= 2 or process.poll() is not None, "two tiles")
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()
    before = done()
    assert not (out / "dsm.tif").exists()
    subprocess.run(command, check=True)
    assert before.items() <= done().items(), "tiles done twice"
    assert files_of(out) == files_of(sweep.out)


def test_surface_of_many__refuses_what_it_cannot_use(sweep, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(SatIntervalsError, match="images: 1 given, a surface needs two or more"):
        surface(sweep.images[:1], out, **OPTIONS)
    with pytest.raises(SatIntervalsError, match="2 models are given for 5 images: give one of each image, or none"):
        surface(sweep.images, out, **OPTIONS, sensors=sweep.images[:2])
    with pytest.raises(SatIntervalsError, match=r"cost.method is census, .* compares two images: give --preset many"):
        surface(sweep.images, out, {"preset": "satellite"}, **OPTIONS)
    own = tmp_path / "dsm.tif"
    shutil.copy(sweep.images[3], own)
    with pytest.raises(SatIntervalsError, match=r"dsm.tif is .*input"):
        surface([*sweep.images[:3], own], tmp_path, **OPTIONS, overwrite=True)
    bare = tmp_path / "bare.tif"
    write_layer(bare, read_layers(sweep.images[0])[0], 0, Georeferencing())
    refused(
        ("surface", *sweep.images[:2], bare, out, *WORDS),
        f"{bare} has no RPC model in its tags or beside it: give an image with one",
    )
    refused(("surface", *sweep.images, sweep.images[0], out, *WORDS), f"{sweep.images[0]} is given twice")
    refused(("surface", *sweep.images, out, *WORDS, "--heights", 50, 0), "heights are 50 to 0 m: give the lowest one")
    refused(
        ("surface", *sweep.images, out, *WORDS, "--heights", 0, 9000), "height 9000 m: ", "give a height in this range"
    )
    same = [shutil.copy(sweep.images[0], tmp_path / f"same_{n}.tif") for n in range(3)]
    refused(("surface", *same, out, *WORDS), "show the ground from one direction", "give images from other directions")
    refused(("surface", *sweep.images, sweep.out, *WORDS, "--tile-size", 64), "--overwrite")
    assert not out.exists() or not list(out.glob("*.tif"))


def test_surface__of_many_refuses_options_of_pairs(sweep, tmp_path):
    command = "surface", *sweep.images[:3], tmp_path / "out", *WORDS
    model = ("--left-model", "a", "--right-model", "b")
    given = model, ("--window", 0, 0, 50, 50), ("--radius", 2), ("--altitude", 20), ("--nodata", "0,1")
    for words in given:
        refused((*command, *words), f"{words[0].removeprefix('--')}", " is for two images: leave it out")
    refused((*command, "--disparity", 0, 9), "a range of disparities is for two images: leave it out")
    refused((*command, "--outliers", 2), "a choice of points is for two images: leave it out")
    refused((*command, "--preset", "satellite"), "cost.method is census, which compares two images: give --preset many")


def test_surface__of_two_images_goes_the_way_of_pairs(tmp_path):
    images = raw_pair(tmp_path / "raw", make_scene(120, 150, seed=4))
    command = "surface", *images, tmp_path / "out", "--resolution", 1
    refused((*command, "--heights", 0, 50), "heights is for three images or more: leave it out")
    refused((*command, "--preset", "many"), "compares many images")
    assert not (tmp_path / "out").exists()
    result = invoke(*command, "--altitude", 20)
    assert result.exit_code == 0, result.output
    assert {"left.tif", "right.tif", "intervals.tif", "dsm.tif"} <= {path.name for path in (tmp_path / "out").iterdir()}


def test_batch__makes_surfaces_of_many_images_beside_pairs_and_resumes(sweep, tmp_path):
    folder, out = sweep.images[0].parent, tmp_path / "out"
    common = {"resolution": PIXEL, "crs": CRS}
    rows = [
        {"name": "many", "images": f"{folder}/[1-5].tif", "ortho": True, "tiles.size": 256} | common,
        {"name": "two", "images": [str(sweep.images[1]), str(sweep.images[3])], "altitude": 20, "ortho": True} | common,
        {"name": "broken", "images": f"{folder}/1.tif {folder}/2.tif nowhere.tif"} | common,
    ]
    (tmp_path / "rows.json").write_text(json.dumps(rows))
    done = invoke("batch", tmp_path / "rows.json", out)
    assert (done.exit_code, done.stderr.count("nowhere.tif")) == (1, 1), done.output
    states = json.loads((out / "batch.json").read_text())
    assert {name: end["state"] for name, end in states.items()} == {"many": "done", "two": "done", "broken": "failed"}
    assert files_of(out / "many") == files_of(sweep.out)
    assert states["many"]["surface"]["step"] == sweep.report["sweep"]["step"]
    assert (out / "two" / "ortho.tif").exists()
    shown = next(line for line in done.stdout.splitlines() if line.startswith("many"))
    assert re.search(r"% +\+-[.0-9]+ m +0", shown)
    assert "px" not in shown
    (tmp_path / "rows.json").write_text(json.dumps(rows[:1]))
    ortho = out / "many" / "ortho.tif"
    before, made = files_of(out / "many"), ortho.stat().st_mtime_ns
    for is_missing in (False, True):
        assert invoke("batch", tmp_path / "rows.json", out).exit_code == 0
        assert json.loads((out / "batch.json").read_text())["many"]["state"] == "done before"
        assert files_of(out / "many") == before
        assert (ortho.stat().st_mtime_ns != made) == is_missing
        ortho.unlink()


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ({"images": "a.tif b.tif c.tif"}, "row 1 lacks resolution: a surface needs resolution"),
        ({"images": "*.tif", "resolution": 1}, "row 1: images is '*.tif', which no file matches: give names, or a"),
        ({"images": ["a.tif"], "resolution": 1}, "row 1: images: 1 given, a surface needs two or more"),
        ({"images": "a b", "left": "a", "resolution": 1}, "row 1: give either images, or left and right"),
        (
            {"images": "a b", "heights": "0 9", "resolution": 1},
            "row 1: heights is for three images or more: leave it out",
        ),
        ({"images": "a b c", "left_mask": "m", "resolution": 1}, "row 1: left_mask is for two images: leave it out"),
        ({"images": "a b c", "heights": "0", "resolution": 1}, "row 1: heights is "),
    ],
)
def test_batch__refuses_rows_of_images_that_it_cannot_use(tmp_path, row, problem):
    (tmp_path / "rows.json").write_text(json.dumps([{"name": "x"} | row]))
    refused(("batch", tmp_path / "rows.json", tmp_path / "out"), problem)


def test_plan__of_many_images_finds_grid_and_heights_and_takes_a_sample(sweep, tmp_path):
    result = invoke("plan", *sweep.images, *WORDS, "--tile-size", 64, "--memory", "4GB", "--workers", 1)
    assert result.exit_code == 0, result.stderr
    swept = sweep.report["sweep"]
    rows, columns = (swept["cells"][side] for side in ("rows", "columns"))
    low, high = swept["heights"]
    assert f"{rows} x {columns} of 0.5 m in {CRS}\n" in result.stdout
    assert f"{low:.0f} to {high:.0f} m, every {swept['step']:.2f} m\n" in result.stdout
    assert re.search(r"tiles: +16 of 64 px, exact seams\n", result.stdout)
    assert re.search(r"memory of a worker: +\d+ MB, fits in 4000 MB\n", result.stdout)
    assert re.search(r"expected time, 1 tile at once: +[\d.]+ (s|min)", result.stdout)
    assert all(re.search(rf"{one.name} +[-+]", result.stdout) for one in sweep.images)


def test_plan__refuses_options_of_another_number_of_images(sweep):
    refused(("plan", *sweep.images[:3]), "give either --resolution or --grid-like")
    refused(("plan", *sweep.images[:3], *WORDS, "--window", 0, 0, 9, 9), "--window is for epipolar images: leave")
    refused(("plan", *sweep.images[:3], *WORDS, "--altitude", 1), "--altitude is for two images: leave it out")
    refused(("plan", *sweep.images[:2], *WORDS, "--heights", 0, 9), "--heights is for three images or more: leave it")
    refused(("plan", *sweep.images[:2], "--crs", CRS), "--crs is for surfaces, with --resolution or --grid-like: leave")
    refused(("plan", sweep.images[0]), "give two images or more")
