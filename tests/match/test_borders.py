"""With exact seams any tiling gives the result of the whole image, byte for byte."""

import itertools
import tempfile
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from helpers import PLACE, hashes, write_pair
from hypothesis import given
from hypothesis import strategies as st

from sat_intervals import RunError, Window, match_pair
from sat_intervals.demo import make_scene
from sat_intervals.match import schedule
from sat_intervals.raster import write_layer
from sat_intervals.run import tile
from sat_intervals.store.tiles import Store

SETTINGS = {
    "satellite": {"preset": "satellite"},
    "no SGM": {"preset": "paper", "sgm": None},
    "accurate": {"preset": "paper", "cross_check": {"method": "accurate"}},
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
    base = {"preset": "paper", "disparity": {"minimum": -8, "maximum": 9}, "tiles": {"size": size, "overlap": "exact"}}
    return match_pair(folder / "left.tif", folder / "right.tif", out, base | settings, **options)


@pytest.mark.parametrize("name", SETTINGS)
def test_match_pair__of_exact_tiles_equals_the_whole(folder, tmp_path, name):
    settings = SETTINGS[name]
    whole = match(folder, tmp_path / "whole", 1024, settings)
    tiled = match(folder, tmp_path / "tiled", 64, settings | {"cluster": {"workers": 2}})
    assert hashes(tmp_path / "tiled") == hashes(tmp_path / "whole")
    assert tiled["counts"] == whole["counts"]


@pytest.mark.parametrize("method", ["fast", "accurate"])
def test_match_pair__of_blocks_of_exact_tiles_equals_the_whole(folder, tmp_path, monkeypatch, method):
    monkeypatch.setattr(schedule, "_BLOCKS", 1)  # of 2 x 2 tiles, at the ends of 1 x 2, 2 x 1 and 1 x 1
    for size in (64, 1024):
        match(folder, tmp_path / str(size), size, {"cross_check": {"method": method}})
    assert hashes(tmp_path / "64") == hashes(tmp_path / "1024")


def test_match_pair__resumes_inside_a_block(folder, whole, tmp_path, monkeypatch):
    def write_tile(store, tile, *products, **meta):
        if tile.name == "0_1":  # the last of its block
            raise RunError("killed inside a block")
        return original(store, tile, *products, **meta)

    original = Store.write_tile
    monkeypatch.setattr(schedule, "_BLOCKS", 1)
    with monkeypatch.context() as patch:
        patch.setattr(Store, "write_tile", write_tile)
        with pytest.raises(RunError, match=r"tiles failed(.|\n)*tile 1_1: killed inside a block"):
            match(folder, tmp_path / "out", 64, {"cluster": {"retries": 0}})
    done = {path.stem for path in (tmp_path / "out/tiles/tiles").iterdir()}
    assert "1_0" in done
    assert "0_1" not in done
    match(folder, tmp_path / "out", 64, {"cluster": {"retries": 0}})
    assert hashes(tmp_path / "out") == hashes(whole)


def test_match_pair__names_the_wavefront_that_cannot_be_traced(folder, tmp_path, monkeypatch):
    def fail(job, block, wavefront):
        raise RunError("no reason")

    monkeypatch.setattr(tile, "trace_block", fail)
    with pytest.raises(RunError, match="tile 0_0: tracing its path states, wavefront 0: no reason"):
        match(folder, tmp_path / "out", 64, {})


@pytest.mark.peer("onnxruntime", "mc_cnn")
@pytest.mark.parametrize(
    ("preset", "method"),
    list(itertools.product(("paper", "satellite", "mccnn", "satellite-mccnn"), ("fast", "accurate"))),
)
def test_match_pair__of_exact_tiles_equals_the_whole_on_a_real_pair(shared_data, tmp_path, preset, method):
    settings = {
        "preset": preset,
        "disparity": {"minimum": -25, "maximum": 20},
        "cross_check": {"method": method},
    }
    if method == "accurate":
        settings["interval"] = {"alpha": 0.9}  # built-in calibrations are of fast cross-checking
    files = [shared_data / "us3d_jax_079" / f"{side}.tif" for side in ("left", "right")]
    for size, workers in ((64, 2), (128, 1), (256, 1)):
        more = {"tiles": {"size": size}, "cluster": {"workers": workers}}
        match_pair(*files, tmp_path / str(size), settings | more, window=Window(300, 400, 150, 240))
    assert hashes(tmp_path / "64") == hashes(tmp_path / "128") == hashes(tmp_path / "256")


@given(random=st.randoms(use_true_random=False))
@hypothesis.settings(max_examples=4, deadline=None)
def test_match_pair__of_exact_tiles_equals_the_whole_on_random_pairs(random):
    rows, columns, seed = random.randint(65, 140), random.randint(65, 140), random.randint(0, 2**32)
    p1 = random.randint(1, 40)
    search = random.randint(-20, 5)
    settings = {
        "cost": {"window": random.choice([3, 5, 7])},
        "sgm": {"p1": p1, "p2": random.randint(p1 + 1, 400)},
        "disparity": {"minimum": search, "maximum": search + random.randint(1, 40)},
        "cross_check": {"method": random.choice(["fast", "accurate"])},
    }
    noise = np.random.default_rng(seed)
    left = noise.integers(1, 255, (rows, columns), np.uint8)
    right = np.roll(left, -search, 1) + noise.integers(0, 3, left.shape, np.uint8)
    left[noise.random(left.shape) < 0.01] = 0
    with tempfile.TemporaryDirectory() as folder:
        for name, image in (("left", left), ("right", right)):
            write_layer(Path(folder) / f"{name}.tif", image, 0, PLACE)
        for size in (64, 256):
            match(Path(folder), Path(folder) / str(size), size, settings)
        assert hashes(Path(folder) / "64") == hashes(Path(folder) / "256")
