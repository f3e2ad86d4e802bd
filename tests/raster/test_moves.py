import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
from helpers import exchanged

from sat_intervals.errors import ChangedInputError
from sat_intervals.raster import moves
from sat_intervals.raster.watching import watched


@pytest.fixture
def folders(tmp_path):
    for name in ("own", "other"):
        (tmp_path / name / "models").mkdir(parents=True)
        (tmp_path / name / "models" / "left.geom").write_text(name)
    return tmp_path / "own", tmp_path / "other"


def make_others(own):
    """What other programs do beside inputs, in all folders above them."""
    for place in (own / "models", own, own.parent):
        (place / "new.txt").touch()
        (place / "folder" / "inner").mkdir(parents=True)
        (place / "folder" / "inner").rename(place / "folder" / "renamed")
        (place / "folder").rename(place / "results")
        (place / "new.txt").unlink()


def refuse(*arguments):
    """As a function of the C library that fails."""
    return -1


def there_and_back(own, other):
    for _ in range(2):
        exchanged(own, other)
    (own / "new.txt").touch()


@pytest.mark.parametrize("which", ["own", "own/models"])
def test_watched__raises_if_a_folder_was_another_before_it_got_a_file(folders, which):
    check = watched([folders[0] / "models" / "left.geom"])
    make_others(folders[0])
    check()
    there_and_back(*(folder.parent / which.replace("own", folder.name) for folder in folders))
    with pytest.raises(ChangedInputError, match=r"left\.geom was replaced or changed while it was read"):
        check()


def test_watched__raises_if_the_folder_that_a_link_leads_to_was_another(folders, tmp_path):
    (tmp_path / "link").symlink_to(folders[0])
    check = watched([tmp_path / "link" / "models" / "left.geom"])
    make_others(folders[0])
    check()
    there_and_back(*folders)
    with pytest.raises(ChangedInputError):
        check()


def test_watched__knows_a_renamed_folder_by_its_times_where_the_system_cannot_watch_it(folders, monkeypatch):
    monkeypatch.setattr(moves._RENAMINGS, "_system", SimpleNamespace(inotify_init1=refuse, inotify_add_watch=refuse))
    moves._RENAMINGS._begin()
    assert moves.moves(folders[0]) is None
    check = watched([folders[0] / "models" / "left.geom"])
    make_others(folders[0])
    check()
    for _ in range(2):
        exchanged(*folders)
    with pytest.raises(ChangedInputError):
        check()


def test_watched__raises_if_renamings_were_lost(folders, tmp_path):
    """The system keeps some thousand of them for a process."""
    check = watched([folders[0] / "models" / "left.geom"])
    others = tmp_path / "one", tmp_path / "two"
    for folder in others:
        folder.mkdir()
        moves.moves(folder)
    with open("/proc/sys/fs/inotify/max_queued_events", encoding="ascii") as file:
        most = int(file.read())
    for folder in others * (most // 2 + 1):  # in turn: equal ones are counted once
        folder.rename(folder.with_name("aside"))
        folder.with_name("aside").rename(folder)
    there_and_back(*folders)
    with pytest.raises(ChangedInputError):
        check()


def test_watched__takes_no_folder_for_another_that_the_system_can_watch_only_later(folders, monkeypatch):
    monkeypatch.setattr(moves, "_RENAMINGS", moves._Queue(moves._RENAMED))
    with monkeypatch.context() as context:
        context.setattr(moves, "_WATCHED", 0x0100_0000 | 0x0200_0000 | 0x3000_0000)  # which it refuses
        assert moves.moves(folders[0]) is None
        check = watched([folders[0] / "models" / "left.geom"])
    check()
    assert moves.moves(folders[0]) is not None
    for _ in range(2):
        exchanged(*folders)
    with pytest.raises(ChangedInputError):
        check()


def test_arrivals__counts_neither_files_that_are_only_read_nor_parts_of_one_that_is_being_written(tmp_path):
    names = {"left.tif", "link", "hard"}
    (tmp_path / "LEFT.tif").touch()
    assert moves.arrivals(tmp_path, names) == {}
    with open(tmp_path / "LEFT.tif", "r+") as file:
        file.write("part")
        file.flush()
        assert moves.arrivals(tmp_path, names) == {}
    assert moves.arrivals(tmp_path, names) == {"LEFT.tif": 1}
    (tmp_path / "LEFT.tif").read_text()
    (tmp_path / "link").symlink_to("LEFT.tif")
    os.link(tmp_path / "LEFT.tif", tmp_path / "hard")
    assert moves.arrivals(tmp_path, names) == {"LEFT.tif": 1, "link": 1, "hard": 1}


def test_arrivals__keeps_nothing_of_other_names(tmp_path):
    moves.arrivals(tmp_path, {"left.rpb"})
    for number in range(100):
        (tmp_path / f"{number}").touch()
    (tmp_path / "left.rpb").touch()
    assert moves.arrivals(tmp_path, {"left.rpb"}) == {"left.rpb": 1}
    assert {name for counts in moves._ARRIVALS._counts.values() for _, name in counts}.isdisjoint(map(str, range(100)))


def test_moves__are_those_of_one_queue_for_all_threads(folders):
    for _ in range(20):
        moves._RENAMINGS._begin()
        with ThreadPoolExecutor(8) as threads:
            assert len(set(threads.map(moves.moves, [folders[0]] * 8))) == 1


_FORKED = """
import os, sys
from pathlib import Path
from sat_intervals.raster.moves import moves

folder = Path(sys.argv[1])
_, before = moves(folder)
descriptors = len(os.listdir("/proc/self/fd"))
process = os.fork()
if process:
    # Asked in between, it would count both renamings.
    _, status = os.waitpid(process, 0)
    assert status == 0
else:
    folder.rename(folder.with_name("aside")).rename(folder)
_, after = moves(folder)
assert len(os.listdir("/proc/self/fd")) == descriptors
if process:
    print(after - before)
"""


def test_moves__are_not_taken_from_a_process_by_one_that_it_forks(folders):
    command = [sys.executable, "-c", _FORKED, str(folders[0])]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "1\n"
