"""Whole runs on real workers: tiles against the whole image, resuming, reports."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from helpers import LOCK, OUTPUTS, bands, hashes, shares_that_differ, write_pair
from volumes import census_volume

from sat_intervals import match_arrays, match_pair
from sat_intervals.config import load_config
from sat_intervals.demo import make_scene
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.products import INVALID
from sat_intervals.results import open_run
from sat_intervals.run import tile
from sat_intervals.run.job import open_job
from sat_intervals.run.tile import match_block
from sat_intervals.store.manifest import differences, digest
from sat_intervals.tiling import Window


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A procedural pair of 100 x 150 pixels on disk, with its settings; 2 x 3 tiles of 64 pixels."""
    folder = tmp_path_factory.mktemp("pair")
    settings = write_pair(folder, make_scene(100, 150, seed=3))
    return folder / "left.tif", folder / "right.tif", settings


def in_tiles(settings, size, overlap=20, **more):
    return settings | {"tiles": {"size": size, "overlap": overlap}} | more


@pytest.mark.parametrize("more", [{}, {"cross_check": {"method": "accurate"}}, {"sgm": None}])
def test_match_pair__equals_match_arrays_in_one_tile(pair, tmp_path, more):
    left, right, settings = pair
    settings = settings | more
    match_pair(left, right, tmp_path / "out", settings)
    with rasterio.open(left) as first, rasterio.open(right) as second:
        arrays = [np.ma.masked_equal(file.read(1), 0) for file in (first, second)]
    whole = match_arrays(*arrays, settings)
    intervals, validity = bands(tmp_path / "out")
    np.testing.assert_array_equal(intervals, [whole[name] for name in ("disparity", "lower", "upper", "confidence")])
    np.testing.assert_array_equal(validity, whole["validity"])


def test_match_pair__warns_of_images_without_texture(pair, tmp_path, caplog):
    left, right, settings = pair
    match_pair(left, right, tmp_path / "textured", settings, window=Window(20, 60, 64, 64))
    warned = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert not warned
    with rasterio.open(left) as file:
        pixels, profile = file.read(1), file.profile
    pixels[:, 60:] = 900
    for name in ("left", "right"):
        with rasterio.open(tmp_path / f"{name}.tif", "w", **profile) as file:
            pixels[:, 0] = 700 + (name == "left")  # else the same image twice
            file.write(pixels, 1)
    flat = {"disparity": {"minimum": -4, "maximum": 4}}
    counts = match_pair(tmp_path / "left.tif", tmp_path / "right.tif", tmp_path / "out", flat)["counts"]
    _, lower, upper, _ = bands(tmp_path / "out")[0]
    assert counts["ambiguous"] == ((lower == -4) & (upper == 4)).sum() > counts["valid"] / 2
    (record,) = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert f"left.tif: the interval of {counts['ambiguous']} of {counts['valid']} valid pixels" in record.getMessage()


@pytest.mark.parametrize("more", [{}, {"cross_check": {"method": "accurate"}}])
def test_match_pair__tiles_with_overlap_equal_one_tile_nearly_everywhere(pair, tmp_path, more):
    left, right, settings = pair
    match_pair(left, right, tmp_path / "whole", in_tiles(settings, 512, **more))
    match_pair(left, right, tmp_path / "tiles", in_tiles(settings, 64, overlap=50, **more))
    disparity, interval = shares_that_differ(tmp_path / "whole", tmp_path / "tiles")
    assert disparity <= 0.002
    assert interval <= 0.005


