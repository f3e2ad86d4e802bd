"""Files of the user are never lost: inputs, unrelated files in a folder, and a finished run."""

import json
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import numpy as np
import pytest
import rasterio
from finished import random_bands, write_run
from helpers import (
    COMMAND,
    NODATA,
    OUTPUTS,
    PLACE,
    VRT,
    Killed,
    contents,
    exchanged_for_link,
    fail,
    hashes,
    invoke,
    killed_while_publishing,
    refused,
    write_pair,
)
from matplotlib.figure import Figure
from rasterio.shutil import copy

from sat_intervals.cli import logs
from sat_intervals.config.pairs import PairOfBatch
from sat_intervals.demo import make_scene
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.heights import dsm
from sat_intervals.interop.export import export
from sat_intervals.raster import (
    Georeferencing,
    OutputError,
    OutputWriter,
    layers,
    put_back,
    read_layers,
    write_layer,
)
from sat_intervals.raster.identity import check_not_replaced, identity
from sat_intervals.results import Run, open_results, open_run
from sat_intervals.run import assemble as run_assemble
from sat_intervals.run import copying, strips
from sat_intervals.run.batch import match_batch
from sat_intervals.run.job import prepare
from sat_intervals.run.pair import match_pair
from sat_intervals.run.tile import match_block
from sat_intervals.show.canvas import page
from sat_intervals.show.profile import draw_profile
from sat_intervals.show.report import write_report

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.mark.parametrize("has_report", [True, False])
@pytest.mark.parametrize("name", ["intervals.tif", "run.json"])
def test_match__overwrites_no_result_that_was_changed_since(small_pair, name, has_report):
    folder, settings = small_pair
    out = folder / "out"
    match_pair(folder / "left.tif", folder / "right.tif", out, settings)
    if not has_report:
        (out / "run.json").unlink()
        match_pair(folder / "left.tif", folder / "right.tif", out, settings, overwrite=True)  # others are replaced
        (out / "run.json").rename(folder / "kept.json") if name != "run.json" else None
    if name == "run.json":
        (out / name).write_text((out / name).read_text().replace('"valid"', '"valid "', 1))
    else:
        with rasterio.open(out / name, "r+", IGNORE_COG_LAYOUT_BREAK="YES") as file:
            file.write(np.zeros((4, 80, 100), np.float32))  # the mark of the tool stays
    before = (out / name).read_bytes()
    with pytest.raises(
        SatIntervalsError, match=rf"{name} exists and was not made by sat-intervals, or was changed since"
    ):
        match_pair(folder / "left.tif", folder / "right.tif", out, settings, overwrite=True)
    assert (out / name).read_bytes() == before


@pytest.mark.parametrize("stage", ["put aside", "appears"])
def test_match__overwrites_no_file_that_came_after_its_check(small_pair, monkeypatch, stage):
    """Put aside by a run that was killed before it put it back, or new since the images were opened."""
    folder, settings = small_pair
    images, out = (folder / "left.tif", folder / "right.tif"), folder / "out"
    match_pair(*images, out, settings)
    job = prepare(*images, out, settings, overwrite=True)
    mine = out / "intervals.tif"
    if stage == "put aside":
        mine.unlink()
        hidden = out / ".unpublished-intervals.tif"
        (hidden / "files" / "replaced").mkdir(parents=True)
        (hidden / ".sat-intervals.files").touch()
        (hidden / "files" / "replaced" / "intervals.tif").write_text("mine")
    else:
        mine.write_text("mine")
    with pytest.raises(SatIntervalsError, match=r"intervals.tif exists and was not made by sat-intervals"):
        job.begin(overwrite=True)
    assert mine.read_text() == "mine"


# Tiles of another run


def test_store__removes_no_tiles_of_another_run_that_took_their_place(small_pair):
    folder, settings = small_pair
    images, out = (folder / "left.tif", folder / "right.tif"), folder / "out"
    match_pair(*images, folder / "kept", settings, keep_tiles=True)
    job = prepare(*images, out, settings | {"sgm": {"p2": 48}})
    job.begin()
    (out / "tiles").rename(folder / "away")
    (folder / "kept" / "tiles").rename(out / "tiles")
    before = sorted((out / "tiles").rglob("*"))
    job.store.remove()
    assert sorted((out / "tiles").rglob("*")) == before


# Inputs among the outputs


@pytest.mark.parametrize("way", ["path", "symlink", "hard link", "mask", "tiles", "source"])
def test_match__refuses_an_input_that_it_would_lose(small_pair, way):
    folder, _ = small_pair
    out = folder / "out"
    (out / "tiles").mkdir(parents=True)
    left, options, target = folder / "left.tif", [], out / "intervals.tif"
    if way == "path":
        left = shutil.copy(left, target)
    elif way == "symlink":
        left = shutil.copy(left, target)
        (folder / "link.tif").symlink_to(target)
        left = folder / "link.tif"
    elif way == "hard link":
        target.hardlink_to(left)
    elif way == "mask":
        target = shutil.copy(folder / "mask.tif", out / "validity.tif")
        options = ["--left-mask", target]
    elif way == "tiles":
        left = target = shutil.copy(left, out / "tiles" / "left.tif")
    else:
        target = shutil.copy(folder / "mask.tif", out / "validity.tif")
        (folder / "source.vrt").write_text(VRT.replace("mask.tif", "out/validity.tif"))
        options = ["--left-mask", folder / "source.vrt"]
    before = contents(folder)
    command = ["match", left, folder / "right.tif", out, "--config", folder / "settings.yaml", "--overwrite"]
    refused([*command, *options], "is an input", "choose another output")
    assert contents(folder) == before


