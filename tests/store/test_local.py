"""A local folder of tiles: one that cannot be listed, its lock, and temporary files of killed processes."""

import errno
import os
import resource
import shutil
import stat
from contextlib import contextmanager, nullcontext

import pytest
from helpers import contents, exchanged

from sat_intervals import errors
from sat_intervals.errors import SatIntervalsError
from sat_intervals.store import local
from sat_intervals.store.local import MADE, LocalFolder
from sat_intervals.store.marks import FINISHED, REPLACING

LOCK = ".sat-intervals.lock"


@contextmanager
def no_more_files():
    """Let this process open no file for the block."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_sizes__of_a_folder_that_cannot_be_listed_are_not_none(tmp_path):
    """Tiles would seem to be missing that are done."""
    folder = LocalFolder(tmp_path)
    folder.write("tile", "done")
    with no_more_files(), pytest.raises(OSError, match="Too many open files"):
        folder.sizes()
    assert folder.sizes() == {"tile": 4}


def test_read_all__of_a_folder_that_cannot_be_listed_is_not_nothing(tmp_path, monkeypatch):
    folder = LocalFolder(tmp_path)
    folder.make("records")
    folder.write("records/0_0.json", "done")
    folder.write("records/.hidden.json", "temporary")
    with monkeypatch.context() as patch:
        patch.setattr(os, "listdir", denied)
        patch.setattr(os, "scandir", denied)
        with pytest.raises(PermissionError):
            folder.read_all("records")
    assert folder.read_all("records") == {"0_0": "done"}


def denied(place):
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(place))


@pytest.mark.parametrize("read", [lambda folder: folder.read("a.json"), lambda folder: folder.read_all("")])
def test_read__of_a_file_whose_place_a_pipe_takes_does_not_wait_for_a_writer(tmp_path, monkeypatch, read):
    check = errors.check_regular

    def late(path, *way_out):
        check(path, *way_out)
        path.unlink()
        os.mkfifo(path)

    (tmp_path / "a.json").touch()
    monkeypatch.setattr(errors, "check_regular", late)
    with pytest.raises(SatIntervalsError, match=r"a\.json is a named pipe: give a regular file"):
        read(LocalFolder(tmp_path))


def test_a_folder_that_was_deleted_has_no_files(tmp_path):
    folder = LocalFolder(tmp_path / "deleted")
    assert (folder.sizes(), folder.read_all("records")) == ({}, {})


@pytest.mark.parametrize("kind", ["file", "link", "folder", "pipe"])
def test_locked__keeps_what_is_not_its_lock(tmp_path, kind):
    precious, folder = tmp_path / "precious", tmp_path / "folder"
    folder.mkdir()
    precious.write_text("mine")
    lock = folder / LOCK
    if kind == "link":
        lock.symlink_to(precious)
    elif kind == "folder":
        lock.mkdir()
    elif kind == "pipe":
        os.mkfifo(lock)
    else:
        lock.write_text("mine")
    (folder / ".lock").write_text("mine")

    def work():
        with LocalFolder(folder).locked():
            assert kind == "file"

    if kind == "file":
        work()
        assert lock.read_text() == "mine"
    else:
        with pytest.raises(
            SatIntervalsError,
            match=r"cannot be written: .*(symbolic link|not a regular file)|lock is a folder",
        ):
            work()
    assert os.path.lexists(lock)
    assert (precious.read_text(), (folder / ".lock").read_text()) == ("mine", "mine")


def test_scratch__deletes_what_a_killed_process_left_and_nothing_else(tmp_path):
    elsewhere, foreign, link = tmp_path / "elsewhere", tmp_path / ".work-mine", tmp_path / ".work-link"
    with LocalFolder(tmp_path).scratch("work", "tiles") as used:
        (used / "tiles").mkdir()
        (used / "tiles" / "file").write_text("half")
        left = shutil.copytree(used.parent, tmp_path / ".work-left")
        shutil.copytree(used.parent, elsewhere)
        (used.parent / "link").symlink_to(elsewhere)
        link.symlink_to(elsewhere)
        foreign.mkdir()
        (foreign / "files").write_text("mine")
        with LocalFolder(tmp_path).scratch("work", "tiles") as new:
            assert (list(new.iterdir()), new.parent.parent) == ([], tmp_path)
        assert not left.exists()
        assert (used / "tiles" / "file").exists()
        (used.parent / "link").unlink()
    assert sorted(tmp_path.iterdir()) == [link, foreign, elsewhere]
    assert sorted(path.name for path in elsewhere.rglob("*")) == [LOCK, "file", "files", "tiles"]


def test_scratch__deletes_nothing_behind_a_link_that_took_its_place(tmp_path):
    (tmp_path / "mine" / "files").mkdir(parents=True)
    (tmp_path / "mine" / "files" / "precious").write_text("mine")
    with LocalFolder(tmp_path).scratch("work", "precious") as used:
        used.parent.rename(tmp_path / "moved")
        used.parent.symlink_to(tmp_path / "mine")
    assert (tmp_path / "mine" / "files" / "precious").read_text() == "mine"


def test_scratch__keeps_what_is_put_beside_its_files(tmp_path):
    with LocalFolder(tmp_path).scratch("work", r"\d+|table.*") as used:
        for name in ("1/notes.txt", "table.tif.aux.xml", "table.tif"):
            (used / name).parent.mkdir(exist_ok=True)
            (used / name).write_text("half")
        (used / "2").symlink_to(tmp_path)
        os.mkfifo(used / "3")
        (used / "notes.txt").write_text("mine")
        (used / "dir").mkdir()
    assert sorted(path.name for path in tmp_path.rglob("*")) == [used.parent.name, "dir", "files", "notes.txt"]


def test_locked__raises_what_the_block_raises_where_a_file_takes_its_place(tmp_path):
    def work():
        with LocalFolder(tmp_path / "tiles").locked():
            (tmp_path / "tiles").rename(tmp_path / "aside")
            (tmp_path / "tiles").write_text("mine")
            raise ValueError("the cause")

    with pytest.raises(ValueError, match="the cause"):
        work()
    assert (tmp_path / "tiles").read_text() == "mine"


def test_locked__nothing_is_changed_in_a_folder_that_took_the_place(tmp_path):
    folder = LocalFolder(tmp_path / "tiles")
    (tmp_path / "other" / "records").mkdir(parents=True)
    (tmp_path / "other" / "records" / "mine.json").write_text("mine")
    with folder.locked():
        folder.write("manifest.json", "own")
        (tmp_path / "tiles").rename(tmp_path / "aside")
        (tmp_path / "other").rename(tmp_path / "tiles")
        before = contents(tmp_path / "tiles")
        for change in (
            lambda: folder.write("manifest.json", "text"),
            lambda: folder.inside("records").write("mine.json", "text"),
            lambda: folder.delete_all(["records/mine.json"], ["records"]),
            lambda: folder.make("records"),
        ):
            with pytest.raises(OSError, match="tiles has been replaced by another folder"):
                change()
        assert contents(tmp_path / "tiles") == before
    folder.write("manifest.json", "text")


@pytest.mark.parametrize("taken", ["by a link", "by another folder"])
def test_delete_all__removes_no_empty_folder_of_what_took_a_place(tmp_path, monkeypatch, taken):
    (tmp_path / "tiles" / "records" / "empty").mkdir(parents=True)
    (tmp_path / "mine" / "records" / "empty").mkdir(parents=True)
    remove = local.remove_empty

    def late(*arguments):
        if "link" in taken:
            (tmp_path / "tiles" / "records").rename(tmp_path / "aside")
            (tmp_path / "tiles" / "records").symlink_to(tmp_path / "mine" / "records")
        else:
            exchanged(tmp_path / "tiles", tmp_path / "mine")
        remove(*arguments)

    monkeypatch.setattr(local, "remove_empty", late)
    LocalFolder(tmp_path / "tiles").delete_all([], ["records"])
    mine, own = ("mine", "tiles") if "link" in taken else ("tiles", "mine")
    assert (tmp_path / mine / "records" / "empty").is_dir()
    assert (tmp_path / own / "records").is_symlink() == ("link" in taken)
    assert "link" in taken or not (tmp_path / own / "records").exists()


def test_scratch__makes_nothing_behind_a_link_that_took_its_place(tmp_path, monkeypatch):
    (tmp_path / "mine").mkdir()
    opened = local.opened

    @contextmanager
    def late(folder):
        with opened(folder) as descriptor:
            folder.rename(tmp_path / "aside")
            folder.symlink_to(tmp_path / "mine")
            yield descriptor

    monkeypatch.setattr(local, "opened", late)
    with LocalFolder(tmp_path).scratch("work", "tiles"):
        assert (tmp_path / "aside" / "files").is_dir()
    assert not [*(tmp_path / "mine").iterdir()]


@pytest.mark.parametrize("name", [MADE, FINISHED, REPLACING])
def test_write__of_a_mark_flushes_its_content_and_then_its_name(tmp_path, monkeypatch, name):
    """Else files of a run could outlast a power loss without any sign that a run made them, or has finished."""
    flushed = []

    def flush(file):
        is_folder = stat.S_ISDIR(os.fstat(file).st_mode)
        flushed.append(os.listdir(file) if is_folder else os.fstat(file).st_size)

    monkeypatch.setattr(os, "fsync", flush)
    LocalFolder(tmp_path).write(name, "mark")
    LocalFolder(tmp_path).write("other", "text")
    assert flushed == [4, [name]]


@pytest.mark.parametrize("number", [errno.EIO, errno.EINVAL])
def test_write__of_a_mark_fails_with_a_disk_that_does_not_keep_its_name(tmp_path, monkeypatch, number):
    """Some file systems flush no folders."""

    def flush(file):
        if stat.S_ISDIR(os.fstat(file).st_mode):
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", flush)
    with nullcontext() if number == errno.EINVAL else pytest.raises(OSError, match="Input/output error"):
        LocalFolder(tmp_path).write(MADE, "mark")


@pytest.mark.parametrize("change", [LocalFolder.delete, lambda folder, name: folder.write(name, "own")])
def test_changes__are_not_made_behind_a_link_that_takes_the_place_of_an_inner_folder(tmp_path, monkeypatch, change):
    for place in (tmp_path / "tiles" / "records", tmp_path / "mine"):
        place.mkdir(parents=True)
        (place / "1_1.json").write_text("mine")
    enter = local.opened_inside

    @contextmanager
    def late(*arguments):
        (tmp_path / "tiles" / "records").rename(tmp_path / "aside")
        (tmp_path / "tiles" / "records").symlink_to(tmp_path / "mine")
        with enter(*arguments) as inside:
            yield inside

    monkeypatch.setattr(local, "opened_inside", late)
    with pytest.raises(OSError, match="records"):
        change(LocalFolder(tmp_path / "tiles"), "records/1_1.json")
    assert (tmp_path / "mine" / "1_1.json").read_text() == "mine"
    assert [*(tmp_path / "mine").iterdir()] == [tmp_path / "mine" / "1_1.json"]