def test_match_pair__writes_a_complete_report(pair, tmp_path):
    left, right, settings = pair
    report = match_pair(left, right, tmp_path / "out", settings)
    assert report == open_run(tmp_path / "out").report
    counts, validity = report["counts"], bands(tmp_path / "out")[1]
    assert counts["pixels"] == validity.size
    assert counts["valid"] == (validity & INVALID == 0).sum()
    for name, flag in report["validity_bits"].items():
        assert counts["flags"][name] == np.count_nonzero(validity & (1 << flag["bit"]))
    assert counts["valid"] + sum(counts["causes"].values()) == counts["pixels"]
    assert report["inputs"]["left"]["bytes"] == left.stat().st_size
    assert report["cost_span"] == 448
    assert load_config(report["settings"]) == load_config(settings)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [LOCK, *OUTPUTS]


def test_match_pair__window_is_the_crop_of_the_whole(pair, tmp_path):
    left, right, settings = pair
    window = Window(20, 40, 64, 80)
    settings = settings | {"ambiguity": {"normalization": "range"}, "cross_check": None, "regularization": None}
    match_pair(left, right, tmp_path / "whole", settings)
    match_pair(left, right, tmp_path / "part", settings, window=window)
    whole, part = bands(tmp_path / "whole")[0][(slice(None), *window.slices)], bands(tmp_path / "part")[0]
    inner = np.s_[:, 1:-1, 1:-1]  # the median sees beyond the region's border
    assert np.mean((whole[inner] != part[inner]) & ~(np.isnan(whole[inner]) & np.isnan(part[inner]))) < 0.001
    with rasterio.open(tmp_path / "part" / "intervals.tif") as file, rasterio.open(left) as image:
        assert file.transform == image.transform @ rasterio.Affine.translation(window.column, window.row)
        assert file.crs == image.crs


def test_match_pair__goes_on_from_the_tiles_that_are_done(pair, tmp_path, monkeypatch):
    left, right, settings = pair
    settings = in_tiles(settings, 64)
    match_pair(left, right, tmp_path / "undisturbed", settings)
    log = tmp_path / "log"

    def fail_once(job, block):
        with log.open("a") as file:
            print(block.name, file=file)
        if block.name == "1_2" and log.read_text().split().count("1_2") <= 3:
            raise OSError("disk gone")
        return match_block(job, block)

    monkeypatch.setattr(tile, "match_block", fail_once)
    with pytest.raises(RunError, match=r"1 of 6 tiles failed.*\n.*tile 1_2: disk gone"):
        match_pair(left, right, tmp_path / "out", settings)
    assert not list((tmp_path / "out").glob("[a-z]*.*"))
    match_pair(left, right, tmp_path / "out", settings)
    assert sorted(log.read_text().split()) == sorted(
        [*(f"{row}_{column}" for row, column in np.ndindex(2, 3)), *3 * ["1_2"]]  # tried three times
    )
    assert hashes(tmp_path / "undisturbed") == hashes(tmp_path / "out")


def test_digest__tells_what_differences_tell(tmp_path):
    manifest = {"settings": {"p": 1}, "inputs": {"left": {"sha256": "a", "modified": "today"}, "files": [{"bytes": 3}]}}
    later = {"inputs": {"files": [{"bytes": 3}], "left": {"modified": "now", "sha256": "a"}}, "settings": {"p": 1}}
    other = {"settings": {"p": 1}, "inputs": {"left": {"sha256": "a", "modified": "today"}, "files": [{"bytes": 4}]}}
    assert digest(later) == digest(manifest)
    assert digest(other) != digest(manifest)
    (line,) = differences({"calibration": None}, {"calibration": {"classes": [*range(1000)]}})
    assert line.startswith("calibration was null, now {")
    assert line.endswith("...")
    assert len(line) < 150


class _Matcher:
    """A matcher with a parameter that its name does not tell."""

    def __call__(self, left, right, first):
        raise AssertionError


@pytest.mark.parametrize("matcher", [_Matcher(), lambda left, right, first: None, "x"])
def test_match_pair__a_matcher_without_a_name_needs_one(pair, tmp_path, matcher):
    left, right, settings = pair
    given = {"preset": "paper", "disparity": settings["disparity"], "cost": {"method": "volume"}}
    with pytest.raises(SatIntervalsError, match=r"cost\.name|give the function"):
        match_pair(left, right, tmp_path / "out", given, volume_of=matcher)