@pytest.mark.parametrize("name", ["run.json", "tiles/manifest.json"])
def test_commands__refuse_settings_that_they_would_lose(small_pair, name):
    folder, _ = small_pair
    for out in (folder / "out", folder / "batch" / "one"):
        (out / "tiles").mkdir(parents=True)
        shutil.copy(folder / "settings.yaml", out / name)
    rows = [{"name": "one", "left": str(folder / "left.tif"), "right": str(folder / "right.tif")}]
    (folder / "pairs.json").write_text(json.dumps(rows))
    before = contents(folder)
    config = ["--config", folder / "out" / name, "--overwrite"]
    refused(["match", folder / "left.tif", folder / "right.tif", folder / "out", *config], f"{name} is an input")
    refused(["demo", folder / "out", "--size", "100", "100", *config], f"{name} is an input")
    config = ["--config", folder / "batch" / "one" / name, "--overwrite"]
    refused(["batch", folder / "pairs.json", folder / "batch", *config], f"{name} is an input")
    assert contents(folder) == before


def test_match__takes_no_file_of_the_user_for_a_mark_of_its_own(small_pair):
    folder, settings = small_pair
    images, out = (folder / "left.tif", folder / "right.tif"), folder / "out"
    marks = {out / "tiles" / name: "mine" for name in ("replacing", "finished")}
    (out / "tiles").mkdir(parents=True)
    for mark, text in marks.items():
        mark.write_text(text)
    match_pair(*images, out, settings)
    with pytest.raises(SatIntervalsError, match="already holds a run"):
        match_pair(*images, out, settings | {"median": None})
    assert {mark: mark.read_text() for mark in marks} == marks


def test_match__refuses_an_input_inside_the_store(small_pair):
    folder, settings = small_pair
    settings["cluster"]["store"] = str(folder / "store")
    images = folder / "left.tif", folder / "right.tif"
    place = Path(prepare(*images, folder / "out", settings).store.elsewhere)
    (place / "records").mkdir(parents=True)
    shutil.move(folder / "left.tif", place / "records" / "left.json")
    (folder / "left.tif").symlink_to(place / "records" / "left.json")
    with pytest.raises(SatIntervalsError, match="is an input inside"):
        match_pair(*images, folder / "out", settings, overwrite=True)


def test_batch__refuses_an_input_that_another_pair_or_its_report_would_replace(small_pair):
    folder, settings = small_pair
    out = folder / "out"
    (out / "one").mkdir(parents=True)
    shutil.copy(folder / "mask.tif", out / "one" / "validity.tif")
    images = str(folder / "left.tif"), str(folder / "right.tif")
    pairs = [PairOfBatch("one", *images), PairOfBatch("two", *images, left_mask=str(out / "one" / "validity.tif"))]
    before = contents(folder)
    with pytest.raises(SatIntervalsError, match=r"is an input, and .* would be written"):
        match_batch(pairs, out, settings, overwrite=True)
    assert contents(folder) == before
    (out / "batch.json").write_text(json.dumps([{"name": "one", "left": images[0], "right": images[1]}]))
    before = contents(folder)
    refused(["batch", out / "batch.json", out, "--config", folder / "settings.yaml"], "batch.json is an input")
    assert contents(folder) == before


def test_log_file__is_no_input(small_pair):
    folder, _ = small_pair
    before = contents(folder)
    command = ["match", folder / "left.tif", folder / "right.tif", folder / "out", "--disparity", "-18", "40"]
    refused([*command, "--log-file", folder / "left.tif"], "left.tif is an input")
    assert contents(folder) == before


@pytest.fixture
def finished(tmp_path):
    """A made-up run with its images; the left image has a name that each tool writes to."""
    return write_run(tmp_path, *random_bands(40, 50))


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("report", "run.json"),
        ("report", "intervals.tif"),
        ("report", "report.html"),
        ("plot", "overview.png"),
        ("project", "project.qgz"),
        ("stac", "STAC.JSON"),
    ],
)
def test_log_file__is_not_named_like_a_result(finished, command, name):
    before = contents(finished)
    refused([command, finished, "--log-file", finished / name], f"{name} ends with {Path(name).suffix.lower()}")
    assert contents(finished) == before


def test_export__ends_where_another_run_replaces_the_one_it_reads(finished, tmp_path, monkeypatch):
    read = Run.read_bands

    def and_replace(run, window):
        shutil.copy(finished / "run.json", tmp_path / "new")
        os.replace(tmp_path / "new", finished / "run.json")
        return read(run, window)

    monkeypatch.setattr(Run, "read_bands", and_replace)
    with pytest.raises(RunError, match="was replaced while it was read: rerun the command"):
        export(finished, "otb", tmp_path / "target")
    assert not list((tmp_path / "target").glob("*.tif"))


def rename_left(out, name):
    """Give the left image of a run another name beside its files."""
    report = json.loads((out / "run.json").read_text())
    shutil.move(report["inputs"]["left"]["path"], out / name)
    report["inputs"]["left"]["path"] = str(out / name)
    (out / "run.json").write_text(json.dumps(report))


@pytest.mark.parametrize(
    ("form", "name"), [("otb", "mask.tif"), ("s2p", "rectified_disp.tif"), ("cars", "epi_disp.tif")]
)
def test_export__refuses_to_replace_an_image_of_the_run(finished, form, name):
    rename_left(finished, name)
    before = contents(finished)
    with pytest.raises(SatIntervalsError, match=rf"{name} is an input"):
        export(finished, form, finished)
    assert contents(finished) == before


def test_export__refuses_to_replace_a_file_of_the_run_through_a_link(finished, tmp_path):
    (tmp_path / "target").mkdir()
    (tmp_path / "target" / "mask.tif").symlink_to(finished / "validity.tif")
    with pytest.raises(SatIntervalsError, match=r"validity\.tif is an input"):
        export(finished, "otb", tmp_path / "target")


def test_report_and_plot__refuse_to_replace_an_image_of_the_run(finished):
    rename_left(finished, "report.html")
    before = contents(finished)
    refused(["report", finished], "report.html is an input")
    shutil.move(finished / "report.html", finished / "left.tif")
    rename_left_back = json.loads((finished / "run.json").read_text())
    rename_left_back["inputs"]["left"]["path"] = str(finished / "left.tif")
    (finished / "run.json").write_text(json.dumps(rename_left_back))
    rename_left(finished, "overview.png")
    refused(["plot", finished], "overview.png is an input")
    assert (finished / "overview.png").read_bytes() == before[str(finished / "report.html")]


