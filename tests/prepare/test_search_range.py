"""The search range of a run: found, kept, resumed, local, and the warnings about its ends."""

import base64
import gzip
import json

import numpy as np
import pytest
import rasterio
from helpers import PLACE, bands, invoke, write_pair
from matplotlib.image import imread

from sat_intervals import RunError, SatIntervalsError, match_pair, open_image
from sat_intervals.demo import make_scene
from sat_intervals.match import schedule
from sat_intervals.prepare import prepared
from sat_intervals.prepare.local import read_ranges
from sat_intervals.raster import read_layers, write_layer
from sat_intervals.results import open_results
from sat_intervals.run import pair as run_pair
from sat_intervals.show import maps
from sat_intervals.show.report.contents import Pixels


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("range")
    write_pair(place, make_scene(130, 220, seed=11))
    return place


def run(folder, out, **sections):
    return match_pair(folder / "left.tif", folder / "right.tif", out, sections)


def test_match_pair__keeps_what_was_asked_and_what_was_found(folder, tmp_path):
    report = run(folder, tmp_path / "found")
    search = report["settings"]["disparity"]
    assert report["requested"]["disparity"]["minimum"] == "auto"
    assert (search["minimum"], search["maximum"]) == tuple(report["search"][end] for end in ("minimum", "maximum"))
    given = {"minimum": search["minimum"], "maximum": search["maximum"], "open_ends": True}
    run(folder, tmp_path / "given", disparity=given)
    for one, other in zip(bands(tmp_path / "found"), bands(tmp_path / "given"), strict=True):
        np.testing.assert_array_equal(one, other)


