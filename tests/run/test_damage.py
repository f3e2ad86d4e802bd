"""Damaged intermediate files of every kind: right bytes, and nothing else is made again."""

import pytest
from helpers import hashes, write_pair
from networks import random_weights, write_network
from store.test_tiles import DAMAGES

from sat_intervals import match_pair
from sat_intervals.demo import make_scene
from sat_intervals.errors import RunError
from sat_intervals.run import pair as run
from sat_intervals.run.tile import match_block
from sat_intervals.store.tiles import BORDERS, COSTS, ONCE, PARTS, PIXELS, TILES

# A file of each kind, and the stage before which it is damaged.
FILES = {
    f"{BORDERS}/0_1_0": "tiles",
    f"{PIXELS}/1_1": "tiles",
    f"{COSTS}/1_1": "tiles",
    f"{ONCE}/statistics": "tiles",
    f"{ONCE}/begun": "tiles",
    f"{TILES}/1_0": "bands",
    f"{PARTS}/0_0": "files",
}


# Of MC-CNN only.
OF_NETWORK = f"{COSTS}/1_1", f"{ONCE}/statistics"


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """By whether it is matched with MC-CNN: images and settings of 2 x 3 tiles, and a run."""
    found = {}
    for has_network in (False, True):
        folder = tmp_path_factory.mktemp("scene")
        write_network(folder / "weights.onnx", random_weights())
        more = {"preset": "mccnn", "cost": {"weights": str(folder / "weights.onnx")}} if has_network else {}
        more |= {"tiles": {"size": 64}, "cluster": {"workers": 1}}
        found[has_network] = folder, write_pair(folder, make_scene(70, 132, seed=1), **more)
        match_pair(folder / "left.tif", folder / "right.tif", folder / "whole", found[has_network][1])
    return found


def matched(scene, out, **options):
    """Match a scene; a damage that ends the run is mended by the same call."""
    folder, settings = scene
    try:
        match_pair(folder / "left.tif", folder / "right.tif", out, settings, **options)
    except RunError:
        match_pair(folder / "left.tif", folder / "right.tif", out, settings)
    assert hashes(out) == hashes(folder / "whole")


class StoppedError(Exception):
    """As a kill between two steps."""


def stopped_at(stage):
    """A callback of progress that stops a run in a stage, once something is done there."""

    def progress(now, done, total):
        if now == stage and (done or stage != "tiles"):
            raise StoppedError

    return progress


def damage(file, how):
    content = file.read_bytes()
    file.unlink()
    if DAMAGES[how]:
        file.write_bytes(DAMAGES[how](content))


@pytest.mark.parametrize("how", DAMAGES)
@pytest.mark.parametrize("name", FILES)
def test_match_pair__makes_a_damaged_file_of_each_kind_again(scenes, tmp_path, name, how):
    file, is_done = tmp_path / "out" / "tiles" / f"{name}.npz", False

    def progress(stage, done, total):
        nonlocal is_done
        if stage == FILES[name] and not is_done and file.exists():
            is_done = True
            damage(file, how)

    matched(scenes[name in OF_NETWORK], tmp_path / "out", progress=progress)
    assert is_done


@pytest.mark.parametrize("how", DAMAGES)
@pytest.mark.parametrize(("stage", "kind"), [("tiles", BORDERS), ("bands", TILES), ("files", PARTS)])
def test_match_pair__resumes_where_all_files_of_a_kind_are_damaged(scenes, tmp_path, stage, kind, how):
    with pytest.raises(StoppedError):
        matched(scenes[False], tmp_path / "out", progress=stopped_at(stage))
    for file in (tmp_path / "out" / "tiles" / kind).iterdir():
        damage(file, how)
    matched(scenes[False], tmp_path / "out")


def test_match_pair__ends_where_a_disk_damages_all_files_written(scenes, tmp_path, monkeypatch):
    def and_damage(job, block):
        match_block(job, block)
        for tile in job.store.grid.within(block.core):
            damage(job.out / "tiles" / TILES / f"{tile.name}.npz", "one bit")

    folder, settings = scenes[False]
    monkeypatch.setattr(run, "match_block", and_damage)
    with pytest.raises(RunError, match=r"^tiles 0_0, .*, 1_2 in .* are damaged or missing: rerun the same command"):
        match_pair(folder / "left.tif", folder / "right.tif", tmp_path / "out", settings)
    assert not list((tmp_path / "out").glob("*.tif"))
