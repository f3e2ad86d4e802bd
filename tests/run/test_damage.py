"""A damaged store, or one in a folder with files of the user: right bytes or a clear error, and nothing lost."""

import errno
import itertools
import json
import os
import shutil
import signal
from contextlib import suppress
from functools import reduce
from operator import getitem
from pathlib import Path

import numpy as np
import pytest
import yaml
import zarr
from helpers import OUTPUTS, hashes, invoke, write_pair
from networks import random_weights, write_network

from sat_intervals import match_pair
from sat_intervals.config import load_config
from sat_intervals.config.pairs import PairOfBatch
from sat_intervals.demo import make_scene
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.results import open_run
from sat_intervals.run import before, output
from sat_intervals.run import pair as run
from sat_intervals.run.assemble import assemble
from sat_intervals.run.batch import match_batch
from sat_intervals.run.job import prepare
from sat_intervals.run.tile import match_block
from sat_intervals.store import local, removal
from sat_intervals.store.local import MADE, LocalFolder, mark
from sat_intervals.store.removal import drop
from sat_intervals.store.tiles import DamagedTilesError, Store

SHARDS = ["arrays.zarr/int16/c/0/1/0", "arrays.zarr/uint32/c/0/1/0", "arrays.zarr/right/c/1/0"]
CHUNKS = ["arrays.zarr/seams/c/1/0/0/0/0/0", "arrays.zarr/histogram/c/1/0/0"]
DESCRIPTIONS = [
    f"arrays.zarr/{array}zarr.json" for array in ("", "int16/", "uint32/", "right/", "seams/", "histogram/")
]
DAMAGES = {
    "empty": lambda content: b"",
    "half": lambda content: content[: len(content) // 2],
    "bit": lambda content: (
        content[: len(content) // 2] + bytes([content[len(content) // 2] ^ 1]) + content[len(content) // 2 + 1 :]
    ),
    "no text": lambda content: b"\xff\xfe" + content,
    "zeros": lambda content: bytes(len(content)),  # as some file systems leave it after a power loss
    "gone": None,
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder with left.tif, right.tif, settings.yaml of 2 x 3 tiles, and a run of it that kept its tiles."""
    folder = tmp_path_factory.mktemp("scene")
    more = {"tiles": {"size": 64, "overlap": 10}, "cluster": {"workers": 1}}
    settings = write_pair(folder, make_scene(70, 132, seed=1), **more)
    match_pair(folder / "left.tif", folder / "right.tif", folder / "kept", settings, keep_tiles=True)
    return folder


def match(scene, out, *options, status=0):
    """``match`` in this process: what it said."""
    command = ["match", scene / "left.tif", scene / "right.tif", out, "--config", scene / "settings.yaml", "--quiet"]
    result = invoke(*command, *options)
    assert result.exit_code == status, result.stderr
    assert "should not happen" not in result.stderr
    assert status == 0 or len(result.stderr.splitlines()) == 1, result.stderr
    return result.stderr


def unfinished(scene, out):
    """A copy of the run with its tiles, as if it had not finished."""
    shutil.copytree(scene / "kept", out)
    for name in OUTPUTS:
        (out / name).unlink()
    return out / "tiles"


def damage(file, how):
    if DAMAGES[how] is None:
        file.unlink()
    else:
        file.write_bytes(DAMAGES[how](file.read_bytes()))


def assert_same(scene, out):
    assert hashes(out) == hashes(scene / "kept")


# Every damage to one file of a kind, and some to each of the others.
THOROUGH = itertools.product(["manifest.json", "records/1_0.json", SHARDS[1], DESCRIPTIONS[0]], DAMAGES)
ONCE = itertools.product([SHARDS[0], SHARDS[2], *CHUNKS, *DESCRIPTIONS[1:]], ["empty", "bit"])
MARK = ".sat-intervals.tiles"


@pytest.mark.parametrize(("name", "how"), [*THOROUGH, *ONCE, (MARK, "zeros")])
def test_match__of_a_damaged_store_gives_the_right_bytes_or_names_the_way_out(scene, tmp_path, name, how):
    tiles = unfinished(scene, tmp_path / "out")
    before = {file: file.stat().st_mtime_ns for file in (tiles / "records").iterdir()}
    damage(tiles / name, how)
    if name == "manifest.json" and how in ("half", "bit", "no text", "zeros"):
        assert f"{tiles}/manifest.json cannot be read, " in (said := match(scene, tmp_path / "out", status=2))
        assert "--overwrite" in said
        match(scene, tmp_path / "out", "--overwrite")
    else:
        match(scene, tmp_path / "out", "--keep-tiles")
        if name != "manifest.json":
            again = {file for file in before if file.stat().st_mtime_ns != before[file]}
            assert again == (set() if name in (*DESCRIPTIONS, MARK) else {tiles / "records" / "1_0.json"})
    assert_same(scene, tmp_path / "out")


def test_match__matches_tiles_again_that_were_exchanged(scene, tmp_path):
    shards = unfinished(scene, tmp_path / "out") / "arrays.zarr/uint32/c/0/0"
    (shards / "0").rename(shards / "9")
    (shards / "1").rename(shards / "0")
    (shards / "9").rename(shards / "1")
    match(scene, tmp_path / "out")
    assert_same(scene, tmp_path / "out")


def test_match__matches_kept_tiles_again_that_were_damaged_after_its_strips_were_finished(scene, tmp_path):
    def stop(stage, done, total):
        if stage == "files":
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        match_pair(scene / "left.tif", scene / "right.tif", out, scene / "settings.yaml", progress=stop)
    intact = (out / "tiles" / SHARDS[0]).read_bytes()
    damage(out / "tiles" / SHARDS[0], "zeros")
    assert "are damaged" in match(scene, out, "--keep-tiles")
    assert (out / "tiles" / SHARDS[0]).read_bytes() == intact
    assert_same(scene, out)


def test_match__matches_tiles_again_that_are_of_another_run(scene, tmp_path):
    other = tmp_path / "other"
    settings = yaml.safe_load((scene / "settings.yaml").read_text())
    match_pair(scene / "right.tif", scene / "left.tif", other, settings, keep_tiles=True)
    tiles = unfinished(scene, tmp_path / "out")
    for name in ("records", "arrays.zarr"):
        shutil.copytree(other / "tiles" / name, tiles / name, dirs_exist_ok=True)
    match(scene, tmp_path / "out")
    assert_same(scene, tmp_path / "out")


@pytest.mark.parametrize("name", [SHARDS[0], SHARDS[2], CHUNKS[1]])
def test_match__heals_what_is_damaged_before_it_is_assembled(scene, tmp_path, monkeypatch, name):
    log = tmp_path / "log"
    log.touch()

    def and_damage(job, tile):
        match_block(job, tile)
        if tile.name == "1_0" and tile.name not in log.read_text():
            damage(job.store.home / name, "bit")
        with log.open("a") as file:
            print(tile.name, file=file)

    monkeypatch.setattr(run, "match_block", and_damage)
    said = match(scene, tmp_path / "out")
    assert f"tiles 1_0 in {tmp_path}/out/tiles are damaged" in said
    assert sorted(log.read_text().split()) == ["0_0", "0_1", "0_2", "1_0", "1_0", "1_1", "1_2"]
    assert_same(scene, tmp_path / "out")


def test_match__ends_where_a_disk_damages_all_files_written(scene, tmp_path, monkeypatch):
    def and_damage(job, tile):
        match_block(job, tile)
        damage(job.store.home / f"arrays.zarr/uint32/c/0/{tile.grid_row}/{tile.grid_column}", "bit")

    settings = yaml.safe_load((scene / "settings.yaml").read_text())
    with monkeypatch.context() as patch:
        patch.setattr(run, "match_block", and_damage)
        with pytest.raises(
            RunError, match=r"^tiles 0_0, .*, 1_2 in .* are damaged: rerun the same command: it matches them"
        ):
            match_pair(scene / "left.tif", scene / "right.tif", tmp_path / "out", settings)
    assert not list((tmp_path / "out").glob("*.*"))
    match(scene, tmp_path / "out")
    assert_same(scene, tmp_path / "out")


def test_match__in_a_file_system_of_fsspec_checks_what_it_reads(scene, tmp_path):
    import fsspec

    store = ("--store", "memory://damaged", "--keep-tiles")
    match(scene, tmp_path / "out", *store)
    memory = fsspec.filesystem("memory")
    (tmp_path / "out" / "run.json").unlink()
    (shard,) = (name for name in memory.find("/damaged") if name.endswith("/uint32/c/0/1/0"))
    memory.pipe_file(shard, DAMAGES["bit"](memory.cat_file(shard)))
    assert "are damaged" in match(scene, tmp_path / "out", *store)
    assert_same(scene, tmp_path / "out")


def test_strips__of_a_file_that_changes_between_two_of_them_end(tmp_path, scene):
    settings = write_pair(tmp_path, make_scene(256, 80, seed=3), tiles={"size": 256, "overlap": 10})
    images = tmp_path / "left.tif", tmp_path / "right.tif"
    job = prepare(*images, tmp_path / "out", settings)
    match_pair(*images, tmp_path / "out", settings, keep_tiles=True)
    assert len(list(job.store.strips(128, job.store.records()))) == 2
    strips = job.store.strips(128, job.store.records())
    next(strips)
    damage(tmp_path / "out/tiles/arrays.zarr/uint32/c/0/0/0", "bit")
    with pytest.raises(DamagedTilesError, match=r"tiles 0_0 in .* are damaged"):
        next(strips)


@pytest.mark.peer("onnxruntime", "mc_cnn")
@pytest.mark.parametrize("how", [*DAMAGES, "of another run"])
def test_match__measures_images_again_where_their_figures_are_damaged(scene, tmp_path, how):
    weights = write_network(tmp_path / "network.onnx", random_weights())
    settings = yaml.safe_load((scene / "settings.yaml").read_text())
    settings |= {"cost": {"method": "mccnn", "weights": str(weights)}}
    images, out = (scene / "left.tif", scene / "right.tif"), tmp_path / "out"
    once = match_pair(*images, out, settings, keep_tiles=True)
    expected = hashes(out)
    for name in ("run.json", "tiles/records/0_0.json"):
        (out / name).unlink()
    figures = out / "tiles" / "normalization.json"
    if how == "of another run":
        match_pair(*images[::-1], tmp_path / "other", settings, keep_tiles=True)
        shutil.copy(tmp_path / "other" / "tiles" / "normalization.json", figures)
    else:
        damage(figures, how)
    again = match_pair(*images, out, settings)
    assert again["normalization"] == once["normalization"]
    assert hashes(out) == expected


@pytest.mark.peer("onnxruntime", "mc_cnn")
def test_match__measures_images_again_where_their_figures_are_damaged_before_it_is_assembled(
    scene, tmp_path, monkeypatch
):
    weights = write_network(tmp_path / "network.onnx", random_weights())
    settings = yaml.safe_load((scene / "settings.yaml").read_text())
    settings |= {"cost": {"method": "mccnn", "weights": str(weights)}}
    damaged = []

    def damage_and_assemble(job, *arguments, **named):
        if not damaged:
            damaged.append(job.store.normalization())
            damage(job.store.home / "normalization.json", "empty")
        return assemble(job, *arguments, **named)

    monkeypatch.setattr(run, "assemble", damage_and_assemble)
    report = match_pair(scene / "left.tif", scene / "right.tif", tmp_path / "out", settings)
    assert report["normalization"] == damaged[0]


@pytest.mark.parametrize("text", ["", "{", "5", "\xff"])
def test_match__finds_its_tiles_where_the_note_of_their_place_is_damaged(scene, tmp_path, text):
    store = ("--store", tmp_path / "store", "--keep-tiles")
    match(scene, tmp_path / "out", *store)
    (tmp_path / "out" / "run.json").unlink()
    note = tmp_path / "out" / "tiles" / ".sat-intervals.store"
    note.write_text(text, encoding="latin-1")
    said = match(scene, tmp_path / "out", status=2)
    assert f"{note} cannot be read: give the same --store as before to resume, or --overwrite" in said
    records = {file: file.stat().st_mtime_ns for file in (tmp_path / "store").glob("*/records/*")}
    assert len(records) == 6
    match(scene, tmp_path / "out", *store)
    assert {file: file.stat().st_mtime_ns for file in records} == records
    assert_same(scene, tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("records/1_0.json", b"{}"),
        ("records/1_0.json", b'{"files": 5}'),
        ("manifest.json", b"[]"),
        ("manifest.json", b'{"region": "\xff"}'),
        ("failures/1_0.json", b"\xff{"),
    ],
)
def test_status__of_a_damaged_store_says_what_it_can(scene, tmp_path, name, content):
    tiles = unfinished(scene, tmp_path / "out")
    (tiles / "records/1_0.json").unlink()
    (tiles / name).write_bytes(content)
    result = invoke("status", tmp_path / "out")
    assert len(result.output.splitlines()) == 1 + name.startswith("failures")
    assert ("--overwrite" if name == "manifest.json" else "5 of 6 tiles done") in result.output
    match(scene, tmp_path / "out", *(["--overwrite"] if name == "manifest.json" else []))
    assert_same(scene, tmp_path / "out")


def dies(*arguments, **named):
    raise RunError("killed")


@pytest.mark.parametrize("elsewhere", [False, True])
@pytest.mark.parametrize(("is_begun", "mark"), [(False, None), *itertools.product([True], ["half", "bit", "zeros"])])
def test_match__removes_tiles_that_a_death_left_beside_its_result(
    scene, tmp_path, monkeypatch, is_begun, elsewhere, mark
):
    out, store = tmp_path / "out", ["--store", tmp_path / "store"] if elsewhere else []
    with monkeypatch.context() as patch:
        patch.setattr(Store, "remove", dies)
        match(scene, out, *store, status=1)
    report = (out / "run.json").read_bytes()
    if is_begun:
        for file in tmp_path.rglob("manifest.json"):
            file.unlink()
        for file in tmp_path.rglob(MARK):
            damage(file, mark)
    assert f"{out} already holds a run" in match(scene, out, *store, "--tile-size", "128", status=2)
    settings = yaml.safe_load((scene / "settings.yaml").read_text()) | {"median": None}  # of which no tile knows
    with pytest.raises(SatIntervalsError, match="already holds a run"):
        match_pair(scene / "left.tif", scene / "right.tif", out, settings)
    assert list(tmp_path.rglob("records/*.json"))
    assert match(scene, out, *store) == (
        f"sat-intervals: the run in {out} was already complete; its remaining tiles were removed\n"
    )
    assert sorted(path.name for path in out.iterdir()) == OUTPUTS
    assert not list(tmp_path.rglob("arrays.zarr"))
    assert (out / "run.json").read_bytes() == report
    assert "already holds a run" in match(scene, out, *store, status=2)


def test_match__does_not_say_that_it_removed_tiles_without_a_sign_of_a_run(scene, tmp_path, monkeypatch):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(Store, "remove", dies)
        match(scene, out, status=1)
    for name in ("manifest.json", MARK):
        (out / "tiles" / name).unlink()
    tiles = contents(out / "tiles" / "arrays.zarr")
    assert match(scene, out) == (
        f"sat-intervals: files in {out}/tiles stay: they have no sign that they are of this run\n"
        f"sat-intervals: the run in {out} was already complete\n"
    )
    assert contents(out / "tiles" / "arrays.zarr") == tiles


@pytest.mark.parametrize("way", ["copy", "renamed"])
def test_match__overwrites_no_tiles_in_a_store_that_the_original_of_its_folder_made(scene, tmp_path, way):
    store, out, other = (tmp_path / name for name in ("store", "out", "other"))
    match(scene, out, "--store", store, "--keep-tiles")
    (folder,) = store.iterdir()
    before = contents(folder)
    shutil.copytree(out, other) if way == "copy" else out.rename(other)
    match(scene, other, "--store", store, "--overwrite", "--tile-size", "128")
    assert folder.exists() == (way == "copy")
    if way == "copy":
        assert contents(folder) == before
        match(scene, out, "--store", store, "--overwrite", "--tile-size", "128")
    assert not any(store.iterdir())


@pytest.mark.parametrize("text", ["", "{", "5", '"/a\\u0000"', '"s3://bucket/tiles"', '"/dev/null"'])
def test_match__overwrites_tiles_whose_note_of_their_maker_is_damaged(scene, tmp_path, text):
    store = tmp_path / "store"
    match(scene, tmp_path / "out", "--store", store, "--keep-tiles")
    (note,) = store.glob("*/.sat-intervals.home")
    assert json.loads(note.read_text()) == str(tmp_path / "out" / "tiles")
    note.write_text(text)
    match(scene, tmp_path / "out", "--store", store, "--overwrite", "--tile-size", "128")
    assert not any(store.iterdir())


def test_match__names_a_link_in_the_place_of_its_folder_in_a_store(scene, tmp_path):
    store = tmp_path / "store"
    match(scene, tmp_path / "out", "--store", store, "--keep-tiles")
    (folder,) = store.iterdir()
    folder.symlink_to(folder.rename(tmp_path / "elsewhere"))
    said = match(scene, tmp_path / "other", "--store", store, status=2)
    assert f"{folder} is a symbolic link: move it away\n" in said


@pytest.mark.parametrize("how", ["empty", "half", "gone"])
def test_match__overwrites_tiles_in_a_store_whose_manifest_a_power_loss_damaged(scene, tmp_path, how):
    out, store = tmp_path / "out", tmp_path / "store"
    match(scene, out, "--store", store, "--keep-tiles")
    (manifest,) = store.glob("*/manifest.json")
    damage(manifest, how)
    match(scene, out, "--overwrite", "--store", store, "--tile-size", "128")
    assert not list(store.glob("*/records/*"))


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("how", ["half", "bit", "gone"])
@pytest.mark.parametrize("moment", ["with its tiles", "with kept tiles", "without its tiles"])
def test_match__fails_where_its_files_are_changed_before_it_ends(scene, tmp_path, monkeypatch, name, how, moment):
    out = tmp_path / "out"
    file, step = out / name, Store.remove if moment == "without its tiles" else Store.mark_replaced

    def changed_after(store):
        done = step(store)
        damage(file, how)
        return done

    with monkeypatch.context() as patch:
        patch.setattr(Store, step.__name__, changed_after)
        said = match(scene, out, *["--keep-tiles"] * (moment == "with kept tiles"), status=1)
    way_out = "delete it and rerun the same command" if moment == "with its tiles" else "move it away and rerun with"
    assert f"{file} was changed or moved away before the run ended: {way_out}" in said
    file.unlink(missing_ok=True)
    match(scene, out, *["--overwrite"] * (moment != "with its tiles"))
    assert_same(scene, out)
    assert not (out / "tiles").exists()


@pytest.mark.parametrize(
    ("name", "how"),
    [("intervals.tif", "half"), ("validity.tif", "bit"), *itertools.product(["run.json"], ["half", "bit", "empty"])],
)
def test_match__keeps_the_tiles_of_a_dead_run_whose_files_were_changed(scene, tmp_path, monkeypatch, name, how):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(Store, "remove", dies)
        match(scene, out, status=1)
    damage(out / name, how)
    said = match(scene, out, status=2)
    assert f"{out / name} was changed after the run, but the tiles still exist: delete it" in said
    assert (out / name).stat().st_size == 0 or how != "empty"
    (out / name).unlink()
    match(scene, out)
    assert_same(scene, out)
    assert sorted(path.name for path in out.iterdir()) == OUTPUTS


MARKS = [".sat-intervals.finished", ".sat-intervals.replacing"]


@pytest.mark.parametrize("name", ["manifest.json", ".sat-intervals.store", *MARKS, "arrays.zarr/zarr.json"])
@pytest.mark.parametrize(("make", "kind"), [(os.mkfifo, "a named pipe"), (os.mkdir, "a folder: move it away\n")])
def test_match__names_a_pipe_or_folder_among_its_tiles(scene, tmp_path, name, make, kind):
    tiles = unfinished(scene, tmp_path / "out")
    (tiles / name).unlink(missing_ok=True)
    make(tiles / name)
    assert f"{tiles / name} is {kind}" in match(scene, tmp_path / "out", status=2)


def test_match__names_a_report_that_it_may_not_read(scene, tmp_path, monkeypatch):
    out = shutil.copytree(scene / "kept", tmp_path / "out")

    def refused(path):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(output, "open_regular", refused)
    said = match(scene, out, "--overwrite", status=2)
    assert f"{out / 'run.json'} cannot be read: Permission denied: change its rights\n" in said


def with_files(folder, names):
    """Files of the user, with their content."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(f"mine: {name}")
    return {folder / name: f"mine: {name}" for name in names}


def contents(folder):
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def assert_kept(mine):
    assert {file: file.read_text() for file in mine} == mine


@pytest.mark.parametrize("elsewhere", [False, True])
def test_match__keeps_files_of_the_user_in_the_folder_of_its_tiles(scene, tmp_path, monkeypatch, elsewhere):
    out, options = tmp_path / "out", ["--store", tmp_path / "store"] if elsewhere else []
    match(scene, out, *options, "--keep-tiles")
    (tiles,) = (file.parent for file in tmp_path.rglob("manifest.json"))
    shutil.rmtree(tiles)
    shutil.rmtree(out)
    names = [
        "notes.txt",
        "store.json",
        "records/notes.json",
        "failures/all.json",
        "borders/notes",
        "costs/notes",
        "parts/notes",
        "arrays.zarr/int16/table",
        "arrays.zarr/.zattrs",
    ]
    mine = with_files(tiles, names)
    top = [
        "records/0_0.json", "failures/0_0.json", "arrays.zarr/zarr.json", "normalization.json", "manifest.json"
    ]  # fmt: skip
    if elsewhere:
        mine |= with_files(tmp_path / "store", top)
    match(scene, out, *options)
    assert_kept(mine)
    match(scene, out, *options, "--overwrite", "--keep-tiles")
    assert_kept(mine)
    mine |= with_files(tiles, ["records/77_0.json"])
    with monkeypatch.context() as patch:
        patch.setattr(run, "assemble_repaired", dies)
        match(scene, out, *options, "--overwrite", status=1)
    assert_kept(mine)
    match(scene, out, *options, "--overwrite")
    assert_kept(mine)
    assert {file for file in tiles.rglob("*") if file.is_file()} == {file for file in mine if tiles in file.parents}


def begun(scene, out, **overrides):
    config = load_config(scene / "settings.yaml", overrides)
    job = prepare(scene / "left.tif", scene / "right.tif", out, config)
    job.begin()
    return job


@pytest.mark.parametrize("elsewhere", [False, True])
@pytest.mark.parametrize("name", ["", "records", "arrays.zarr", "arrays.zarr/int16/c/0"])
def test_match_block__keeps_files_behind_a_folder_that_becomes_a_link(scene, tmp_path, name, elsewhere):
    job = begun(scene, tmp_path / "out", cluster={"store": str(tmp_path / "store") if elsewhere else None})
    first, second, *_ = job.store.grid
    match_block(job, first)
    folder, user = job.store.folder.place(name), tmp_path / "user"
    folder.rename(user)
    folder.symlink_to(user)
    written = {str(file.relative_to(user)) for file in user.rglob("*") if file.is_file()}
    kept = {user / name: (user / name).read_text() for name in written & {"manifest.json", MARK}}
    mine = kept | with_files(user, written - {file.name for file in kept})
    with pytest.raises(OSError, match=f"{folder} has become a symbolic link"):
        match_block(job, second)
    for delete in (lambda: job.store._arrays.drop(first), job.store.remove):
        with suppress(OSError):
            delete()
    assert_kept(mine)
    assert {file for file in user.rglob("*") if file.is_file()} == set(mine)


def unmarked(another, tmp_path):
    """A folder of the user's with names of a run's files."""
    of_tile = [name.replace("/1/0", "/0/0") for name in (*SHARDS, *CHUNKS)]
    with_files(tmp_path / "mine", [*of_tile, "records/0_0.json", "normalization.json", "range.json"])
    return tmp_path / "mine"


def marked(another, tmp_path):
    """The tiles of another run."""
    return another.store.home


@pytest.mark.parametrize("elsewhere", [False, True])
@pytest.mark.parametrize("taken_by", [unmarked, marked])
def test_store__changes_nothing_in_a_folder_that_takes_the_place_of_its_own(scene, tmp_path, elsewhere, taken_by):
    """Also in a worker, which has no lock; a store elsewhere has none either."""
    job = begun(scene, tmp_path / "out", cluster={"store": str(tmp_path / "store") if elsewhere else None})
    another = begun(scene, tmp_path / "another", sgm={"p1": 9})
    first, *_ = job.store.grid
    match_block(another, first)
    place = Path(str(job.store.folder))
    place.rename(tmp_path / "moved")
    there = taken_by(another, tmp_path).rename(place)
    mine = contents(there)
    writes = [
        lambda: match_block(job, first),
        lambda: job.store.write_record(first, {"files": {}}),
        lambda: job.store.write_normalization({}),
        lambda: job.store.write_search({}, ""),
        lambda: job.store.steps.write("pixels", "0_0", np.zeros(1)),
        lambda: job.parts().begin(),
        lambda: job.store._arrays.drop(first),
        lambda: drop(job.store.folder),
    ]
    for write in writes:
        with suppress(OSError, SatIntervalsError):
            write()
        assert contents(there) == mine


@pytest.mark.parametrize("moment", ["opened", "written"])
@pytest.mark.parametrize("name", [MARK, "manifest.json", "records/0_0.json"])
def test_write__changes_nothing_in_a_folder_that_takes_the_place_of_an_open_one(tmp_path, monkeypatch, moment, name):
    for folder in ("own", "mine"):
        with_files(tmp_path / folder, ["manifest.json", "records/0_0.json"])
        (tmp_path / folder / MARK).write_text(mark(folder))
    mine = contents(tmp_path / "mine")
    write_new = local.write_new

    def exchange():
        (tmp_path / "own").rename(tmp_path / "moved")
        (tmp_path / "mine").rename(tmp_path / "own")

    def late(*arguments, **named):
        if moment == "opened":
            exchange()
        write_new(*arguments, **named)
        if moment == "written":
            exchange()

    monkeypatch.setattr(local, "write_new", late)
    LocalFolder(tmp_path / "own").of_run("own").write(name, "new")
    assert {
        tmp_path / "mine" / file.relative_to(tmp_path / "own"): c for file, c in contents(tmp_path / "own").items()
    } == mine
    assert (tmp_path / "moved" / name).read_text() == "new"


def test_match_block__keeps_the_tiles_of_another_run_that_take_the_place_of_its_own(scene, tmp_path):
    job, another = begun(scene, tmp_path / "out"), begun(scene, tmp_path / "another", sgm={"p1": 9})
    first, *_ = job.store.grid
    match_block(another, first)
    (tmp_path / "out" / "tiles").rename(tmp_path / "moved")
    there = (tmp_path / "another" / "tiles").rename(tmp_path / "out" / "tiles")
    before = contents(there)
    writes = [
        lambda: match_block(job, first),
        lambda: job.store.write_record(first, {"files": {}}),
        lambda: job.store.write_normalization({}),
        lambda: job.store.write_search({}, ""),
        lambda: job.store.mark_finished("run", []),
        lambda: job.store.steps.write("pixels", "0_0", np.zeros(1)),
        lambda: job.parts().begin(),
        lambda: job.store._arrays.drop(first),
    ]
    for write in writes:
        with pytest.raises((OSError, SatIntervalsError), match=r"has become the folder of another run|holds the tiles"):
            write()
    job.store.write_failure(first.name, "a reason")
    job.store.remove()
    with pytest.raises(OSError, match="has become the folder of another run"):
        job.store.folder.delete(MARK)  # the last file that a removal deletes
    assert contents(there) == before


def test_delete_all__looks_before_each_file_whose_folder_it_is_in(tmp_path):
    for name in ("ours", "theirs"):
        with_files(tmp_path / name, ["a", "b"])
        (tmp_path / name / MADE).write_text(mark(name))
    before = {file.name: content for file, content in contents(tmp_path / "theirs").items()}

    def names():
        yield "a"
        (tmp_path / "ours").rename(tmp_path / "moved")
        (tmp_path / "theirs").rename(tmp_path / "ours")
        yield "b"

    with pytest.raises(OSError, match="ours has become the folder of another run"):
        LocalFolder(tmp_path / "ours").of_run("ours").delete_all(names())
    assert {file.name: content for file, content in contents(tmp_path / "ours").items()} == before


@pytest.mark.parametrize("command", ["match", "batch"])
def test_commands__remove_the_tiles_whose_removal_was_interrupted(scene, tmp_path, command):
    """The manifest is deleted first: what is left has the mark of its run."""
    pair, store = tmp_path / "out" / "pair", tmp_path / "store"
    (tmp_path / "pairs.csv").write_text(f"name,left,right\npair,{scene / 'left.tif'},{scene / 'right.tif'}\n")
    words = ["batch", tmp_path / "pairs.csv", tmp_path / "out", "--config", scene / "settings.yaml", "--store", store]
    if command == "match":
        match(scene, pair, "--store", store, "--keep-tiles")
        words = ["match", scene / "left.tif", scene / "right.tif", pair, "--config", scene / "settings.yaml"]
        words += ["--store", store, "--overwrite", "--coverage", "0.9"]
    else:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Store, "remove", lambda store: None)
            assert invoke(*words).exit_code == 0
    (left,) = (folder for folder in store.iterdir() if folder.is_dir())
    (left / "manifest.json").unlink()
    assert (left / MADE).exists()
    assert invoke(*words).exit_code == 0
    assert [path.name for path in store.rglob("*") if path.is_file()] == []
    assert sorted(path.name for path in pair.iterdir()) == OUTPUTS


def test_match__ends_before_its_work_where_tiles_of_the_earlier_run_cannot_be_removed(scene, tmp_path, monkeypatch):
    """With a store, too: later it could not mark its end in their folder."""
    out, removed = tmp_path / "out", removal.drop
    words = ["--store", tmp_path / "store", "--overwrite", "--coverage", "0.9"]
    match(scene, out, "--keep-tiles")

    def denied(folder):
        if folder == LocalFolder(out / "tiles"):
            raise PermissionError(13, "Permission denied")
        removed(folder)

    with monkeypatch.context() as patch:
        patch.setattr(removal, "drop", denied)
        assert f"{out}/tiles cannot be removed: Permission denied: make room, check its rights or" in match(
            scene, out, *words, status=2
        )
    match(scene, out, *words)
    assert sorted(path.name for path in out.iterdir()) == OUTPUTS


def test_write_failure__of_a_store_whose_manifest_is_a_pipe_does_not_end_a_batch(scene, tmp_path):
    job = begun(scene, tmp_path / "out")
    (tmp_path / "out" / "tiles" / "manifest.json").unlink()
    os.mkfifo(tmp_path / "out" / "tiles" / "manifest.json")
    job.store.write_failure("0_0", "a reason")
    with pytest.raises(SatIntervalsError, match="is a named pipe"):
        job.store.check(job.manifest)


@pytest.mark.parametrize("how", ["empty", "gone"])
def test_match__keeps_tiles_whose_arrays_can_be_opened(scene, tmp_path, monkeypatch, how):
    """Nothing but those who read the tiles later needs the metadata, which may be damaged during the run."""
    out = tmp_path / "out"
    file = out / "tiles" / "arrays.zarr" / "int16" / "zarr.json"

    def damage_and_assemble(*arguments, **named):
        file.unlink() if how == "gone" else damage(file, how)
        return assemble(*arguments, **named)

    monkeypatch.setattr(run, "assemble", damage_and_assemble)
    match(scene, out, "--keep-tiles")
    assert zarr.open(out / "tiles" / "arrays.zarr", mode="r")["int16"].ndim


@pytest.mark.parametrize("options", [[], ["--overwrite"]])
def test_match__starts_in_a_store_beside_what_a_killed_removal_left(scene, tmp_path, options):
    tiles = tmp_path / "out" / "tiles"
    begun(scene, tmp_path / "out", sgm={"p1": 9})
    (tiles / "manifest.json").unlink()  # the first file that is deleted; the mark is the last
    match(scene, tmp_path / "out", "--store", tmp_path / "store", *options)
    assert_same(scene, tmp_path / "out")


def test_match__overwrites_no_tiles_of_another_run_that_were_moved_into_its_store(scene, tmp_path):
    store = tmp_path / "store"
    job = prepare(scene / "left.tif", scene / "right.tif", tmp_path / "out", scene / "settings.yaml")
    another = begun(scene, tmp_path / "another", sgm={"p1": 9})
    match_block(another, next(iter(another.store.grid)))
    store.mkdir()
    there = (tmp_path / "another" / "tiles").rename(store / job.store.run)
    before = contents(there)
    for options in ([], ["--overwrite"]):
        said = match(scene, tmp_path / "out", "--store", store, *options, status=2)
        assert f"{there} has the tiles of another run, which were moved there: move them away" in said
    assert contents(there) == before


def test_tidy__of_tiles_that_cannot_be_reached_says_so(scene, tmp_path, monkeypatch, caplog):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(Store, "remove", dies)
        match(scene, out, status=1)

    def unreachable(*arguments):
        raise OSError(5, "the server does not answer")

    monkeypatch.setattr(before, "remove_tiles", unreachable)
    before.tidy(out, False, None)
    assert "the tiles of the complete run stay: [Errno 5] the server does not answer" in caplog.text


@pytest.mark.parametrize("name", ["records/0_0.json", *SHARDS[:1], "normalization.json", "manifest.json"])
@pytest.mark.parametrize("options", [[], ["--overwrite"]])
def test_match__never_writes_over_files_of_the_user(scene, tmp_path, name, options):
    mine = with_files(tmp_path / "out" / "tiles", [name])
    said = match(scene, tmp_path / "out", *options, status=2)
    assert f"{tmp_path}/out/tiles has files without a sign of their run, such as {name}: move them away" in said
    assert_kept(mine)


def test_match__takes_an_input_of_a_damaged_manifest_for_unknown(scene, tmp_path):
    tiles = unfinished(scene, tmp_path / "out")
    manifest = json.loads((tiles / "manifest.json").read_text())
    manifest["inputs"]["left"]["sha256"] = manifest["inputs"]["left"]["sha256"][::-1]
    (tiles / "manifest.json").write_text(json.dumps(manifest))
    assert "it is damaged: start again with --overwrite" in match(scene, tmp_path / "out", status=2)


@pytest.mark.parametrize("how", ["half", "bit"])
@pytest.mark.parametrize("name", ["intervals.tif", "validity.tif"])
def test_match_batch__takes_no_damaged_result_for_done(scene, tmp_path, name, how):
    pairs = [PairOfBatch("kept", str(scene / "left.tif"), str(scene / "right.tif"))]
    shutil.copytree(scene / "kept", tmp_path / "kept")
    assert match_batch(pairs, tmp_path, scene / "settings.yaml")["kept"]["state"] == "done before"
    damage(tmp_path / "kept" / name, how)
    before = (tmp_path / "kept" / name).read_bytes()
    shown = match_batch(pairs, tmp_path, scene / "settings.yaml", keep_tiles=True)["kept"]
    assert shown["state"] == "failed"
    assert f"{tmp_path}/kept/{name} " in shown["error"]
    assert shown["error"].endswith("it is damaged or was changed: move it away and match again with --overwrite")
    assert (tmp_path / "kept" / name).read_bytes() == before
    shown = match_batch(pairs, tmp_path, scene / "settings.yaml", overwrite=True)["kept"]
    assert f"{name} exists and was not made by sat-intervals, or was changed since: move it away" in shown["error"]
    (tmp_path / "kept" / name).unlink()
    match_batch(pairs, tmp_path, scene / "settings.yaml", overwrite=True)
    assert_same(scene, tmp_path / "kept")


def test_match__keeps_the_tiles_of_a_dead_run_of_which_a_bit_flipped(scene, tmp_path, monkeypatch):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(Store, "remove", dies)
        match(scene, out, status=1)
    status = (out / "validity.tif").stat()
    damage(out / "validity.tif", "bit")
    os.utime(out / "validity.tif", ns=(status.st_atime_ns, status.st_mtime_ns))
    assert f"{out}/validity.tif is not what the run published" in match(scene, out, status=2)
    assert list((out / "tiles" / "records").glob("*.json"))


@pytest.mark.parametrize("command", ["evaluate OUT", "report OUT", "plot OUT", "export OUT TARGET --to otb"])
def test_commands__refuse_a_result_of_another_size(scene, tmp_path, command):
    shutil.copytree(scene / "kept", tmp_path / "OUT")
    with (tmp_path / "OUT" / "intervals.tif").open("ab") as file:
        file.write(b"0")  # which GDAL does not see
    words = [str(tmp_path / word) if word.isupper() else word for word in command.split()]
    result = invoke(*words)
    assert f"{tmp_path}/OUT/intervals.tif is not what the run published; it is damaged" in result.stderr
    assert result.exit_code == 2


@pytest.mark.parametrize("place", ["tiles region row", "counts valid", "inputs left height", "settings tiles size"])
def test_open_run__refuses_a_report_with_another_number(scene, tmp_path, place):
    shutil.copytree(scene / "kept", tmp_path / "out")
    file = tmp_path / "out" / "run.json"
    report = json.loads(file.read_text())
    *sections, last = place.split()
    section = reduce(getitem, sections, report)
    section[last] += 1
    file.write_text(json.dumps(report))
    with pytest.raises(SatIntervalsError, match=r"run.json: it is damaged or was changed: restore it, or move it away"):
        open_run(tmp_path / "out")
    section[last] -= 1
    file.write_text(json.dumps(report))
    open_run(tmp_path / "out")


@pytest.mark.parametrize("name", ["intervals.tif", "validity.tif"])
@pytest.mark.parametrize(("make", "kind"), [(os.mkfifo, " is a named pipe"), (os.mkdir, ": is a folder")])
def test_open_run__never_waits_for_a_pipe_in_the_place_of_a_raster(scene, tmp_path, name, make, kind):
    out = shutil.copytree(scene / "kept", tmp_path / "out")
    (out / name).unlink()
    make(out / name)
    for command in ("status", "stac", "report"):
        signal.alarm(60)  # ends this process if it waits
        done = invoke(command, out)
        signal.alarm(0)
        assert done.exit_code == 2
        assert f"{name}{kind}: move it away and match again with --overwrite\n" in done.stderr


def test_open_run__of_a_report_without_sizes_opens(scene, tmp_path):
    shutil.copytree(scene / "kept", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    del report["files"], report["crc32"]
    (tmp_path / "out" / "run.json").write_text(json.dumps(report))
    open_run(tmp_path / "out")


@pytest.mark.parametrize("make", [Path.touch, os.mkfifo])
@pytest.mark.parametrize("name", ["records/0_0.json", "arrays.zarr/int16/c/0/0/0"])
def test_match__keeps_empty_files_and_pipes_in_a_folder_without_signs_of_a_run(scene, tmp_path, name, make):
    mine = tmp_path / "out" / "tiles" / name
    mine.parent.mkdir(parents=True)
    make(mine)
    before = mine.lstat()
    said = match(scene, tmp_path / "out", status=2)
    assert f"tiles has files without a sign of their run, such as {name}: move them away" in said
    assert os.path.samestat(mine.lstat(), before)


def test_match__goes_on_after_a_kill_at_the_first_file_of_its_tiles(scene, tmp_path):
    unfinished = tmp_path / "out" / "tiles" / "arrays.zarr" / f".zarr.json.{'0123456789abcdef' * 2}"
    unfinished.parent.mkdir(parents=True)
    unfinished.write_text((scene / "kept" / "tiles" / "arrays.zarr" / "zarr.json").read_text()[:40])
    match(scene, tmp_path / "out")
    assert_same(scene, tmp_path / "out")
    assert not (tmp_path / "out" / "tiles").exists()


@pytest.mark.parametrize("elsewhere", [False, True])
@pytest.mark.parametrize(("how", "names"), [("empty", ["manifest.json", "arrays.zarr/zarr.json"]), ("half", ["**/*"])])
def test_match__overwrites_tiles_that_a_power_loss_damaged_before_the_first_record(
    scene, tmp_path, how, names, elsewhere
):
    out, options = tmp_path / "out", ["--store", tmp_path / "store"] if elsewhere else []
    more = {"cluster": {"workers": 1} | ({"store": str(tmp_path / "store")} if elsewhere else {})}
    settings = yaml.safe_load((scene / "settings.yaml").read_text()) | more
    prepare(scene / "left.tif", scene / "right.tif", out, settings).begin()
    (tiles,) = (file.parent for file in tmp_path.rglob("manifest.json"))
    for file in [file for name in names for file in tiles.glob(name) if file.is_file()]:
        damage(file, how)
    mine = with_files(tiles, ["notes.txt", "records/notes.json"])
    match(scene, out, *options, "--overwrite")
    assert_same(scene, out)
    assert {file for file in tiles.rglob("*") if file.is_file()} == mine.keys()
    assert_kept(mine)


@pytest.mark.parametrize("name", [SHARDS[0], "records/1_0.json"])
def test_match__names_a_folder_where_a_file_of_a_tile_must_be(scene, tmp_path, name):
    (tmp_path / "out" / "tiles" / name).mkdir(parents=True)
    command = ["match", scene / "left.tif", scene / "right.tif", tmp_path / "out", "--config", scene / "settings.yaml"]
    result = invoke(*command, "--quiet")
    assert result.exit_code == 1
    assert f"tile 1_0: {tmp_path}/out/tiles/{name}: Is a directory" in result.stderr.splitlines()[1]


@pytest.mark.parametrize(
    "command", ["evaluate OUT", "report OUT", "plot OUT", "export OUT TARGET --to otb", "status OUT"]
)
def test_commands__refuse_a_result_of_which_a_bit_flipped(scene, tmp_path, command):
    shutil.copytree(scene / "kept", tmp_path / "OUT")
    damage(tmp_path / "OUT" / "intervals.tif", "bit")
    result = invoke(*(tmp_path / word if word.isupper() else word for word in command.split()))
    assert f"{tmp_path}/OUT/intervals.tif is not what the run published; it is damaged" in result.stderr
    assert result.exit_code == 2
    assert not (tmp_path / "TARGET").exists()


@pytest.mark.parametrize("options", [("--overwrite",), ()])
def test_match__deletes_no_tiles_of_a_run_that_took_the_place_of_its_folder(scene, tmp_path, monkeypatch, options):
    out, other, drop = tmp_path / "out", tmp_path / "other", removal.drop
    shutil.copytree(scene / "kept", other)
    if options:
        shutil.copytree(scene / "kept", out)
    before = sorted(contents(other).values())

    def exchanged(folder):
        if other.exists():
            out.rename(tmp_path / "aside")
            other.rename(out)
        drop(folder)

    monkeypatch.setattr(removal, "drop", exchanged)
    assert "has been replaced by another folder: move it away" in match(scene, out, *options, status=2)
    assert sorted(contents(out).values()) == before