# Files of others in the folders


def test_page__publishes_no_link_that_takes_the_place_of_its_temporary_file(tmp_path, monkeypatch):
    (tmp_path / "mine").write_text("mine")
    write = Path.write_bytes

    def late(path, content):
        write(path, content)
        (temporary,) = tmp_path.glob(".overview.png-*/files/*.png")
        exchanged_for_link(temporary, tmp_path / "mine")

    monkeypatch.setattr(Path, "write_bytes", late)
    with (
        pytest.raises(OutputError, match=r"its temporary file .*\.png was replaced"),
        page(tmp_path / "overview.png", (1, 1), 50, ""),
    ):
        pass
    assert ((tmp_path / "mine").read_text(), (tmp_path / "overview.png").exists()) == ("mine", False)


@pytest.mark.parametrize("way", ["symlink_to", "hardlink_to"])
def test_match_pair__copies_no_part_behind_a_link_that_takes_the_place_of_a_temporary_file(
    small_pair, monkeypatch, way
):
    folder, settings = small_pair
    (folder / "mine").write_text("mine")
    tasks = copying._tasks

    def exchanged(job, path, parts):
        exchanged_for_link(path, folder / "mine", way)
        return tasks(job, path, parts)

    monkeypatch.setattr(copying, "_tasks", exchanged)
    with pytest.raises(SatIntervalsError, match=r"its temporary file .*intervals\.tif was replaced"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert ((folder / "mine").read_text(), (folder / "out" / "intervals.tif").exists()) == ("mine", False)


@pytest.mark.parametrize(
    "ending", [".tif.aux.xml", ".tif.msk", ".tif.OVR", ".tif.aux", ".aux", ".RPB", ".rpc", "_rpc.txt", ".IMD"]
)
def test_match_pair__refuses_a_file_that_would_change_what_is_read_from_its_results(small_pair, ending):
    folder, settings = small_pair
    mine = folder / "out" / f"intervals{ending}"
    mine.parent.mkdir()
    mine.write_text(NODATA)
    with pytest.raises(SatIntervalsError, match=rf"{ending} changes what is read from .*intervals.tif: move it away"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert [file.name for file in mine.parent.iterdir()] == [mine.name]


def test_match_pair__refuses_a_world_file_beside_its_results_before_it_matches(small_pair):
    """Images without a transform have results without one."""
    folder, settings = small_pair
    for side in ("left", "right"):
        write_layer(folder / f"{side}.tif", read_layers(folder / f"{side}.tif")[0], 0, Georeferencing())
    (folder / "out").mkdir()
    (folder / "out" / "intervals.tfw").write_text("2\n0\n0\n-2\n9\n9\n")
    with pytest.raises(SatIntervalsError, match=r"intervals\.tfw changes what is read from .*: move it away"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert [file.name for file in (folder / "out").iterdir()] == ["intervals.tfw"]


def test_match_pair__resumes_after_a_file_that_appeared_beside_its_results(small_pair, monkeypatch):
    folder, settings = small_pair

    def and_appears(job, block):
        match_block(job, block)
        (folder / "out" / "intervals.tif.ovr").write_text("mine")

    with monkeypatch.context() as patch:
        patch.setattr("sat_intervals.run.pair.match_block", and_appears)
        with pytest.raises(RunError, match=r"ovr changes what is read from .*: move it away; rerun .*: it resumes"):
            match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    (folder / "out" / "intervals.tif.ovr").unlink()
    match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)


def test_match_pair__keeps_a_result_that_is_the_source_of_ranges(small_pair):
    folder, settings = small_pair
    images, out = (folder / "left.tif", folder / "right.tif"), folder / "out"
    match_pair(*images, out, settings)
    with rasterio.open(out / "intervals.tif") as file:
        copy(file, folder / "ranges.vrt", driver="VRT")
    text = (folder / "ranges.vrt").read_text()
    bands = re.findall(r"<VRTRasterBand.*?</VRTRasterBand>", text, re.DOTALL)
    for band in (bands[0], bands[3]):
        text = text.replace(band, "")
    (folder / "ranges.vrt").write_text(text.replace('band="2"', 'band="1"', 1).replace('band="3"', 'band="2"', 1))
    ranges = {**settings, "disparity": {**settings["disparity"], "grid": str(folder / "ranges.vrt")}}
    with pytest.raises(SatIntervalsError, match=r"intervals.tif is an input, and .*intervals.tif would be written"):
        match_pair(*images, out, ranges, overwrite=True)


def test_check_not_replaced__follows_a_loop_of_links_no_further(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "input").write_text("mine")
    check_not_replaced([tmp_path / "input"], [tmp_path / "loop"], [tmp_path / "loop"])


def killed_overwrite(pair, out, monkeypatch):
    """A finished run, over which another one was killed before it published."""
    folder, settings = pair
    images = folder / "left.tif", folder / "right.tif"
    match_pair(*images, out, settings)
    with monkeypatch.context() as patch:
        patch.setattr(OutputWriter, "publish", dies)
        with pytest.raises(KeyboardInterrupt):
            match_pair(*images, out, settings | {"sgm": {"p2": 48}}, overwrite=True)
    return {name: (out / name).read_bytes() for name in OUTPUTS}


def dies(*arguments, **named):
    raise KeyboardInterrupt


def test_match_pair__replaces_no_results_that_come_with_the_mark_of_a_killed_overwrite(small_pair, monkeypatch):
    folder, settings = small_pair
    out = folder / "out"
    before = killed_overwrite(small_pair, folder / "other", monkeypatch)
    assemble = run_assemble._publish

    def late(*arguments, **named):
        for name in (*OUTPUTS, "tiles/.sat-intervals.replacing"):
            shutil.copy2(folder / "other" / name, out / name)
        return assemble(*arguments, **named)

    monkeypatch.setattr(run_assemble, "_publish", late)
    with pytest.raises(SatIntervalsError, match="is not of this run, or was changed since it started: move it away"):
        match_pair(folder / "left.tif", folder / "other.tif", out, settings)
    assert {name: (out / name).read_bytes() for name in OUTPUTS} == before


def test_match_pair__takes_no_mark_of_another_killed_overwrite_for_its_own(small_pair, monkeypatch):
    folder, settings = small_pair
    out, images = folder / "out", (folder / "left.tif", folder / "right.tif")
    before = killed_overwrite(small_pair, out, monkeypatch)
    for name in os.listdir(out / "tiles"):  # a user empties the folder, but for hidden files
        if not name.startswith("."):
            place = out / "tiles" / name
            shutil.rmtree(place) if place.is_dir() else place.unlink()
    other = settings | {"sgm": {"p2": 50}}
    with pytest.raises(SatIntervalsError, match="which another run was to replace: give --overwrite"):
        match_pair(*images, out, other)
    assert {name: (out / name).read_bytes() for name in OUTPUTS} == before
    match_pair(*images, out, other, overwrite=True)
    assert open_run(out).config.sgm.p2 == 50


def test_match_pair__is_complete_where_its_tiles_cannot_be_removed(small_pair, monkeypatch, caplog):
    folder, settings = small_pair
    tiles, publish = folder / "out" / "tiles", OutputWriter.publish

    def and_exchanged(*arguments, **named):
        published = publish(*arguments, **named)
        tiles.rename(folder / "away")
        tiles.symlink_to(folder / "away")
        return published

    monkeypatch.setattr(OutputWriter, "publish", and_exchanged)
    report = match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert open_run(folder / "out").report == report
    assert "tiles has become a symbolic link" in caplog.text
    assert (folder / "away" / "manifest.json").exists()


def test_match__refuses_tiles_that_are_a_link_or_file_and_takes_an_out_that_is_a_link(small_pair):
    folder, settings = small_pair
    (folder / "precious" / "records").mkdir(parents=True)
    (folder / "precious" / "records" / "0_0.json").write_text("mine")
    (folder / "real").mkdir()
    (folder / "out").symlink_to("real")
    (folder / "real" / "tiles").symlink_to(folder / "precious")
    images = folder / "left.tif", folder / "right.tif"
    before = contents(folder)
    with pytest.raises(SatIntervalsError, match="tiles is a symbolic link"):
        match_pair(*images, folder / "out", settings, overwrite=True)
    assert contents(folder) == before
    (folder / "real" / "tiles").unlink()
    (folder / "real" / "tiles").write_text("mine")
    with pytest.raises(SatIntervalsError, match="tiles is not a folder: move it away"):
        match_pair(*images, folder / "out", settings, overwrite=True)
    assert (folder / "real" / "tiles").read_text() == "mine"
    (folder / "real" / "tiles").unlink()
    match_pair(*images, folder / "out", settings)
    assert (folder / "real" / "run.json").exists()


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["records", "parts", "arrays.zarr", "arrays.zarr/int16", "arrays.zarr/right/c"])
def test_match__refuses_a_link_among_the_folders_of_its_tiles(small_pair, name, overwrite):
    folder, settings = small_pair
    (folder / "precious").mkdir()
    (folder / "precious" / "0_0.json").write_text("mine")
    link = folder / "out" / "tiles" / name
    link.parent.mkdir(parents=True)
    link.symlink_to(folder / "precious")
    with pytest.raises(SatIntervalsError, match=rf"{name} is a file or a symbolic link, .*: move it away"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, overwrite=overwrite)
    assert contents(folder / "precious") == {str(folder / "precious" / "0_0.json"): b"mine"}


def test_match__takes_the_tiles_of_a_user_for_no_run_of_its_own(small_pair):
    folder, settings = small_pair
    (folder / "out" / "tiles").mkdir(parents=True)
    (folder / "out" / "tiles" / "12_34.png").write_text("mine")
    (folder / "out" / "validity.tif").write_text("mine")
    before = contents(folder)
    with pytest.raises(SatIntervalsError, match=r"validity.tif exists and was not made by sat-intervals"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert contents(folder) == before


def test_match__takes_no_folder_for_one_of_a_run_because_of_its_records(small_pair):
    folder, settings = small_pair
    records = folder / "out" / "tiles" / "records"
    records.mkdir(parents=True)
    (records / "0_0.json").write_text('{"crc32": 1}')
    with pytest.raises(SatIntervalsError, match="tiles has files without a sign of their run, such as records/0_0"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, overwrite=True)
    assert (records / "0_0.json").read_text() == '{"crc32": 1}'


@pytest.mark.parametrize("content", [b'{"finished": 1}', b"II*\0some raster", b"<html>", b"mine\n"])
def test_log_file__is_not_added_to_what_is_no_log(finished, tmp_path, content):
    file = tmp_path / "file"
    file.write_bytes(content)
    refused(["export", finished, tmp_path / "target", "--to", "otb", "--log-file", file], "is not a log", "--log-file")
    assert file.read_bytes() == content


def test_log_file__is_not_added_to_what_takes_its_name_while_it_is_opened(finished, tmp_path, monkeypatch):
    log, mine, at_once = tmp_path / "log", tmp_path / "mine", logs._at_once
    mine.write_text("mine\n")

    def late(*arguments):
        mine.rename(log)
        return at_once(*arguments)

    monkeypatch.setattr(logs, "_at_once", late)
    refused(["export", finished, tmp_path / "target", "--to", "otb", "--log-file", log], "is not a log", "--log-file")
    assert log.read_text() == "mine\n"


@pytest.fixture
def elsewhere(tmp_path):
    """A web server that counts its requests, and a folder of the user that looks like a store."""
    asked = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET  # noqa: N815

        def log_message(self, *_):
            """Say nothing."""

    precious = tmp_path / "precious"
    for name in ("records/0_0.json", "arrays.zarr/zarr.json", "manifest.json", "normalization.json"):
        (precious / name).parent.mkdir(parents=True, exist_ok=True)
        (precious / name).write_text("{}")
    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield precious, f"http://127.0.0.1:{server.server_address[1]}/store/tiles", asked
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("kind", ["folder", "web"])
def test_commands__follow_no_note_of_a_received_folder(small_pair, elsewhere, kind):
    folder, settings = small_pair
    precious, url, asked = elsewhere
    noted = url if kind == "web" else str(precious)
    out = folder / "batch" / "out"
    images = folder / "left.tif", folder / "right.tif"
    (out / "tiles").mkdir(parents=True)
    (out / "tiles" / ".sat-intervals.store").write_text(json.dumps(noted))
    before = contents(precious)
    command = ["match", *images, out, "--config", folder / "settings.yaml", "--quiet"]
    says = f"places the tiles of the run in {noted}", f"give --store {noted.rpartition('/')[0]}"
    refused(command, *says)
    refused(["status", out], *says)
    result = invoke(*command, "--overwrite")
    assert (result.exit_code, result.stderr.count("\n")) == (0, 1)
    assert f"places the tiles of the run in {noted}: they are kept" in result.stderr
    (out / "tiles").mkdir()
    (out / "tiles" / ".sat-intervals.store").write_text(json.dumps(noted))
    report = match_batch([PairOfBatch("out", *map(str, images))], folder / "batch", settings)
    assert report["out"]["state"] == "done before"
    (out / "run.json").unlink()
    report = match_batch([PairOfBatch("out", *map(str, images))], folder / "batch", settings)
    assert says[0] in report["out"]["error"]
    assert invoke("status", folder / "batch").exit_code == 0
    assert contents(precious) == before
    assert asked == []


def test_match__with_the_noted_store_deletes_only_what_its_manifest_names(small_pair, elsewhere):
    folder, settings = small_pair
    precious, _, _ = elsewhere
    (folder / "out" / "tiles").mkdir(parents=True)
    (folder / "out" / "tiles" / ".sat-intervals.store").write_text(json.dumps(str(precious)))
    before = contents(precious)
    settings["cluster"]["store"] = str(precious.parent)
    match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, overwrite=True)
    assert contents(precious) == before


def test_status__looks_into_the_store_that_is_named(small_pair):
    folder, settings = small_pair
    settings["cluster"]["store"] = str(folder / "store")
    job = prepare(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    job.begin()
    refused(
        ["status", folder / "out"],
        f"places the tiles of the run in {job.store.elsewhere}",
        f"give --store {folder / 'store'}",
    )
    result = invoke("status", folder / "out", "--store", folder / "store")
    assert (result.exit_code, "0 of 4 tiles done" in result.output) == (0, True), result.output


# A good run


def test_demo__that_fails_to_overwrite_keeps_the_run_and_is_gone_on_with(tmp_path, monkeypatch):
    out = tmp_path / "out"
    command = ["demo", str(out), "--size", "120", "140", "--quiet"]
    assert invoke(*command).exit_code == 0
    names = ["left.tif", "right.tif", "truth.tif", "intervals.tif", "validity.tif", "run.json"]
    before = {name: (out / name).read_bytes() for name in names}
    with monkeypatch.context() as patch:
        patch.setattr(strips, "postprocess_strip", fail)
        assert invoke(*command, "--seed", "1", "--overwrite").exit_code == 1
    assert {name: (out / name).read_bytes() for name in names} == before
    assert sorted(path.name for path in out.iterdir()) == sorted([*names, "tiles"])
    assert invoke(*command, "--seed", "1").exit_code == 0
    assert sorted(path.name for path in out.iterdir()) == sorted(names)
    assert (out / "left.tif").read_bytes() != before["left.tif"]
    assert (
        identity(str(out / "left.tif"))["sha256"]
        == json.loads((out / "run.json").read_text())["inputs"]["left"]["sha256"]
    )


KILLED = """import os, sys
from sat_intervals.cli import main
from sat_intervals.run import pair
pair.match_pair = lambda *arguments, **options: os.kill(os.getpid(), 9)
main(sys.argv[1:])"""


@pytest.mark.process
def test_demo__that_was_killed_is_rolled_back_or_replaced_by_the_next(tmp_path, monkeypatch):
    out = tmp_path / "out"
    command = ["demo", str(out), "--size", "120", "140", "--quiet"]
    assert invoke(*command).exit_code == 0
    before = contents(out)
    killed = [sys.executable, "-c", KILLED, *command, "--seed", "1", "--overwrite"]
    for _ in range(2):  # of which the second finds what the first left
        assert subprocess.run(killed, check=False).returncode == -9
    assert (out / "left.tif").read_bytes() != before[str(out / "left.tif")]
    assert invoke(*command, "--seed", "2").exit_code == 2  # nothing is replaced unasked
    with monkeypatch.context() as patch:
        patch.setattr("sat_intervals.run.pair.match_pair", fail)
        assert invoke(*command, "--seed", "2", "--overwrite").exit_code == 1
    assert contents(out) == before
    assert subprocess.run(killed, check=False).returncode == -9
    assert invoke(*command, "--seed", "1", "--overwrite").exit_code == 0
    assert contents(out).keys() == before.keys()
    assert (out / "left.tif").read_bytes() != before[str(out / "left.tif")]


def test_demo__replaces_links_and_does_not_follow_them(tmp_path):
    precious = tmp_path / "precious.tif"
    precious.write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "left.tif").symlink_to(precious)
    command = ["demo", str(tmp_path / "out"), "--size", "120", "140", "--quiet"]
    assert invoke(*command).exit_code == 2
    assert invoke(*command, "--overwrite").exit_code == 0
    assert precious.read_text() == "mine"


def test_page__keeps_a_file_that_appears_while_it_is_drawn(tmp_path):
    path = tmp_path / "overview.png"
    with (
        pytest.raises(SatIntervalsError, match=r"overview\.png exists and was not made by"),
        page(path, (1, 1), 50, ""),
    ):
        path.write_text("mine")
    assert contents(tmp_path) == {str(path): b"mine"}


def test_write_once__keeps_a_file_that_appears_while_it_is_written(tmp_path, monkeypatch):
    write = layers.sum_of_bits

    def appears_before(bands):
        (tmp_path / "left.tif").write_text("mine")
        return write(bands)

    monkeypatch.setattr(layers, "sum_of_bits", appears_before)
    with pytest.raises(SatIntervalsError, match=r"left\.tif exists and was not made by"):
        layers.write_once(tmp_path / "left.tif", np.zeros((9, 9), np.float32), np.nan, PLACE, None)
    assert contents(tmp_path) == {str(tmp_path / "left.tif"): b"mine"}


def test_match_batch__that_fails_to_overwrite_keeps_the_runs(small_pair, monkeypatch):
    folder, settings = small_pair
    pairs = [PairOfBatch("one", str(folder / "left.tif"), str(folder / "right.tif"))]
    match_batch(pairs, folder / "out", settings)
    before = contents(folder / "out" / "one")
    monkeypatch.setattr(strips, "postprocess_strip", fail)
    report = match_batch(pairs, folder / "out", settings | {"median": None}, overwrite=True)
    assert report["one"]["state"] == "failed"
    assert {name: content for name, content in contents(folder / "out" / "one").items() if name in before} == before


def test_export__that_fails_keeps_the_files_of_before(finished, tmp_path, monkeypatch):
    export(finished, "otb", tmp_path / "otb")
    before = contents(tmp_path / "otb")
    monkeypatch.setattr("sat_intervals.raster.writer.template", fail)
    with pytest.raises(OutputError):
        export(finished, "otb", tmp_path / "otb")
    assert contents(tmp_path / "otb") == before


@pytest.mark.parametrize("name", ["report.html", "profile.png"])
def test_report_and_plot__replace_only_files_that_they_made(finished, name):
    command = ["report", finished] if name == "report.html" else ["plot", finished, "--row", 0, "--dpi", 50]
    assert invoke(*command).exit_code == 0
    made = contents(finished)
    (finished / "curve.png").write_text("of nobody's concern")
    (finished / name).write_text("mine, about sat-intervals")
    before = contents(finished)
    refused(command, f"{name} exists and was not made by sat-intervals", "move it away")
    assert contents(finished) == before
    for own in ("overview.png", "profile.png", "report.html"):
        if str(finished / own) in made:
            (finished / own).write_bytes(made[str(finished / own)])
            os.utime(finished / own, (0, 0))
    assert invoke(*command).exit_code == 0
    assert (finished / name).stat().st_mtime
    assert (finished / "curve.png").read_text() == "of nobody's concern"


@pytest.mark.parametrize("kind", [stat.S_IFIFO, stat.S_IFSOCK])
@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("report", "report.html"),
        ("plot", "overview.png"),
        ("project", "project.qgz"),
        ("project", "width.vrt"),
        ("stac", "stac.json"),
    ],
)
def test_commands__replace_no_pipe_and_no_socket(finished, command, name, kind):
    os.mknod(finished / name, 0o600 | kind)
    before = sorted(finished.iterdir())
    what = "named pipe" if kind == stat.S_IFIFO else "socket"
    refused([command, finished], f"{finished / name} is a {what}: move it away or choose another output")
    assert sorted(finished.iterdir()) == before
    assert stat.S_IFMT((finished / name).stat().st_mode) == kind