def test_match_block__of_another_version_is_refused(pair, tmp_path):
    left, right, settings = pair
    job = open_job(left, right, tmp_path, in_tiles(settings, 64))
    job.begin()
    other = replace(job, manifest=job.manifest | {"kernels": "another"})
    with pytest.raises(RunError, match="this worker has another version of sat-intervals"):
        match_block(other, next(iter(job.store.grid)))


# ---- A matcher of one's own --------------------------------------------------------------------------------
OWN = {"cost": {"method": "volume", "span": 8, "margin": 1}, "sgm": {"p1": 4, "p2": 24}}


def test_match_pair__matches_volumes_of_a_function_as_our_own(pair, tmp_path):
    left, right, settings = pair
    expected = settings | {"cost": {"window": 3}, "sgm": {"p1": 4, "p2": 24}}
    match_pair(left, right, tmp_path / "ours", expected)
    match_pair(left, right, tmp_path / "one", in_tiles(settings | OWN, 512, "exact"), volume_of=census_volume)
    report = match_pair(left, right, tmp_path / "own", in_tiles(settings | OWN, 64, "exact"), volume_of=census_volume)
    np.testing.assert_array_equal(bands(tmp_path / "own")[0], bands(tmp_path / "ours")[0])
    assert hashes(tmp_path / "own") == hashes(tmp_path / "one")
    assert report["settings"]["cost"]["name"] == "volumes.census_volume"


@pytest.mark.process
def test_match_pair__takes_volumes_of_a_function_as_they_are_without_sgm(pair, tmp_path):
    left, right, settings = pair
    settings = settings | {"cost": OWN["cost"], "cluster": {"kind": "processes", "workers": 1}}
    for size in (64, 512):
        match_pair(left, right, tmp_path / str(size), in_tiles(settings, size, 2), volume_of=census_volume)
    np.testing.assert_array_equal(*(bands(tmp_path / str(size))[0] for size in (64, 512)))


def test_match_pair__resumes_only_with_the_same_function(pair, tmp_path):
    left, right, settings = pair
    settings = in_tiles(settings | OWN, 64, "exact")
    calls = []

    def fails(*arguments):
        calls.append(arguments)
        if len(calls) > 3:
            raise ValueError("no more")
        return census_volume(*arguments)

    fails.__module__, fails.__qualname__ = census_volume.__module__, census_volume.__qualname__
    with pytest.raises(RunError, match="no more"):
        match_pair(left, right, tmp_path / "out", settings | {"cluster": {"workers": 1, "retries": 0}}, volume_of=fails)
    with pytest.raises(SatIntervalsError, match=r"cost\.name was"):
        match_pair(left, right, tmp_path / "out", settings, volume_of=np.zeros)
    match_pair(left, right, tmp_path / "out", settings, volume_of=census_volume)
    match_pair(left, right, tmp_path / "whole", settings, volume_of=census_volume)
    assert hashes(tmp_path / "out") == hashes(tmp_path / "whole")


def test_match_pair__refuses_a_function_that_does_not_fit(pair, tmp_path):
    left, right, settings = pair
    own = settings | OWN
    named = own | {"cost": OWN["cost"] | {"name": "wrong 1"}}
    for given, volume_of, message in (
        (settings, census_volume, "volume_of is given, but cost.method is census"),
        (own, None, "give match_pair volume_of"),
        (
            named,
            lambda left, right, first: left,
            r"volume_of returned \(102, 152\) of float32, needed are \(100, 150, ",
        ),
        (named, lambda *images: 100 * census_volume(*images), "values are outside 0 to 8"),
        (own | {"disparity": {"local": True}}, census_volume, "leave out local ranges"),
    ):
        with pytest.raises(SatIntervalsError, match=message):
            match_pair(left, right, tmp_path / "out", given, volume_of=volume_of)
