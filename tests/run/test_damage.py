"""Damaged intermediate files of every kind: right bytes, and nothing else is made again."""

import pytest
from helpers import hashes, write_pair
from networks import random_weights, write_network
from store.test_tiles import DAMAGES

from sat_intervals import match_pair
from sat_intervals.demo import make_scene
from sat_intervals.errors import RunError
from sat_intervals.store.tiles import BORDERS, COSTS, ONCE, PARTS, PIXELS, TILES

# A file of each kind, and the stage before which it is damaged.
FILES = {
    f"{BORDERS}/0_1_0": "tiles",
    f"{PIXELS}/1_1": "tiles",
    f"{ONCE}/begun": "tiles",
    f"{TILES}/1_0": "bands",
    f"{PARTS}/0_0": "files",
}


# Of MC-CNN only.
OF_NETWORK = {f"{COSTS}/1_1": "tiles"}


def made(folder, **more):
    """Write images and settings of 2 x 3 tiles, and match them."""
    more |= {"tiles": {"size": 64}, "cluster": {"workers": 1}}
    settings = write_pair(folder, make_scene(70, 132, seed=1), **more)
    match_pair(folder / "left.tif", folder / "right.tif", folder / "whole", settings)
    return folder, settings


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return made(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def scene_of_network(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    weights = write_network(folder / "weights.onnx", random_weights())
    return made(folder, preset="mccnn", cost={"weights": str(weights)})


def matched(scene, out, **options):
    """Match a scene; a damage that ends the run is mended by the same call."""
    folder, settings = scene
    try:
        match_pair(folder / "left.tif", folder / "right.tif", out, settings, **options)
    except RunError:
        match_pair(folder / "left.tif", folder / "right.tif", out, settings)
    assert hashes(out) == hashes(folder / "whole")


def damage(file, how):
    content = file.read_bytes()
    file.unlink()
    if DAMAGES[how]:
        file.write_bytes(DAMAGES[how](content))


def matched_with_damage(scene, out, name, stage, how):
    """Match a scene, and damage a file once when it is there in a stage."""
    file, is_done = out / "tiles" / f"{name}.npz", False

    def progress(now, done, total):
        nonlocal is_done
        if now == stage and not is_done and file.exists():
            is_done = True
            damage(file, how)

    matched(scene, out, progress=progress)
    assert is_done


@pytest.mark.parametrize("how", DAMAGES)
@pytest.mark.parametrize(("name", "stage"), FILES.items())
def test_match_pair__makes_a_damaged_file_of_each_kind_again(scene, tmp_path, name, stage, how):
    matched_with_damage(scene, tmp_path / "out", name, stage, how)


@pytest.mark.peer("onnxruntime", "mc_cnn")
@pytest.mark.parametrize("how", DAMAGES)
@pytest.mark.parametrize(("name", "stage"), OF_NETWORK.items())
def test_match_pair__makes_damaged_files_of_networks_again(scene_of_network, tmp_path, name, stage, how):
    matched_with_damage(scene_of_network, tmp_path / "out", name, stage, how)
