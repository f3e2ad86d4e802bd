"""Files that are written whole: on the disk before they get their names, and over no file of the user."""

import os

import numpy as np
import pytest
from helpers import contents, exchanged

from sat_intervals.errors import ChangedInputError
from sat_intervals.raster import (
    MARK,
    Georeferencing,
    OutputError,
    layers,
    put_back,
    read_layers,
    stamps,
    write_layer,
    write_once,
)

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_whole_file__may_have_a_name_as_long_as_the_system_allows(tmp_path):
    with layers.whole_file(tmp_path / f"{240 * 'a'}.txt") as new:
        new.write_text("content")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["content"]


def test_whole_file__keeps_what_came_after_its_stamps_and_writes_where_the_file_is_gone(tmp_path):
    path = tmp_path / "page.html"

    def write(before):
        with layers.whole_file(path, before) as new:
            new.write_text("new")

    path.write_text("of another run")
    with pytest.raises(OutputError, match=r"page\.html was written by another process meanwhile: move it away"):
        write({})
    assert path.read_text() == "of another run"
    before = stamps(tmp_path, ["page.html"])
    path.unlink()
    write(before)
    assert contents(tmp_path) == {str(path): b"new"}


@pytest.mark.parametrize("way", ["symlink_to", "hardlink_to"])
def test_whole_file__publishes_no_link_that_takes_the_place_of_its_temporary_file(tmp_path, way):
    mine = tmp_path / "mine"
    mine.write_text("mine")

    def write():
        with layers.whole_file(tmp_path / "page.html") as new:
            new.write_text("new")
            new.rename(tmp_path / "moved")
            getattr(new, way)(mine)

    with pytest.raises(OutputError, match=r"its temporary file .*\.html was replaced"):
        write()
    assert (mine.read_text(), (tmp_path / "page.html").exists()) == ("mine", False)


def test_whole_file__publishes_no_file_that_is_truncated_while_it_is_flushed(tmp_path, monkeypatch):
    def truncate(file):
        os.truncate(next(tmp_path.glob(".page.html-*/files/*.html")), 1)

    monkeypatch.setattr(layers.os, "fsync", truncate)
    with (
        pytest.raises(OutputError, match=r"page.html was truncated while it was written: rerun"),
        layers.whole_file(tmp_path / "page.html") as new,
    ):
        new.write_text("new")
    assert not (tmp_path / "page.html").exists()


def test_whole_file__is_written_where_a_link_takes_the_place_of_its_temporary_folder(tmp_path):
    (tmp_path / "user").mkdir()
    mine = tmp_path / "user" / "page.html"
    mine.write_text("mine")
    with layers.whole_file(tmp_path / "page.html") as new:
        (files,) = tmp_path.glob(".page.html-*/files")
        files.rename(tmp_path / "moved")
        files.symlink_to(mine.parent)
        new.write_text("new")
    assert ((tmp_path / "page.html").read_text(), mine.read_text()) == ("new", "mine")


@pytest.mark.parametrize("is_back", [False, True])
def test_whole_file__replaces_nothing_in_a_folder_that_takes_the_name_of_its_own(tmp_path, is_back):
    out, other = tmp_path / "out", tmp_path / "other"
    for folder in (out, other):
        folder.mkdir()
        (folder / "page.html").write_text(folder.name)

    def write():
        there = stamps(out, ["page.html"])
        if is_back:
            exchanged(out, other)
        with layers.whole_file(out / "page.html", there) as new:
            new.write_text("new")
            exchanged(out, other)

    with pytest.raises(OutputError, match=r"out was replaced by another folder meanwhile: rerun the command"):
        write()
    assert {file.read_text() for file in tmp_path.rglob("*.html")} == {"out", "other"}


def test_write_once__replaces_only_what_was_there_at_the_start(tmp_path):
    """Another demo may have taken the folder's name since."""
    file, ones = tmp_path / "left.tif", np.ones((8, 9), np.uint8)
    write_layer(file, 0 * ones, 0, Georeferencing(), MARK)
    there, before = stamps(tmp_path, [file.name]), file.read_bytes()
    with pytest.raises(OutputError, match=r"left\.tif was written by another process meanwhile"):
        write_once(file, ones, 0, Georeferencing(), {})
    assert file.read_bytes() == before
    write_once(file, ones, 0, Georeferencing(), there)
    assert read_layers(file).all()


def test_put_back__leaves_what_is_published(tmp_path):
    file, report = tmp_path / "left.tif", tmp_path / "run.json"
    file.write_text("before")
    report.write_text("before")

    def interrupted():
        with put_back([file], report):
            file.unlink()
            file.write_text("new")
            (tmp_path / "new").write_text("new")
            os.replace(tmp_path / "new", report)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert contents(tmp_path) == {str(file): b"new", str(report): b"new"}


def test_put_back__keeps_a_file_that_comes_at_the_last_moment(tmp_path, monkeypatch):
    file, report = tmp_path / "left.tif", tmp_path / "run.json"
    write_layer(file, np.zeros((8, 8), np.uint8), 0, Georeferencing(), MARK)
    report.write_text("before")
    check = layers.check_marked

    def and_comes(path):
        check(path)
        (tmp_path / "mine").write_text("mine")
        (tmp_path / "mine").replace(path)

    def interrupted():
        with put_back([file], report):
            write_layer(file, np.ones((8, 9), np.uint8), 0, Georeferencing(), MARK)
            monkeypatch.setattr(layers, "check_marked", and_comes)
            raise KeyboardInterrupt

    with pytest.raises(ChangedInputError, match=r"left\.tif was replaced or changed while it was read"):
        interrupted()
    assert file.read_text() == "mine"


def test_whole_file__is_on_the_disk_before_it_gets_its_name(tmp_path, monkeypatch):
    written, path = [], tmp_path / "file"
    monkeypatch.setattr(layers.os, "fsync", lambda file: written.append((os.pread(file, 9, 0), path.exists())))
    with layers.whole_file(path) as new:
        new.write_text("content")
    assert (written, path.read_text()) == ([(b"content", False)], "content")
