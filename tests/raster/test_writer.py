"""The writer of a run's files replaces none of the user's, and publishes none that is not its own."""

import errno
import os
import shutil
import stat
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import OUTPUTS, PLACE, STATISTICS, contents, exchanged, exchanged_for_link, fail

from sat_intervals.errors import ChangedInputError, SatIntervalsError
from sat_intervals.products import BANDS
from sat_intervals.raster import (
    MARK,
    RUN_FILES,
    Georeferencing,
    OutputError,
    OutputWriter,
    hidden,
    layers,
    publishing,
    put_back,
    read_layers,
    remove_scratch,
    replaceable,
    restore,
    stamps,
    write_layer,
)
from sat_intervals.raster import writer as raster_writer
from sat_intervals.raster.files import File
from sat_intervals.raster.hidden import HiddenFolder
from sat_intervals.raster.space import way_out
from sat_intervals.run.pair import match_pair

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.mark.parametrize("inner", ["", "files", "files/replaced"])
def test_output_writer__adopts_no_folder_through_a_link(tmp_path, inner):
    precious = tmp_path / "precious"
    (precious / "files" / "replaced").mkdir(parents=True)
    (precious / "files" / "strips-intervals.tif").write_text("mine")
    (precious / "files" / "replaced" / "intervals.tif").write_text("mine")
    link = tmp_path / "out" / ".unpublished-intervals.tif" / inner
    link.parent.mkdir(parents=True, exist_ok=True)
    if inner == "":
        link.rmdir() if link.exists() else None
    (tmp_path / "out" / ".unpublished-intervals.tif" / inner).symlink_to(precious / inner)
    before = contents(precious)
    for look in (examine, restore, remove_scratch, lambda out, files: writer(out).__enter__()):
        with pytest.raises(OutputError, match="is a symbolic link"):
            look(tmp_path / "out", RUN_FILES)
        assert contents(precious) == before


def examine(out, files):
    with replaceable(out, files):
        pass


def writer(out):
    return OutputWriter(out, RUN_FILES, 4, 5, Georeferencing(), {})


def test_output_writer__deletes_no_files_that_no_process_made(tmp_path):
    place = tmp_path / ".unpublished-intervals.tif" / "files" / "replaced"
    place.mkdir(parents=True)
    for file in (place / "intervals.tif", place.parent / "run.json"):
        file.write_text("mine")
        before = contents(tmp_path)
        for look in (examine, restore, remove_scratch, lambda out, files: writer(out).__enter__()):
            with pytest.raises(OutputError, match=f"{file.name} was not written by sat-intervals: move .* away"):
                look(tmp_path, RUN_FILES)
            assert contents(tmp_path) == before
        file.unlink()


