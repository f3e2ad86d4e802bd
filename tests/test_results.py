"""A run.json that was edited by hand, and files that appear beside a run: one line that names them."""

import json

import pytest
from finished import random_bands, write_run
from helpers import exchanged, invoke

from sat_intervals import results
from sat_intervals.errors import ChangedInputError

EDITS = {
    "finished": 7,
    "inputs.left.path": "\ud800.tif",
    "inputs.left.mask": {"path": ""},
    "inputs.right.path": "",
    "inputs.right.width": True,
    "inputs.left.height": 10**400,
    "tiles.region.row": 10**400,
    "counts": [1],
    "counts.pixels": "abc",
    "counts.causes": {"occlusion": "many"},
    "counts.median_interval_width": float("nan"),
    "versions": "0.1",
    "versions.python": float("inf"),
    "local_ranges": {"rows": "abc"},
    "search": {"matched": 0.5, "levels": [], "histogram": {"edges": ["a"], "counts": []}},
    "normalization": {"left": 5},
}


@pytest.mark.parametrize("place", EDITS)
def test_commands__name_a_report_that_was_edited(tmp_path, place):
    out = write_run(tmp_path, *random_bands(20, 30))
    report = json.loads((out / "run.json").read_text())
    *sections, name = place.split(".")
    section = report
    for key in sections:
        section = section[key]
    section[name] = EDITS[place]
    (out / "run.json").write_text(json.dumps(report))
    commands = ["report", out], ["stac", out], ["export", out, tmp_path / "to", "--to", "otb"]
    for command in commands[:1] if place == "local_ranges" else commands:
        done = invoke(*command)
        assert done.exit_code == 2
        assert done.stderr.count("\n") == 1
        assert "run.json is not the report of a run" in done.stderr or "local ranges of the run are dam" in done.stderr


@pytest.mark.parametrize("command", ["report", "plot"])
def test_commands__name_an_image_of_the_run_that_is_missing(tmp_path, command):
    out = write_run(tmp_path, *random_bands(20, 30))
    (tmp_path / "left.tif").rename(tmp_path / "moved.tif")
    done = invoke(command, out)
    assert done.exit_code == 2
    assert (
        f"{tmp_path}/left.tif, an image of the run, is missing: move it back, or put a link to it there" in done.stderr
    )
    (tmp_path / "left.tif").symlink_to("moved.tif")
    assert invoke(command, out).exit_code == 0


FOREIGN = "<PAMDataset><SRS>EPSG:32640</SRS><GeoTransform>10, 1, 0, 20, 0, -1</GeoTransform></PAMDataset>"


@pytest.mark.parametrize("command", [["stac"], ["project"], ["export", "--to", "otb"]])
def test_commands__end_where_a_file_with_another_place_appears_beside_the_run(tmp_path, monkeypatch, command):
    out, checked = write_run(tmp_path, *random_bands(20, 30)), results._checked_place

    def and_appears(file, *arguments):
        found = checked(file, *arguments)
        if file.name == "validity.tif":  # the last that is checked
            (out / "validity.tif.aux.xml").write_text(FOREIGN)
        return found

    monkeypatch.setattr(results, "_checked_place", and_appears)
    arguments = [out, tmp_path / "to"] if command[0] == "export" else [out]
    done = invoke(command[0], *arguments, *command[1:])
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert "validity.tif.aux.xml changes what is read from" in done.stderr
    assert not [*out.glob("*.qgz"), *out.glob("stac*"), *tmp_path.glob("to/*.tif")]


def test_open_run__does_not_call_the_rasters_of_another_run_damaged(tmp_path, monkeypatch):
    for name in "ab":
        (tmp_path / name).mkdir()
    out, other = (write_run(tmp_path / name, *random_bands(20, size)) for name, size in (("a", 30), ("b", 31)))
    which = results._which

    def and_leaves(out):
        found = which(out)
        exchanged(out, other)
        return found

    monkeypatch.setattr(results, "_which", and_leaves)
    with pytest.raises(ChangedInputError, match=r"was replaced or changed while it was read: rerun the command"):
        results.open_run(out)


@pytest.mark.parametrize("command", [["stac"], ["report"], ["export", "--to", "otb"]])
def test_commands__end_where_the_run_is_another_for_a_moment(tmp_path, monkeypatch, command):
    for name in "ab":
        (tmp_path / name).mkdir()
    out, other = (write_run(tmp_path / name, *random_bands(20, 30)) for name in "ab")
    which, checked = results._which, results._checked_place

    def and_leaves(out):
        found = which(out)
        exchanged(out, other)
        return found

    def and_is_back(file, *arguments):
        found = checked(file, *arguments)
        if file.name == "validity.tif":  # the last that is checked
            exchanged(out, other)
        return found

    monkeypatch.setattr(results, "_which", and_leaves)
    monkeypatch.setattr(results, "_checked_place", and_is_back)
    arguments = [out, tmp_path / "to"] if command[0] == "export" else [out]
    done = invoke(command[0], *arguments, *command[1:])
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert "was replaced or changed while it was read: rerun the command" in done.stderr
    assert not [*out.glob("stac*"), *out.glob("report*"), *tmp_path.glob("to/*.tif")]