@pytest.mark.parametrize("name", ["report.html", "profile.png"])
def test_report_and_plot__replace_a_whole_file_and_no_link(finished, tmp_path, monkeypatch, name):

    def write():
        if name == "report.html":
            write_report(open_results(finished))
        else:
            draw_profile(open_results(finished), finished / name, 0, dpi=50)

    precious = tmp_path / "precious"
    precious.write_text("mine")
    (finished / name).symlink_to(precious)
    write()
    assert precious.read_text() == "mine"
    assert not (finished / name).is_symlink()
    before = contents(finished)
    write_bytes = Path.write_bytes
    monkeypatch.setattr(Path, "write_bytes", lambda path, content: write_bytes(path, content[:100]) and fail())
    with pytest.raises(SatIntervalsError, match=rf"{name} cannot be written: Input/output error"):
        write()
    monkeypatch.undo()
    assert contents(finished) == before


@pytest.mark.parametrize("late", ["overview.png", "profile.png"])
def test_plot__writes_no_picture_if_one_of_the_user_appears_while_it_draws(finished, monkeypatch, late):
    """One after another, `overview.png` would be new and `profile.png` old."""
    assert invoke("plot", finished, "--row", "0", "--dpi", "50").exit_code == 0
    drawn = Figure.savefig

    def savefig(figure, stream, **options):
        drawn(figure, stream, **options)
        (finished / late).unlink(missing_ok=True)
        (finished / late).write_text("mine")

    before = contents(finished)
    monkeypatch.setattr(Figure, "savefig", savefig)
    refused(["plot", finished, "--row", "1", "--dpi", "60"], f"{late} exists and was not made by sat-intervals")
    assert contents(finished) == before | {str(finished / late): b"mine"}