def test_output_writer__does_not_follow_a_link_that_appears_meanwhile(tmp_path):
    (tmp_path / "user").mkdir()
    (tmp_path / "user" / "intervals.tif").write_text("mine")
    hidden = tmp_path / "out" / ".unpublished-intervals.tif"

    def write():
        with writer(tmp_path / "out") as output:
            output.write(0, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
            (hidden / "files").rename(hidden / "aside")
            (hidden / "files").symlink_to(tmp_path / "user")
            output.publish()

    with pytest.raises(OutputError, match="files is a symbolic link"):
        write()
    assert contents(tmp_path / "user") == {str(tmp_path / "user" / "intervals.tif"): b"mine"}


@pytest.mark.parametrize("inner", ["", "files", "files/replaced"])
def test_output_writer__deletes_nothing_in_a_folder_that_took_the_place_of_its_own(tmp_path, inner):
    hidden = tmp_path / "out" / ".unpublished-intervals.tif"
    place = hidden / inner
    names = {"": ".sat-intervals.files", "files": "strips-intervals.tif", "files/replaced": "intervals.tif"}

    def exchange():
        place.rename(tmp_path / "moved")
        place.mkdir()
        (place / names[inner]).write_text("mine")

    for before in (True, False):
        with writer(tmp_path / "out") as output:
            output.write(0, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
            if before:
                output.build()
                exchange()
                with pytest.raises(
                    OutputError, match=f"{place}, a folder of temporary files, was replaced: move it away"
                ):
                    output.publish()
            else:
                output.publish()
                exchange()
        assert (place / names[inner]).read_text() == "mine"
        shutil.rmtree(hidden)
        shutil.rmtree(tmp_path / "moved")


def test_output_writer__deletes_nothing_of_a_killed_process_whose_hidden_folder_takes_the_place_of_its_own(
    tmp_path, monkeypatch
):
    """What that process had put aside is nowhere else."""
    killed = tmp_path / "killed"
    (killed / "files" / "replaced").mkdir(parents=True)
    (killed / ".sat-intervals.files").touch()
    (killed / "files" / "replaced" / "intervals.tif").write_text("mine")
    remove = HiddenFolder.remove

    def and_exchanged(output):
        remove(output)
        if killed.exists():
            exchanged(output.files.parent, killed)

    monkeypatch.setattr(HiddenFolder, "remove", and_exchanged)
    with pytest.raises(OutputError, match=r"was replaced: move it away and rerun"), writer(tmp_path / "out") as output:
        written(output, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
    assert "mine" in map(bytes.decode, contents(tmp_path).values())


@pytest.mark.parametrize("error", [None, errno.EINVAL, errno.EIO])
def test_output_writer__names_are_on_the_disk_before_replaced_files_are_deleted(tmp_path, monkeypatch, error):
    """Else a power loss could take both; some file systems flush no folders."""
    rasters = np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16)
    with writer(tmp_path) as output:
        written(output, *rasters)
    before, flushed = contents(tmp_path), []

    def fsync(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            replaced = os.listdir(tmp_path / ".unpublished-intervals.tif" / "files" / "replaced")
            flushed.append((sorted(os.listdir(descriptor)), sorted(replaced)))
            if error:
                raise OSError(error, os.strerror(error))

    monkeypatch.setattr(os, "fsync", fsync)
    with (
        pytest.raises(OutputError, match="cannot be written: Input/output error")
        if error == errno.EIO
        else nullcontext(),
        writer(tmp_path) as output,
    ):
        written(output, rasters[0] + 1, rasters[1])
    names = ["intervals.tif", "run.json", "validity.tif"]
    assert flushed == [([".unpublished-intervals.tif", *names], names)]
    assert (contents(tmp_path) == before) == (error == errno.EIO)


def written(output, *rasters):
    output.write(0, *rasters)
    output.publish(("run.json", "{}"), replaceable=stamps(output._folder, os.listdir(output._folder)))


def test_output_writer__names_a_file_where_a_folder_of_temporary_ones_must_be(tmp_path):
    place = tmp_path / ".unpublished-intervals.tif" / "files" / "replaced"
    place.parent.mkdir(parents=True)
    place.write_text("mine")
    with pytest.raises(OutputError, match=f"{place} is not a folder, but temporary files go there: move it away"):
        writer(tmp_path).__enter__()
    assert place.read_text() == "mine"


def test_output_writer__writes_nothing_behind_a_link_with_a_temporary_name(tmp_path):
    (tmp_path / "mine").write_text("mine")
    with writer(tmp_path / "out") as output:
        (tmp_path / "out" / ".unpublished-intervals.tif" / "files" / "run.json").symlink_to(tmp_path / "mine")
        with pytest.raises(OutputError, match="cannot be written: File exists"):
            written(output, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
    assert contents(tmp_path) == {str(tmp_path / "mine"): b"mine"}


@pytest.mark.parametrize("way", ["symlink_to", "hardlink_to"])
@pytest.mark.parametrize("name", ["intervals.tif", "run.json"])
def test_output_writer__writes_nothing_behind_a_link_that_takes_the_place_of_a_temporary_file(tmp_path, name, way):
    (tmp_path / "mine").write_text("mine")
    temporary = tmp_path / "out" / ".unpublished-intervals.tif" / "files" / name
    with writer(tmp_path / "out") as output:
        output.write(0, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
        assert not any(file.is_file() for file in temporary.parent.rglob("*"))  # those of rows have no names

        def announce(_):
            if temporary.exists() and not temporary.is_symlink():
                exchanged_for_link(temporary, tmp_path / "mine", way)

        with suppress(OutputError):
            output.publish(("run.json", "{}"), announce=announce)
    assert (tmp_path / "mine").read_text() == "mine"
    assert not any(file.is_symlink() or file.stat().st_nlink > 1 for file in (tmp_path / "out").glob("*.*"))


def test_output_writer__draws_nothing_behind_a_link_with_the_name_of_its_picture(tmp_path):
    (tmp_path / "mine").write_text("mine")
    file = File("disparity.png", "uint8", None, BANDS[:1], driver="PNG")
    with OutputWriter(tmp_path / "out", [file], 4, 5, Georeferencing(), {}) as output:
        (tmp_path / "out" / ".unpublished-disparity.png" / "files" / "disparity.png").symlink_to(tmp_path / "mine")
        written(output, np.zeros((1, 4, 5), np.uint8))
    assert ((tmp_path / "mine").read_text(), (tmp_path / "out" / "disparity.png").is_symlink()) == ("mine", False)


def exchanged_for_run(monkeypatch, step, out, user):
    """Before a step of the writer, put a link to the folder of another run into the place of its finished files."""
    module = hidden if step == "publish" else raster_writer
    work = getattr(module, step)

    def exchanged(*arguments, **named):
        files = out / ".unpublished-intervals.tif" / "files"
        if not files.is_symlink():
            files.rename(out.with_name("moved"))
            files.symlink_to(user)
        return work(*arguments, **named)

    monkeypatch.setattr(module, step, exchanged)


def test_output_writer__publishes_no_files_of_a_folder_that_took_the_place_of_its_own(tmp_path, monkeypatch):
    user, out = tmp_path / "user", tmp_path / "out"
    user.mkdir()
    for name in OUTPUTS:
        (user / name).write_text("of another run")
    before = contents(user)
    exchanged_for_run(monkeypatch, "publish", out, user)
    with writer(out) as output:
        output.write(0, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
        with suppress(OutputError):
            output.publish(("run.json", "{}"))
    assert contents(user) == before
    assert b"of another run" not in {path.read_bytes() for path in out.glob("*.*") if path.is_file()}


def test_match_pair__writes_no_files_of_a_folder_that_took_the_place_of_its_own(small_pair, monkeypatch):
    folder, settings = small_pair
    user, out, images = folder / "user", folder / "out", (folder / "left.tif", folder / "right.tif")
    match_pair(folder / "other.tif", folder / "right.tif", user, settings)
    before = contents(user)
    exchanged_for_run(monkeypatch, "template", out, user)
    with suppress(SatIntervalsError):
        match_pair(*images, out, settings)
    assert {name: content for name, content in contents(user).items() if name in before} == before
    assert not {content for path, content in contents(out).items() if path.endswith(tuple(OUTPUTS))} & {
        *before.values()
    }


def test_output_writer__publishes_nothing_in_a_folder_that_took_the_place_of_its_own(tmp_path):
    out, other = tmp_path / "out", tmp_path / "other"
    other.mkdir()
    for name in OUTPUTS:
        (other / name).write_text("of another run")
    before = {file.name: file.read_bytes() for file in other.iterdir()}

    def publish():
        with writer(out) as output:
            output.write(0, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
            output.build()
            out.rename(tmp_path / "away")
            other.rename(out)
            output.publish(("run.json", "{}"), replaceable=stamps(out, OUTPUTS))

    with pytest.raises(
        OutputError, match=r"\.unpublished-intervals\.tif/files, a folder of temporary files, is gone: rerun"
    ):
        publish()
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before


def test_output_writer__leaves_statistics_beside_its_place(tmp_path):
    (tmp_path / "intervals.tif.aux.xml").write_text(STATISTICS)
    with writer(tmp_path):
        pass
    (tmp_path / "intervals.tif.ovr").write_text("of an earlier one")
    with pytest.raises(OutputError, match=r"\.ovr changes what is read from"), writer(tmp_path):
        pass


@pytest.mark.parametrize("name", ["intervals.tfw", "intervals.tifW", "intervals.WLD", "intervals.tab"])
def test_output_writer__refuses_a_world_file_beside_a_raster_without_a_place(tmp_path, name):
    (tmp_path / name).write_text("2\n0\n0\n-2\n9\n9\n")
    with pytest.raises(OutputError, match=f"{name} changes what is read from .*intervals.tif"), writer(tmp_path):
        pass
    with OutputWriter(tmp_path, RUN_FILES, 4, 5, PLACE, {}):
        pass  # GDAL ignores it


def test_output_writer__finds_files_beside_its_place_in_a_folder_that_cannot_be_listed(tmp_path, monkeypatch):
    def fail(folder):
        raise PermissionError

    (tmp_path / "intervals.tif.msk").write_text("mine")
    monkeypatch.setattr("sat_intervals.raster.seal.os.listdir", fail)
    with pytest.raises(OutputError, match=r"intervals\.tif\.msk changes what is read from"), writer(tmp_path):
        pass


def test_output_writer__publishes_no_file_beside_a_mask_that_appears_meanwhile(tmp_path):
    with writer(tmp_path) as output:
        output.write(0, *(np.zeros((len(file.bands), 4, 5), file.dtype) for file in RUN_FILES))
        (tmp_path / "intervals.tif.msk").write_text("mine")
        with pytest.raises(OutputError, match=r"intervals\.tif\.msk changes what is read from .*: move it away"):
            output.publish()
    assert sorted(file.name for file in tmp_path.glob("[!.]*")) == ["intervals.tif.msk"]


def test_output_writer__refuses_a_mask_beside_a_picture(tmp_path):
    (tmp_path / "mask.png.MSK").write_text("of an earlier one")
    picture = replace(RUN_FILES[1], name="mask.png", driver="PNG")
    with (
        pytest.raises(OutputError, match=r"mask\.png\.MSK changes what is read from"),
        OutputWriter(tmp_path, [picture], 4, 5, PLACE, {}),
    ):
        pass


def test_output_writer__keeps_foreign_files_where_its_own_grow(tmp_path):
    place = tmp_path / ".unpublished-intervals.tif" / "files"
    (place / "replaced").mkdir(parents=True)
    for file in (place / "mine.txt", place / "replaced" / "mine.txt", place / "strips-intervals.tif"):
        file.write_text("mine")
    (place.parent / ".sat-intervals.files").touch()  # as a killed process leaves it
    with OutputWriter(tmp_path, RUN_FILES, 4, 5, Georeferencing(), {}) as writer:
        writer.write(0, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
        writer.publish()
    names = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    hidden = ".unpublished-intervals.tif/files"
    assert names == [f"{hidden}/mine.txt", f"{hidden}/replaced/mine.txt", "intervals.tif", "validity.tif"]


@pytest.mark.parametrize("name", ["intervals.tif", "run.json"])
def test_output_writer__publishes_no_file_that_is_truncated_after_it_was_compared(tmp_path, name):
    with writer(tmp_path) as output:
        output.write(0, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
        made = tmp_path / ".unpublished-intervals.tif" / "files" / name
        with pytest.raises(OutputError, match=r"changed temporary files in .*: rerun the command"):
            output.publish(("run.json", "{}"), announce=lambda stamps: os.truncate(made, 1))
    assert not list(tmp_path.glob("*.*"))


def test_output_writer__publishes_no_report_that_is_damaged_when_it_is_flushed(tmp_path, monkeypatch):
    flush = raster_writer.flush

    def and_damages(path):
        flush(path)
        if path.name == "run.json":
            path.write_text("[]")

    monkeypatch.setattr(raster_writer, "flush", and_damages)
    with writer(tmp_path) as output:
        output.write(0, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
        with pytest.raises(OutputError, match=r"run\.json cannot be written: the content read back differs"):
            output.publish(("run.json", "{}"))
    assert not list(tmp_path.glob("*.*"))


def test_put_back__of_a_killed_process_keeps_a_file_that_came_after_it(tmp_path):
    file, report = tmp_path / "left.tif", tmp_path / "run.json"
    write_layer(file, np.ones((9, 9), np.uint16), 0, PLACE, MARK)
    report.write_text("before")
    os.rename(file, layers._aside(file, report))  # as a killed process leaves it
    file.write_text("mine")
    with pytest.raises(SatIntervalsError, match=r"left\.tif exists and was not made by"), put_back([file], report):
        pass
    assert file.read_text() == "mine"


def test_output_writer__leaves_a_folder_among_the_replaced_files_where_it_is(tmp_path):
    mine = tmp_path / ".unpublished-intervals.tif" / "files" / "replaced" / "run.json" / "mine.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    (tmp_path / ".unpublished-intervals.tif" / ".sat-intervals.files").touch()
    with writer(tmp_path) as output:
        output.write(0, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
        output.publish(("run.json", "{}"))
    assert ((tmp_path / "run.json").read_text(), mine.read_text()) == ("{}", "mine")


def test_output_writer__deletes_no_file_with_a_name_like_that_of_its_own(tmp_path):
    place = tmp_path / ".unpublished-intervals.tif" / "files"
    (place / "replaced").mkdir(parents=True)
    mine = [place / "intervals.tif.old", place / "run.json~", place / "replaced" / "validity.tif.backup"]
    ours = [place / "strips-intervals.tif", place / "intervals.tif.ovr.tmp", place / "validity.tif.aux.xml"]
    for file in (*mine, *ours):
        file.write_text("content")
    (place.parent / ".sat-intervals.files").touch()
    with OutputWriter(tmp_path, RUN_FILES, 4, 5, Georeferencing(), {}):
        pass
    assert contents(tmp_path) == {str(file): b"content" for file in mine}


@pytest.mark.parametrize("inner", ["files", "files/replaced"])
def test_output_writer__deletes_nothing_behind_a_link_that_comes_before_it_cleans_up(tmp_path, monkeypatch, inner):
    out, user, check = tmp_path / "out", tmp_path / "user", HiddenFolder.check
    (user / "replaced").mkdir(parents=True)
    for name in OUTPUTS:
        (user / name).write_text("mine")
        (user / "replaced" / name).write_text("mine")
    before = contents(user)

    def and_exchanged(output):
        check(output)
        folder = out / ".unpublished-intervals.tif" / inner
        if output.is_published and not folder.is_symlink():
            folder.rename(tmp_path / "moved")
            folder.symlink_to(user)

    monkeypatch.setattr(HiddenFolder, "check", and_exchanged)
    with writer(out) as output:
        written(output, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
    assert contents(user) == before
    assert sorted(file.name for file in out.glob("*.*") if file.is_file()) == OUTPUTS


def both(tmp_path):
    """Two folders with results; return them and the contents of both, by name."""
    for name, value in (("out", 1), ("other", 2)):
        with writer(tmp_path / name) as output:
            written(output, np.full((4, 4, 5), value, np.float32), np.zeros((4, 5), np.uint16))
    out, other = tmp_path / "out", tmp_path / "other"
    return out, other, named(out), named(other)


def named(folder):
    return {str(Path(file).relative_to(folder)): content for file, content in contents(folder).items()}


def test_output_writer__publishes_in_the_folder_that_it_opened(tmp_path, monkeypatch):
    out, other, before, mine = both(tmp_path)

    def late(*arguments):
        exchanged(out, other)
        publish(*arguments)

    publish = hidden.publish
    monkeypatch.setattr(hidden, "publish", late)
    with (
        pytest.raises(OutputError, match=r"out was replaced by another folder meanwhile: rerun the command"),
        writer(out) as output,
    ):
        written(output, np.full((4, 4, 5), 3, np.float32), np.zeros((4, 5), np.uint16))
    assert named(out) == mine
    assert named(other).keys() >= before.keys()
    assert named(other)["intervals.tif"] != before["intervals.tif"]


@pytest.mark.parametrize("moment", ["_put_aside", "rename_new"])
def test_output_writer__puts_no_file_of_another_folder_aside_that_is_there_for_a_moment(tmp_path, monkeypatch, moment):
    out, other, _, mine = both(tmp_path)
    step = getattr(publishing, moment)

    def there_and_back(*arguments):
        exchanged(out, other)
        try:
            return step(*arguments)
        finally:
            exchanged(out, other)

    monkeypatch.setattr(publishing, moment, there_and_back)
    with writer(out) as output:
        written(output, np.full((4, 4, 5), 3, np.float32), np.zeros((4, 5), np.uint16))
    assert named(other) == mine
    assert read_layers(out / "intervals.tif")[0, 0, 0] == 3


def test_output_writer__keeps_a_file_that_is_in_the_place_of_a_result_for_a_moment(tmp_path, monkeypatch, caplog):
    """A rerun deletes what was put aside."""
    out, mine, before = tmp_path / "out", tmp_path / "mine", both(tmp_path)[2]
    mine.write_text("mine")
    replace = os.replace

    def of_another(source, target):
        if target.parent.name == "replaced" and target.name == "intervals.tif" and mine.exists():
            source.rename(tmp_path / "aside")
            mine.rename(source)
            replace(source, target)
            (tmp_path / "aside").rename(source)
        else:
            replace(source, target)

    monkeypatch.setattr(publishing.os, "replace", of_another)
    zeros = np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16)
    with pytest.raises(OutputError, match=r"intervals\.tif is not of this run"), writer(out) as output:
        written(output, *zeros)
    assert before.items() <= named(out).items()
    (kept,) = (file for file in out.rglob("kept-*-intervals.tif") if file.read_text() == "mine")
    assert f"{out}/intervals.tif for a moment: it is kept as {kept}" in caplog.text
    monkeypatch.undo()
    with writer(out) as output:
        written(output, *zeros)
    assert kept.read_text() == "mine"


def test_output_writer__gives_a_folder_back_that_takes_the_place_of_a_result(tmp_path, monkeypatch):
    out, mine = both(tmp_path)[0], tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    replace = os.replace

    def of_another(source, target):
        if target.parent.name == "replaced" and mine.exists():
            exchanged(source, mine)
        replace(source, target)

    monkeypatch.setattr(publishing.os, "replace", of_another)
    with pytest.raises(OutputError, match=r"is not of this run, or was changed"), writer(out) as output:
        written(output, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
    assert [file.read_text() for file in out.glob("*/notes.txt")] == ["mine"]


@pytest.mark.parametrize("moment", ["takes back", "resumes"])
def test_output_writer__removes_no_file_that_takes_the_place_of_one_that_it_removes(tmp_path, monkeypatch, moment):
    out, mine = both(tmp_path)[0], tmp_path / "mine"
    mine.write_text("mine")
    if moment == "resumes":  # after a process that was killed when it had published the first file
        hidden_files = out / ".unpublished-intervals.tif" / "files"
        (hidden_files / "replaced").mkdir(parents=True)
        (hidden_files.parent / ".sat-intervals.files").touch()
        shutil.copy(out / "intervals.tif", hidden_files / "replaced" / "intervals.tif")
    remove, rename_new = publishing._remove, publishing.rename_new

    def late(place, folder, may_go):
        place.rename(tmp_path / "moved")
        mine.rename(place)

        def and_copied(file):
            shutil.copytree(out, tmp_path / "killed")
            return may_go(file)

        return remove(place, folder, and_copied)

    def failing(source, target):
        if moment == "takes back" and source.name == "validity.tif" and source.parent.name != "replaced":
            raise OSError(errno.EIO, "Input/output error")
        rename_new(source, target)

    monkeypatch.setattr(publishing, "_remove", late)
    monkeypatch.setattr(publishing, "rename_new", failing)
    with pytest.raises(OutputError), writer(out) as output:
        written(output, np.full((4, 4, 5), 3, np.float32), np.zeros((4, 5), np.uint16))
    assert (out / "intervals.tif").read_text() == "mine"
    monkeypatch.undo()
    with writer(tmp_path / "killed") as output:
        written(output, np.full((4, 4, 5), 3, np.float32), np.zeros((4, 5), np.uint16))
    assert b"mine" in named(tmp_path / "killed").values()


def test_remove_scratch__keeps_what_a_process_put_aside_that_was_killed_before_its_end(tmp_path):
    """Another folder may have taken the place of the complete one that was to be tidied."""
    replaced = tmp_path / ".unpublished-intervals.tif" / "files" / "replaced"
    replaced.mkdir(parents=True)
    (replaced.parents[1] / ".sat-intervals.files").touch()
    for name in OUTPUTS:
        (replaced / name).write_text("of the run before")
    (tmp_path / "intervals.tif").write_text("of the killed one")
    before = contents(tmp_path)
    remove_scratch(tmp_path, RUN_FILES)
    assert contents(tmp_path) == before
    for name in OUTPUTS:
        (tmp_path / name).write_text("complete")
    remove_scratch(tmp_path, RUN_FILES)
    assert named(tmp_path) == dict.fromkeys(OUTPUTS, b"complete")


def test_open_own__opens_no_hard_link_that_comes_at_the_last_moment(tmp_path, monkeypatch):
    (tmp_path / "mine").write_text("mine")
    own = tmp_path / "strips"
    own.write_text("")

    def and_is_linked(file):
        found = check(file)
        own.unlink()
        os.link(tmp_path / "mine", own)
        return found

    check = publishing.check_own
    monkeypatch.setattr(publishing, "check_own", and_is_linked)
    with pytest.raises(OSError, match="its temporary file strips was replaced"):
        publishing.open_own(own, os.O_WRONLY)


def away_and_back(folder, file):
    file.rename(folder.parent / "away")
    yield
    (folder.parent / "away").rename(file)


def exchanged_and_back(folder, file):
    exchanged(folder, folder.with_name("other"))
    yield
    exchanged(folder, folder.with_name("other"))
    (folder / "new").touch()


def comes(folder, file):
    yield
    (folder / "new.tif").touch()


def goes(folder, file):
    yield
    file.unlink()


@pytest.mark.parametrize("way", [away_and_back, exchanged_and_back, comes, goes])
def test_examined__raises_if_another_file_may_have_been_examined(tmp_path, way):
    folder = tmp_path / "out"
    for place in (folder, tmp_path / "other"):
        place.mkdir()
    (folder / "mine.tif").write_text("mine")
    names = ["mine.tif", "new.tif"]
    with publishing.examined(folder, names) as there:
        (folder / "another").touch()
    assert there == stamps(folder, names)
    steps = way(folder, folder / "mine.tif")

    def examine():
        with publishing.examined(folder, names):
            next(steps)
            next(steps, None)

    with pytest.raises(ChangedInputError, match="rerun the command"):
        examine()


@pytest.mark.parametrize("way", ["flag", "link", "neither"])
def test_rename_new__replaces_nothing_on_any_disk(tmp_path, monkeypatch, way):
    for name in ("new", "mine"):
        (tmp_path / name).write_text(name)
    if way != "flag":
        monkeypatch.setattr(publishing, "_is_renamed", lambda *_: False)
    if way == "neither":
        monkeypatch.setattr(publishing.os, "link", fail)
    else:  # a file may come at any moment
        monkeypatch.setattr(publishing.os.path, "lexists", lambda _: False)
    with pytest.raises(FileExistsError):
        publishing.rename_new(tmp_path / "new", tmp_path / "mine")
    publishing.rename_new(tmp_path / "new", tmp_path / "free")
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"free": "new", "mine": "mine"}


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOENT, "rerun the command or choose another folder"),
        (errno.ESTALE, "rerun the command"),
        (errno.EISDIR, "move it away"),
        (errno.EACCES, "choose another folder"),
        (errno.ENOSPC, "free disk space or choose another folder"),
    ],
)
def test_way_out__fits_the_error(number, words):
    assert way_out(OSError(number, os.strerror(number))) == words
