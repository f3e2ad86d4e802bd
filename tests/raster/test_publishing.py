"""Files are whole or not there, whatever happens while they are written."""

import os
import subprocess
import sys

import pytest
from helpers import contents

from sat_intervals.raster import OutputError, check_free, check_space, new_file
from sat_intervals.raster.publishing import write_file


def test_new_file__is_not_there_before_it_is_whole(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("before")
    with new_file(path) as temporary:
        assert (temporary.parent, temporary.read_bytes()) == (tmp_path, b"")
        temporary.write_text("new")
        assert path.read_text() == "before"
    assert contents(tmp_path) == {str(path): b"new"}


def test_new_file__is_on_the_disk_before_it_gets_its_name(tmp_path, monkeypatch):
    path, flushed = tmp_path / "a.txt", []
    monkeypatch.setattr(os, "fsync", lambda _: flushed.append(path.exists()))
    write_file(path, b"new")
    assert flushed == [False, True]  # the second time the folder


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_new_file__keeps_what_was_there_if_the_block_fails(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("before")

    def fail():
        with new_file(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        fail()
    assert contents(tmp_path) == {str(path): b"before"}


def test_new_file__of_a_second_writer_is_refused(tmp_path):
    path = tmp_path / "a.txt"
    with new_file(path) as temporary:
        with pytest.raises(OutputError, match=r"a\.txt is being written by another command: wait for"), new_file(path):
            pass
        temporary.write_text("of the first")
    assert contents(tmp_path) == {str(path): b"of the first"}
    write_file(path, b"of the second")
    assert path.read_text() == "of the second"


def test_new_file__replaces_what_a_killed_process_left(tmp_path):
    path = tmp_path / "a.txt"
    code = "import os, sys\nfrom sat_intervals.raster import new_file\n"
    code += "with new_file(sys.argv[1]) as new:\n    new.write_text('half of a long one')\n    os._exit(9)"
    assert subprocess.run([sys.executable, "-c", code, path]).returncode == 9
    assert list(contents(tmp_path).values()) == [b"half of a long one"]
    write_file(path, b"whole")
    assert contents(tmp_path) == {str(path): b"whole"}


def test_new_file__names_the_file_that_cannot_be_written(tmp_path):
    """Not the temporary one."""
    (tmp_path / "folder").mkdir()
    for name, reason in (("missing/a.txt", "No such file or directory"), ("folder", "Is a directory")):
        with pytest.raises(OutputError, match=rf"{tmp_path / name} cannot be written: {reason}: choose another name"):
            write_file(tmp_path / name, b"a")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_write_file__leaves_nothing_on_a_full_disk(disk):
    place = disk(64 << 10)
    (place / "a.txt").write_text("before")
    with pytest.raises(OutputError, match=r"a\.txt cannot be written: No space left on device: free disk space or"):
        write_file(place / "a.txt", bytes(128 << 10))
    assert contents(place) == {str(place / "a.txt"): b"before"}


def test_check_free__refuses_what_may_not_be_replaced(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("nowhere")
    for name in ("file", "link"):
        with pytest.raises(OutputError, match=f"{name} exists: choose another name or --overwrite"):
            check_free(tmp_path / name, overwrite=False)
        check_free(tmp_path / name, overwrite=True)
    check_free(tmp_path / "missing", overwrite=False)
    with pytest.raises(OutputError, match="is a folder: choose another name"):
        check_free(tmp_path, overwrite=True)


def test_check_space__says_what_is_free_and_needed(tmp_path):
    check_space(tmp_path, 1, "files")
    with pytest.raises(OutputError, match=r"MB free, files may need 1,000,000,000,000.0 MB: free disk space"):
        check_space(tmp_path, 10**18, "files")