def test_plot__keeps_a_picture_that_another_process_wrote_while_it_drew(finished, monkeypatch):
    assert invoke("plot", finished, "--row", "0", "--dpi", "50").exit_code == 0
    other = (finished / "profile.png").read_bytes()
    drawn = Figure.savefig

    def savefig(figure, stream, **options):
        drawn(figure, stream, **options)
        (finished / "overview.png").write_bytes(other)

    monkeypatch.setattr(Figure, "savefig", savefig)
    refused(["plot", finished, "--dpi", "60"], "overview.png was written by another process meanwhile")
    assert (finished / "overview.png").read_bytes() == other


def test_plot__needs_no_temporary_folder_of_the_system(finished, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(finished / "missing"))
    assert invoke("plot", finished, "--dpi", "50").exit_code == 0


# Files of others with the names of ours


NAMES = "intervals.tif", "validity.tif", "run.json"


def killed(number, *arguments, **options):
    """`match_pair` that is killed at its n-th change of names; at 0 before it writes any file of the run."""

    def assemble(*arguments):
        raise Killed

    with pytest.MonkeyPatch.context() as patch, killed_while_publishing(number):
        if not number:
            patch.setattr(OutputWriter, "assemble", assemble)
        with pytest.raises(Killed):
            match_pair(*arguments, **options)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A pair, settings of one tile, and two runs of it that kept their tiles."""
    folder = tmp_path_factory.mktemp("runs")
    settings = write_pair(folder, make_scene(60, 90, seed=2), cluster={"workers": 1})
    images = folder / "left.tif", folder / "right.tif"
    other = settings | {"median": None}
    match_pair(*images, folder / "one", settings, keep_tiles=True)
    match_pair(*images, folder / "two", other, keep_tiles=True)
    assert hashes(folder / "one") != hashes(folder / "two")
    return folder, images, settings, other


def old_files(out, before):
    """Names of the earlier run's files that still exist, anywhere in the folder of the run."""
    there = {file.read_bytes() for file in out.rglob("*") if file.is_file()}
    return {name for name in NAMES if before[str(out / name)] in there}


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_match__keeps_a_file_of_the_user_that_appears_during_the_run(runs, tmp_path, name, overwrite):
    _, images, settings, other = runs
    out = tmp_path / "out"
    if overwrite:
        match_pair(*images, out, other)

    def progress(stage, done, total):
        if stage == "bands" and not done < total:
            (out / name).write_text("mine")

    before = contents(out)
    with pytest.raises(
        RunError, match=rf"{name} is not of this run, .*: move it away; rerun the same command"
    ) as error:
        match_pair(*images, out, settings, overwrite=overwrite, progress=progress)
    assert "\n" not in str(error.value)
    found = {file: content for file, content in contents(out).items() if "/tiles/" not in file}
    assert found == before | {str(out / name): b"mine"}
    shutil.move(out / name, tmp_path / name)
    match_pair(*images, out, settings)
    assert hashes(out) == hashes(runs[0] / "one")
    assert (tmp_path / name).read_text() == "mine"
    assert sorted(path.name for path in out.iterdir()) == sorted(NAMES)