def test_match_pair__an_interrupted_run_keeps_its_range(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(run_pair, "match_jobs", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        run(folder, tmp_path)
    with np.load(tmp_path / "tiles/once/range.npz") as kept:
        stored = json.loads(kept["meta"])["found"]
    monkeypatch.undo()
    for name in ("found_range", "measured_parallax"):
        monkeypatch.setattr(prepared, name, lambda *_: pytest.fail("searched again"))
    report = run(folder, tmp_path)
    assert report["search"]["minimum"] == stored["minimum"]
    assert not (tmp_path / "tiles").exists()


def test_match_pair__takes_no_range_of_other_images(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(run_pair, "match_jobs", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        run(folder, tmp_path)

    def search(*_):
        raise RunError("searched again")

    monkeypatch.setattr(prepared, "found_range", search)
    with pytest.raises(RunError, match="searched again"):
        match_pair(folder / "right.tif", folder / "left.tif", tmp_path, {})


OF_MCCNN = pytest.param({"preset": "satellite-mccnn"}, marks=pytest.mark.peer("onnxruntime", "mc_cnn"))


@pytest.mark.parametrize("settings", [{}, {"interval": {"coverage": 0.9}}, OF_MCCNN])
def test_match_pair__local_ranges_give_the_same_in_any_tiling(folder, tmp_path, monkeypatch, settings):
    names = "tiles", "blocks", "whole"
    for name, size, blocks in zip(names, (64, 64, 512), (4, 1, 4), strict=True):
        monkeypatch.setattr(schedule, "_BLOCKS", blocks)
        tiles = {"size": size, "overlap": "exact"}
        report = run(folder, tmp_path / name, disparity={"local": True}, tiles=tiles, **settings)
        assert report["local_ranges"]["share"] < 0.95
    for tiled, in_blocks, whole in zip(*(bands(tmp_path / name) for name in names), strict=True):
        np.testing.assert_array_equal(tiled, whole)
        np.testing.assert_array_equal(in_blocks, whole)


def write_bands(file, low, high):
    options = {"count": 2, "height": low.shape[0], "width": low.shape[1], "dtype": "float32", "nodata": np.nan}
    with rasterio.open(file, "w", driver="GTiff", **options, **PLACE.creation_options()) as dataset:
        dataset.write(np.stack([low, high]).astype(np.float32))


def test_read_ranges__takes_the_hull_of_a_cell_rounded_outwards(folder, tmp_path):
    left = open_image(folder / "left.tif")
    low, high = np.full((130, 220), -3.5), np.full((130, 220), 4.2)
    low[10, 10], high[70, 70], low[129, 210] = -9.1, 12.5, np.nan
    file = tmp_path / "ranges.tif"
    write_bands(file, low, high)
    found = read_ranges(str(file), left).clipped(-20, 20)
    assert (found.minimum[0, 0], found.maximum[0, 0]) == (-10, 5)
    assert (found.minimum[1, 1], found.maximum[1, 1]) == (-4, 13)
    assert (found.minimum[2, 3], found.maximum[2, 3]) == (-20, 20)
    low[3, 4] = 9
    write_bands(file, low, high)
    with pytest.raises(SatIntervalsError, match=r"minimum 9 above maximum 4\.2 at row 3, column 4"):
        read_ranges(str(file), left)
    write_layer(file, low, np.nan, PLACE)
    with pytest.raises(SatIntervalsError, match="has 1 bands of 130 x 220 pixels"):
        read_ranges(str(file), left)


def test_match__warns_of_ranges_of_another_left_image(folder, tmp_path):
    images, file = (folder / "left.tif", folder / "right.tif"), tmp_path / "range.tif"
    assert invoke("range", *images, "--output", file, "-q").exit_code == 0
    said = f"{file} was made for another left image than {images[1]}: check that it is of this pair"
    for order in (1, -1):
        done = invoke(
            "match", *images[::order], tmp_path / f"out{order}", "--set", f"disparity.grid={file}", "--tile-size", 128
        )
        assert done.exit_code == 0
        assert (said in done.stderr) == (order == -1)


def test_range__writes_the_ranges_that_match_reads(folder, tmp_path, monkeypatch):
    images = folder / "left.tif", folder / "right.tif"
    assert invoke("range", *images, "--output", tmp_path / "range.tif", "-q").exit_code == 0
    report = run(folder, tmp_path / "out", disparity={"grid": str(tmp_path / "range.tif")}, tiles={"size": 128})
    search = report["settings"]["disparity"]
    with rasterio.open(tmp_path / "range.tif") as dataset:
        low, high = dataset.read()
    assert (search["minimum"], search["maximum"]) == (low.min(), high.max())
    (disparity, *_), _ = bands(tmp_path / "out")
    assert report["local_ranges"]["share"] < 1
    assert np.isfinite(disparity).mean() > 0.5
    for name in ("draw_overview", "draw_errors"):
        monkeypatch.setattr(maps, name, lambda results, path, dpi: path.write_bytes(b"drawn"))
    assert str(tmp_path / "out/range.png") in invoke("plot", tmp_path / "out", "--dpi", 40).stdout.split()
    picture = imread(tmp_path / "out/range.png")
    halves = picture[:, : picture.shape[1] // 2], picture[:, picture.shape[1] // 2 :]
    assert all(len(np.unique(half.reshape(-1, picture.shape[2]), axis=0)) > 20 for half in halves)
    pixels = Pixels(open_results(tmp_path / "out"))
    for row, each in open_results(tmp_path / "out").strips():
        pixels.add(row, each, np.zeros(each.validity.shape, bool))
    codes = gzip.decompress(base64.b64decode(pixels.report()["layers"]["searched"]["codes"]))
    searched = np.frombuffer(codes, "<u2").reshape(low.shape)
    assert (searched >= high - low + 1).all()  # a cell of 64 pixels searches the hull of smaller ones
    assert len(np.unique(searched)) > 1


def test_range__keeps_inputs_and_files_of_others(folder, tmp_path):
    images = folder / "left.tif", folder / "right.tif"
    before = images[1].read_bytes()
    result = invoke("range", *images, "--output", images[1])
    assert result.exit_code == 2
    assert "is an input" in result.stderr
    assert images[1].read_bytes() == before
    write_bands(tmp_path / "other.tif", *np.zeros((2, 130, 220)))
    result = invoke("range", *images, "--output", tmp_path / "other.tif")
    assert (result.exit_code, "other.tif exists: choose another name" in result.stderr) == (2, True)
    assert invoke("range", *images, "--output", tmp_path / "other.tif", "--overwrite").exit_code == 0


def test_match__names_a_wider_range_and_is_strict(folder, tmp_path):
    command = "match", folder / "left.tif", folder / "right.tif", tmp_path, "--disparity", -3, 9, "--strict", "-q"
    result = invoke(*command)
    assert result.exit_code == 1
    report = json.loads((tmp_path / "run.json").read_text())
    assert any(
        "are within 1 px of -3 or 9, the ends of the search range: try --disparity" in line
        for line in report["warnings"]
    )
    assert report["counts"]["range_ends"]["maximum"] > 0


def test_range__prints_the_range_and_refuses_images_that_do_not_match(folder, tmp_path):
    found = json.loads(invoke("range", folder / "left.tif", folder / "right.tif", "--json").stdout)
    assert found["matched"] > 0.5
    write_layer(tmp_path / "other.tif", read_layers(folder / "right.tif")[0, ::-1].copy(), 0, PLACE)
    result = invoke("range", folder / "left.tif", tmp_path / "other.tif", "-q")
    assert result.exit_code == 2
    assert "give the search range with --disparity MIN MAX" in result.stderr
