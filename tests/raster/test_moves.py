import os
import subprocess
import sys

import numpy as np
import pytest
from helpers import exchanged
from rasterio.shutil import copy

from sat_intervals.errors import ChangedInputError
from sat_intervals.raster import Georeferencing, moves, watched_rasters, write_layer
from sat_intervals.raster.identity import watched


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
    monkeypatch.setattr(moves, "_of_process", lambda *_: queue)
    queue = moves._Queue(moves._RENAMED)
    os.close(queue._queue)
    queue._queue = -1
    assert moves.moves(folders[0]) == (-1, 0)
    check = watched([folders[0] / "models" / "left.geom"])
    make_others(folders[0])
    check()
    for _ in range(2):
        exchanged(*folders)
    with pytest.raises(ChangedInputError):
        check()


def test_watched__raises_if_renamings_were_lost(folders, monkeypatch):
    """The system keeps some thousand of them for a process."""
    check = watched([folders[0] / "models" / "left.geom"])
    for folder in folders:
        moves.moves(folder)
    with open("/proc/sys/fs/inotify/max_queued_events", encoding="ascii") as file:
        most = int(file.read())
    for folder in folders * (most // 2 + 1):  # in turn: equal ones are counted once
        folder.rename(folder.with_name("aside"))
        folder.with_name("aside").rename(folder)
    (folders[0] / "new.txt").touch()
    with pytest.raises(ChangedInputError):
        check()


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("through", ["own", "link", "virtual"])
@pytest.mark.parametrize("name", ["left.tif.aux.xml", "left_RPC.TXT", "LEFT.tfw", "left.tif.msk"])
def test_watched_rasters__raises_if_a_file_beside_one_comes_and_goes(folders, tmp_path, name, through):
    image = folders[0] / "left.tif"
    write_layer(image, np.zeros((8, 9), np.uint8), 0, Georeferencing())
    (tmp_path / "link").symlink_to(folders[0])
    if through == "link":
        image = tmp_path / "link" / "left.tif"
    elif through == "virtual":
        copy(image, tmp_path / "of.vrt", driver="VRT")
        image = tmp_path / "of.vrt"
    for other in (name, "left.tif.ovr.tmp"):
        (folders[0] / other).touch()
        (folders[0] / other).unlink()
    check = watched_rasters([image])
    for other in ("another.tif.aux.xml", "left.tif.ovr.tmp", ".left.tif.swp"):
        (folders[0] / other).touch()
        (folders[0] / other).unlink()
    check()
    (folders[0] / "aside").touch()
    (folders[0] / "aside").rename(folders[0] / name)
    (folders[0] / name).unlink()
    with pytest.raises(ChangedInputError, match=f"{name} was there for a moment while files were read"):
        check()


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("way", ["made", "renamed"])
def test_watched_rasters__allows_statistics_that_come_but_not_other_content_before_them(folders, way):
    image = folders[0] / "left.tif"
    beside = folders[0] / "left.tif.aux.xml"
    write_layer(image, np.zeros((8, 9), np.uint8), 0, Georeferencing())
    statistics = "<PAMDataset><PAMRasterBand band='1'><Metadata><MDI key='STATISTICS_MEAN'>0</MDI></Metadata>"
    statistics += "</PAMRasterBand></PAMDataset>"

    def write(text):
        (beside if way == "made" else folders[0] / "new").write_text(text)
        if way == "renamed":
            (folders[0] / "new").rename(beside)

    check = watched_rasters([image])
    write(statistics)
    check()
    beside.unlink()
    check = watched_rasters([image])
    write("<PAMDataset><GeoTransform>1, 1, 0, 0, 0, -1</GeoTransform></PAMDataset>")
    write(statistics)
    with pytest.raises(ChangedInputError, match=r"left\.tif\.aux\.xml was there for a moment"):
        check()


def test_arrivals__counts_neither_files_that_are_only_read_nor_parts_of_one_that_is_being_written(tmp_path):
    (tmp_path / "left.tif").touch()
    assert moves.arrivals(tmp_path) == {}
    with open(tmp_path / "left.tif", "r+") as file:
        file.write("part")
        file.flush()
        assert moves.arrivals(tmp_path) == {}
    assert moves.arrivals(tmp_path) == {"left.tif": 1}
    (tmp_path / "left.tif").read_text()
    (tmp_path / "link").symlink_to("left.tif")
    os.link(tmp_path / "left.tif", tmp_path / "hard")
    assert moves.arrivals(tmp_path) == {"left.tif": 1, "link": 1, "hard": 1}


_FORKED = """
import os, sys
from pathlib import Path
from sat_intervals.raster.moves import moves

folder = Path(sys.argv[1])
_, before = moves(folder)
process = os.fork()
if not process:
    folder.rename(folder.with_name("aside")).rename(folder)
moves(folder)
if process:
    os.waitpid(process, 0)
    print(moves(folder)[1] - before)
"""


def test_moves__are_not_taken_from_a_process_by_one_that_it_forks(folders):
    command = [sys.executable, "-c", _FORKED, str(folders[0])]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "1\n"
