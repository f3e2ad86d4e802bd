"""With exact seams any tiling gives the result of the whole image, byte for byte."""

import shutil

import numpy as np
import pytest
from helpers import hashes, write_pair

from sat_intervals import RunError, Window, match_pair
from sat_intervals.demo import make_scene
from sat_intervals.run import pair as run

SETTINGS = {
    "satellite": {"preset": "satellite"},
    "gradients": {"sgm": {"penalty": "negative", "alpha": 0.5, "gamma": 40}, "cross_check": None},
    "window 3": {"cost": {"window": 3}},
    "no SGM": {"sgm": None},
    "accurate": {"cross_check": {"method": "accurate"}},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A pair with no data inside."""
    folder = tmp_path_factory.mktemp("pair")
    scene = make_scene(140, 150, seed=5)
    random = np.random.default_rng(0)
    for image in (scene.left, scene.right):
        image[random.integers(0, 140, 20), random.integers(0, 150, 20)] = 0
        image[60:75, 100:130] = 0
    write_pair(folder, scene)
    return folder


@pytest.fixture(scope="module")
def whole(folder):
    """A run with the settings of the paper in one tile."""
    match(folder, folder / "whole", 1024, {})
    return folder / "whole"


def match(folder, out, size, settings, **options):
    search = {"disparity": {"minimum": -8, "maximum": 9}, "tiles": {"size": size, "overlap": "exact"}}
    return match_pair(folder / "left.tif", folder / "right.tif", out, search | settings, **options)


@pytest.mark.parametrize("name", SETTINGS)
def test_match_pair__of_exact_tiles_equals_the_whole(folder, tmp_path, name):
    settings = SETTINGS[name]
    whole = match(folder, tmp_path / "whole", 1024, settings)
    tiled = match(folder, tmp_path / "tiled", 64, settings | {"cluster": {"workers": 2}})
    assert hashes(tmp_path / "tiled") == hashes(tmp_path / "whole")
    assert tiled["counts"] == whole["counts"]
    assert (tiled["tiles"]["overlap"], tiled["overlap_left"]) == ("exact", None)


def test_match_pair__of_exact_tiles_equals_one_tile_with_overlap(folder, whole, tmp_path):
    match(folder, tmp_path / "tiled", 64, {})
    match(folder, tmp_path / "alone", 1024, {"tiles": {"size": 1024, "overlap": 20}})
    assert hashes(tmp_path / "tiled") == hashes(tmp_path / "alone") == hashes(whole)


def test_match_pair__of_exact_tiles_of_a_window_equals_one_tile(folder, tmp_path):
    window = Window(20, 30, 101, 110)
    for size in (64, 1024):
        match(folder, tmp_path / str(size), size, {}, window=window)
    assert hashes(tmp_path / "64") == hashes(tmp_path / "1024")


def flip(files):
    for file in files:
        file.write_bytes(file.read_bytes()[:-1] + b"x")


def exchange(files):
    if len(files) > 1:  # else one was found to be damaged, and removed
        first, second = sorted(files)  # of the same shape
        content = first.read_bytes()
        first.write_bytes(second.read_bytes())
        second.write_bytes(content)


DAMAGES = {
    "short": lambda files: [file.write_bytes(b"short") for file in files],
    "flipped": flip,
    "exchanged": exchange,
}


@pytest.mark.parametrize("how", DAMAGES)
def test_match_pair__computes_damaged_path_states_again(folder, whole, tmp_path, monkeypatch, how):
    def damage_and_match(job, tile):
        DAMAGES[how](list((tmp_path / "out" / "tiles" / "borders").glob("1_[01]_0")))
        return match_tile(job, tile)

    match_tile = run.match_tile
    with monkeypatch.context() as patch:
        patch.setattr(run, "match_tile", damage_and_match)
        with pytest.raises(RunError, match="missing or damaged: rerun the same command: it resumes"):
            match(folder, tmp_path / "out", 64, {})
    match(folder, tmp_path / "out", 64, {})
    assert hashes(tmp_path / "out") == hashes(whole)
    assert not (tmp_path / "out" / "tiles").exists()


def test_match_pair__takes_no_path_states_of_another_run(folder, whole, tmp_path, monkeypatch):
    def end(job, tile):
        raise RunError("before the first tile")

    borders = tmp_path / "out" / "tiles" / "borders"
    with monkeypatch.context() as patch:
        patch.setattr(run, "match_tile", end)
        for settings in ({"sgm": {"p2": 30}}, {}):
            if borders.exists():
                shutil.move(tmp_path / "out", tmp_path / "other")
            with pytest.raises(RunError, match="before the first tile"):
                match(folder, tmp_path / "out", 64, settings)
    for file in (tmp_path / "other" / "tiles" / "borders").iterdir():
        shutil.copy(file, borders)
    match(folder, tmp_path / "out", 64, {})
    assert hashes(tmp_path / "out") == hashes(whole)


@pytest.mark.peer("onnxruntime", "mc_cnn")
@pytest.mark.parametrize(
    ("preset", "method"),
    [(preset, method) for preset in ("paper", "satellite") for method in ("fast", "accurate")]
    + [("mccnn", "fast"), ("satellite-mccnn", "accurate")],
)
def test_match_pair__of_exact_tiles_equals_the_whole_on_a_real_pair(shared_data, tmp_path, preset, method):
    settings = {
        "preset": preset,
        "disparity": {"minimum": -25, "maximum": 20},
        "cross_check": {"method": method},
    }
    files = [shared_data / "us3d_jax_079" / f"{side}.tif" for side in ("left", "right")]
    for size, workers in ((64, 2), (128, 1), (256, 1)):
        more = {"tiles": {"size": size}, "cluster": {"workers": workers}}
        match_pair(*files, tmp_path / str(size), settings | more, window=Window(300, 400, 150, 240))
    assert hashes(tmp_path / "64") == hashes(tmp_path / "128") == hashes(tmp_path / "256")