def test_match__keeps_the_edited_report_of_an_equal_run_that_appears_during_it(runs, tmp_path):
    folder, images, settings, _ = runs
    report = tmp_path / "out" / "run.json"
    edited = json.dumps(json.loads((folder / "one" / "run.json").read_text()) | {"note": "mine"})

    def progress(stage, done, total):
        if stage == "bands" and not done < total:
            report.write_text(edited)

    with pytest.raises(RunError, match=r"run\.json is not of this run"):
        match_pair(*images, report.parent, settings, progress=progress)
    assert report.read_text() == edited


@pytest.mark.parametrize("number", [1, 2, 3])
def test_match__goes_on_after_a_kill_between_the_names_of_its_files(runs, tmp_path, number):
    folder, images, settings, _ = runs
    out = tmp_path / "out"
    shutil.copytree(folder / "one", out)
    for name in NAMES:
        (out / name).unlink()
    killed(number, *images, out, settings)
    match_pair(*images, out, settings)
    assert hashes(out) == hashes(folder / "one")
    assert sorted(path.name for path in out.iterdir()) == sorted(NAMES)


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5, 6])
def test_match__keeps_the_run_to_replace_until_the_new_one_exists(runs, tmp_path, number):
    folder, images, settings, _ = runs
    out = tmp_path / "out"
    shutil.copytree(folder / "two", out)
    before = contents(out)
    killed(number, *images, out, settings, overwrite=True)
    killed(0, *images, out, settings)
    assert old_files(out, before) == set(NAMES)
    if number < 5:  # none of the new files had its name
        assert {name: (out / name).read_bytes() for name in NAMES} == {name: before[str(out / name)] for name in NAMES}
    match_pair(*images, out, settings)
    assert hashes(out) == hashes(folder / "one")
    assert sorted(path.name for path in out.iterdir()) == sorted(NAMES)


