"""The state of a run's folder: one test for each row of the table in the guide."""

import json
import shutil

import pytest
from helpers import OUTPUTS, hashes, invoke, refused, write_pair

from sat_intervals import match_pair
from sat_intervals.demo import make_scene
from sat_intervals.run import pair as run


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder with left.tif, right.tif, settings.yaml of 2 x 3 tiles, and a run of it that kept its tiles."""
    folder = tmp_path_factory.mktemp("scene")
    more = {"tiles": {"size": 64, "overlap": 10}, "cluster": {"workers": 1}}
    settings = write_pair(folder, make_scene(70, 132, seed=1), **more)
    images = folder / "left.tif", folder / "right.tif"
    match_pair(*images, folder / "kept", settings, keep_tiles=True)
    match_pair(*images, folder / "other", settings | {"median": None})
    return folder


def command(scene, out, *options):
    images = scene / "left.tif", scene / "right.tif"
    return ["match", *images, out, "--config", scene / "settings.yaml", "--quiet", *options]


def succeeds(scene, out, *options):
    result = invoke(*command(scene, out, *options))
    assert result.exit_code == 0, result.stderr
    assert hashes(out) == hashes(scene / "kept")
    return result.stderr


def unfinished(scene, out):
    """The folder of a run whose tiles are done, but not its files."""
    shutil.copytree(scene / "kept", out)
    for name in OUTPUTS:
        (out / name).unlink()
    return out


def tiles_of(out):
    return {file: file.stat().st_mtime_ns for file in (out / "tiles" / "tiles").iterdir()}


@pytest.mark.parametrize("name", OUTPUTS)
def test_match__without_manifest_and_report_refuses_files_of_its_names(scene, tmp_path, name):
    (tmp_path / name).write_text("mine")
    refused(command(scene, tmp_path), f"{name} exists and is of no complete run", "--overwrite")
    assert (tmp_path / name).read_text() == "mine"
    assert [file.name for file in tmp_path.iterdir()] == [name]
    succeeds(scene, tmp_path, "--overwrite")


@pytest.mark.parametrize("options", [(), ("--overwrite",)])
def test_match__with_an_equal_manifest_resumes(scene, tmp_path, options):
    out = unfinished(scene, tmp_path / "out")
    before = tiles_of(out)
    succeeds(scene, out, "--keep-tiles", *options)
    assert tiles_of(out) == before


def test_match__with_an_equal_manifest_takes_over_equal_files_and_refuses_others(scene, tmp_path):
    out = unfinished(scene, tmp_path / "out")
    shutil.copy(scene / "kept" / "intervals.tif", out)  # as if it was killed between both names
    shutil.copy(scene / "other" / "validity.tif", out)
    before = hashes(out)
    if before["validity.tif"] == hashes(scene / "kept")["validity.tif"]:
        (out / "validity.tif").write_bytes(b"mine")
        before = hashes(out)
    refused(command(scene, out), "validity.tif is not of this run: move it away or give --overwrite")
    assert hashes(out) == before
    (out / "validity.tif").unlink()
    succeeds(scene, out)


def test_match__with_the_report_of_this_run_is_complete_and_removes_tiles_that_a_death_left(scene, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(scene / "kept", out)
    before = {name: (out / name).stat().st_mtime_ns for name in OUTPUTS}
    assert "was already complete" in succeeds(scene, out)
    assert {name: (out / name).stat().st_mtime_ns for name in OUTPUTS} == before
    assert not (out / "tiles").exists()
    (out / "tiles").mkdir()
    (out / "tiles" / "manifest.json").write_text("{")
    assert "was already complete" in succeeds(scene, out)


def test_match__with_the_report_of_this_run_overwrites_on_equal_tiles(scene, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(scene / "kept", out)
    before, finished = tiles_of(out), json.loads((out / "run.json").read_text())["finished"]
    succeeds(scene, out, "--overwrite", "--keep-tiles")
    assert tiles_of(out) == before
    assert json.loads((out / "run.json").read_text())["finished"] > finished


@pytest.mark.parametrize("has_report", [True, False])
def test_match__with_another_manifest_names_the_difference_or_starts_anew(scene, tmp_path, has_report):
    out = tmp_path / "out"
    shutil.copytree(scene / "kept", out)
    if has_report:
        shutil.copy(scene / "other" / "run.json", out)
    else:
        unfinished(scene, tmp_path / "second").rename(out / "second")
        out = out / "second"
    before = tiles_of(out)
    more = ("--tile-size", "128")
    refused(command(scene, out, *more), "holds the tiles of another run: settings.tiles.size was 64, now 128")
    assert tiles_of(out) == before
    invoke(*command(scene, out, *more, "--overwrite", "--keep-tiles"))
    assert {file.stem for file in tiles_of(out)} == {"0_0", "0_1"}


@pytest.mark.parametrize("has_tiles", [True, False])
def test_match__with_the_report_of_another_run_refuses_or_replaces_it(scene, tmp_path, has_tiles):
    out = unfinished(scene, tmp_path / "out") if has_tiles else tmp_path / "out"
    shutil.copytree(scene / "other", out, dirs_exist_ok=True)
    before = hashes(out)
    refused(command(scene, out), "already holds", "choose another folder or --overwrite")
    assert hashes(out) == before
    succeeds(scene, out, "--overwrite")


@pytest.mark.parametrize("text", ["", "{", "{}", "\0" * 50])
def test_match__with_a_damaged_manifest_names_it_or_starts_anew(scene, tmp_path, text):
    out = unfinished(scene, tmp_path / "out")
    (out / "tiles" / "manifest.json").write_text(text)
    refused(command(scene, out), "manifest.json is damaged: start again with --overwrite")
    succeeds(scene, out, "--overwrite")


def test_match__that_dies_while_it_overwrites_is_gone_on_with_by_the_same_command(scene, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(scene / "other", out)
    before = hashes(out)

    def dies(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(run, "assemble", dies)
        with pytest.raises(KeyboardInterrupt):
            match_pair(scene / "left.tif", scene / "right.tif", out, scene / "settings.yaml", overwrite=True)
    assert hashes(out) == before
    tiles = tiles_of(out)
    refused(command(scene, out), "already holds")
    succeeds(scene, out, "--overwrite", "--keep-tiles")
    assert tiles_of(out) == tiles


def test_match__of_a_renamed_folder_resumes(scene, tmp_path):
    unfinished(scene, tmp_path / "out").rename(tmp_path / "renamed")
    before = tiles_of(tmp_path / "renamed")
    succeeds(scene, tmp_path / "renamed", "--keep-tiles")
    assert tiles_of(tmp_path / "renamed") == before


def test_match__with_tiles_elsewhere_names_where_they_are(scene, tmp_path):
    stores = [("--set", f"cluster.store={tmp_path / name}") for name in ("first", "second")]
    succeeds(scene, tmp_path / "out", *stores[0], "--keep-tiles")
    (tmp_path / "out" / "run.json").unlink()
    refused(command(scene, tmp_path / "out", *stores[1]), "place was ", "first", "second")
    assert list((tmp_path / "first").iterdir())
    succeeds(scene, tmp_path / "out", *stores[1], "--overwrite")
    assert not [*(tmp_path / "first").iterdir(), *(tmp_path / "second").iterdir()]
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == sorted([".sat-intervals.lock", *OUTPUTS])


def test_match__refuses_files_in_the_places_of_folders(scene, tmp_path):
    (tmp_path / "file").touch()
    refused(command(scene, tmp_path / "file"), "file is not a folder: choose another")
    (tmp_path / "out" / "run.json").mkdir(parents=True)
    refused(command(scene, tmp_path / "out"), "run.json is a folder: move it away")