@pytest.mark.parametrize("is_truncated", [False, True])
def test_match__takes_no_run_that_was_copied_there_for_its_own(runs, tmp_path, monkeypatch, is_truncated):
    folder, images, settings, _ = runs
    out, publish = tmp_path / "out", OutputWriter.publish

    def publish_after_a_copy(*arguments, **options):
        for name in NAMES:
            shutil.copy(folder / "two" / name, out)
        return publish(*arguments, **options)

    monkeypatch.setattr(OutputWriter, "publish", publish_after_a_copy)
    with pytest.raises(RunError, match="is not of this run"):
        match_pair(*images, out, settings)
    monkeypatch.undo()
    copied = {name: (out / name).read_bytes() for name in NAMES}
    if is_truncated:  # by a power loss, to the name of the run
        mark = out / "tiles" / ".sat-intervals.finished"
        mark.write_text(mark.read_text().split("\n")[0])
    with pytest.raises(SatIntervalsError, match=r"intervals\.tif was changed after the run, but the tiles still exist"):
        match_pair(*images, out, settings)
    assert {name: (out / name).read_bytes() for name in NAMES} == copied
    assert list((out / "tiles" / "records").iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_match__overwrites_no_file_where_there_is_no_run(runs, tmp_path, name):
    folder, images, *_ = runs
    (tmp_path / name).write_bytes((folder / "left.tif").read_bytes() if name.endswith("tif") else b'{"mine": 1}')
    before = contents(tmp_path)
    command = ["match", *images, tmp_path, "--config", folder / "settings.yaml", "--overwrite"]
    refused(command, f"{name} exists and was not made by sat-intervals", "move it away")
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["left.tif", "truth.tif"])
def test_demo__overwrites_no_image_that_it_did_not_make(tmp_path, name):
    write_layer(tmp_path / name, np.ones((9, 9), np.uint16), 0, PLACE)
    before, command = contents(tmp_path), ["demo", tmp_path, "--size", 100, 110, "--overwrite", "--quiet"]
    refused(command, f"{name} exists and was not made by sat-intervals")
    assert before.items() <= contents(tmp_path).items()
    assert not list(tmp_path.glob(".sat-intervals.*"))
    (tmp_path / name).rename(tmp_path / "mine.tif")
    assert invoke(*command).exit_code == 0


@pytest.mark.parametrize("command", ["demo", "project"])
def test_commands__refuse_masks_beside_the_rasters_that_they_write(small_pair, command):
    folder, settings = small_pair
    mask = folder / "out" / ("left.tif.msk" if command == "demo" else "width.vrt.MSK")
    if command == "project":
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    mask.parent.mkdir(exist_ok=True)
    shutil.copy(folder / "mask.tif", mask)
    before = contents(mask.parent)
    options = ["--size", 100, 110, "--quiet"] if command == "demo" else []
    refused([command, mask.parent, *options], f"{mask.name} changes what is read from", "move it away")
    assert contents(mask.parent) == before


def test_demo__deletes_no_file_with_a_name_like_that_of_its_copies(tmp_path):
    mine = tmp_path / ".sat-intervals.mine.left.tif"
    mine.write_text("mine")
    with put_back([tmp_path / "left.tif"], tmp_path / "run.json"):
        pass
    assert mine.read_text() == "mine"


@pytest.mark.parametrize(
    ("form", "name"), [("otb", "disparity.tif"), ("s2p", "rectified_mask.png"), ("cars", "epi_disp_mask.tif")]
)
def test_export__replaces_only_its_own_files(finished, tmp_path, form, name):
    target = tmp_path / "target"
    export(finished, form, target)
    export(finished, form, target)
    profile = {"count": 1, "dtype": "uint8", "height": 2, "width": 2}
    driver = "PNG" if name.endswith("png") else "GTiff"
    profile |= {"WRITE_METADATA_AS_TEXT": "YES"} if driver == "PNG" else {}
    mine, of_another_command = {}, {"Software" if driver == "PNG" else "SOFTWARE": "sat-intervals"}
    for tags in (mine, of_another_command, of_another_command | {"EXPORT": "another"}):
        with rasterio.open(target / name, "w", driver, **profile) as file:
            file.update_tags(**tags)
            file.write(np.ones((1, 2, 2), np.uint8))
        before = contents(target)
        by = f" export --to {form}" if tags else ""
        with pytest.raises(SatIntervalsError, match=rf"{name} exists and was not made by sat-intervals{by}, .*move it"):
            export(finished, form, target)
        assert contents(target) == before


def test_export__keeps_a_mask_of_s2p_that_was_changed_by_a_program_that_copies_its_tags(finished, tmp_path):
    mask = tmp_path / "rectified_mask.png"
    export(finished, "s2p", tmp_path)
    with rasterio.open(mask) as file:
        pixels, kind, tags = file.read(), {"driver": "PNG", "count": 1, "dtype": "uint8"}, file.tags()
    kind |= {"height": pixels.shape[1], "width": pixels.shape[2], "WRITE_METADATA_AS_TEXT": "YES"}
    with rasterio.open(mask, "w", **kind) as file:
        file.update_tags(**tags)
        file.write(1 - pixels)
    before = contents(tmp_path)
    refused(["export", finished, tmp_path, "--to", "s2p"], f"{mask} was changed since sat-intervals made it")
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["disparity.tif", "mask.tif"])
def test_export__keeps_a_file_that_was_changed_in_its_place(finished, tmp_path, name):
    export(finished, "otb", tmp_path)
    with rasterio.open(tmp_path / name, "r+", IGNORE_COG_LAYOUT_BREAK=True) as file:  # keeps the tags
        file.write(np.zeros((1, 2, 2), file.dtypes[0])[0], 1, window=((0, 2), (0, 2)))
        assert file.tags()["EXPORT"] == "otb"
    before = contents(tmp_path)
    refused(["export", finished, tmp_path, "--to", "otb"], f"{name} was changed since sat-intervals made it")
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("command", "name", "edit"),
    [
        (["plot"], "overview.png", b"edited"),
        (["report"], "report.html", b"<p>mine</p>"),
        (["stac"], "stac.json", b"\n"),
    ],
)
def test_commands__keep_pictures_and_pages_that_were_edited(finished, command, name, edit):
    for _ in range(2):  # their own files are replaced
        assert invoke(*command, finished).exit_code == 0
    (finished / name).write_bytes(mine := (finished / name).read_bytes() + edit)
    refused([*command, finished], f"{name} exists and was not made by sat-intervals", "changed since")
    assert (finished / name).read_bytes() == mine


@pytest.mark.parametrize("elsewhere", [False, True])
def test_match__removes_what_a_kill_left_of_its_marks(runs, tmp_path, elsewhere):
    _, images, settings, _ = runs
    settings = settings | {"cluster": {"workers": 1} | ({"store": str(tmp_path / "store")} if elsewhere else {})}
    out = tmp_path / "out"
    job = prepare(*images, out, settings)
    job.begin()
    (out / "tiles" / f"..sat-intervals.finished.{32 * 'a'}").write_text("half")
    match_pair(*images, out, settings)
    assert sorted(path.name for path in out.iterdir()) == sorted(NAMES)


@pytest.mark.parametrize(
    "words", [["config"], ["status", "out"], ["match", "/a.tif", "/b.tif", "out", "--disparity", "0", "1"]]
)
def test_commands__say_that_the_working_directory_is_gone(tmp_path, words):
    script = 'mkdir gone && cd gone && rmdir ../gone && exec "$@"'
    done = subprocess.run(
        ["sh", "-c", script, "sh", COMMAND, *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "sat-intervals: the working directory was deleted: change to another folder"
    assert "Traceback" not in done.stderr


def test_dsm__says_that_the_working_directory_was_deleted_meanwhile(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")

    def deleted(outs):
        (tmp_path / "gone").rmdir()
        return [out.absolute() for out in outs]

    monkeypatch.setattr(dsm, "triangulated", deleted)
    result = invoke("dsm", "out", "--resolution", "1")
    assert result.exit_code == 1
    assert result.stderr.endswith("; the working directory was deleted: change to another folder\n")
