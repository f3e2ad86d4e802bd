"""Inputs that change while a run reads them, between two calls, or after it."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from helpers import PLACE, STATISTICS, hashes

from sat_intervals.errors import ChangedInputError, RunError, SatIntervalsError
from sat_intervals.raster import open_image, write_layer
from sat_intervals.raster.identity import identity
from sat_intervals.run.pair import match_pair
from sat_intervals.store.manifest import changes

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def swap(file, content):
    """Replace a file by another, if possible of the same size and time."""
    status, new = file.stat(), file.with_name("new")
    new.write_bytes(content)
    os.utime(new, ns=(status.st_atime_ns, status.st_mtime_ns))
    os.replace(new, file)


@pytest.mark.parametrize(("name", "stage"), [("right.tif", "tiles"), ("right.tif", "bands"), ("mask.tif", "bands")])
def test_match_pair__ends_where_an_input_is_replaced_and_mixes_nothing(small_pair, name, stage):
    folder, settings = small_pair
    kept = (folder / name).read_bytes()
    write_layer(folder / "masked.tif", np.ones((80, 100), np.uint8), 0, PLACE)
    other = (folder / ("other.tif" if name == "right.tif" else "masked.tif")).read_bytes()
    undone = True

    def progress(now, done, total):
        nonlocal undone
        if now == stage and done and undone:
            undone = False
            swap(folder / name, other)

    def matched(out, **options):
        left = open_image(folder / "left.tif", mask=folder / "mask.vrt")
        match_pair(left, folder / "right.tif", folder / out, settings, **options)

    with pytest.raises(ChangedInputError, match=r" was changed during the run \(.*tiles are deleted: rerun") as error:
        matched("out", progress=progress)
    assert "\n" not in str(error.value)
    assert isinstance(error.value, RunError)
    assert not list((folder / "out").glob("[a-z]*.*"))
    swap(folder / name, kept)
    matched("out")
    matched("once")
    assert hashes(folder / "out") == hashes(folder / "once")


def test_match_pair__ends_where_a_mask_appears_beside_an_image(small_pair):
    folder, settings = small_pair

    def progress(stage, done, total):
        if stage == "bands":
            shutil.copy(folder / "mask.tif", folder / "left.tif.msk")

    with pytest.raises(ChangedInputError, match=r"left\.tif was changed during the run \(left\.files was"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, progress=progress)
    assert not list((folder / "out").glob("[a-z]*.*"))


def test_match_pair__names_an_input_that_is_gone_at_the_end(small_pair):
    folder, settings = small_pair

    def progress(stage, done, total):
        if stage == "files":
            (folder / "right.tif").unlink(missing_ok=True)

    with pytest.raises(SatIntervalsError, match=r"right\.tif"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, progress=progress)
    assert not list((folder / "out").glob("*.tif"))


def test_match_pair__goes_on_where_an_input_is_touched_and_not_changed(small_pair):
    folder, settings = small_pair

    def progress(stage, done, total):
        if stage == "tiles":
            (folder / "left.tif").chmod(0o600 + done % 2)
            shutil.copy(folder / "right.tif", folder / "copy")
            os.replace(folder / "copy", folder / "right.tif")

    report = match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, progress=progress)
    assert report["inputs"]["right"]["sha256"] == identity(str(folder / "right.tif"))["sha256"]


def _show_in_arcgis(image):
    image.with_name(f"{image.name}.aux.xml").write_text(STATISTICS)


def _build_pyramids(image):
    other = shutil.copy(image, image.with_name("other.tif"))
    with rasterio.Env(TIFF_USE_OVR=True), rasterio.open(other, "r+") as dataset:
        dataset.build_overviews([2, 4])
    Path(f"{other}.ovr").rename(f"{image}.ovr")


def _stop_at_tiles(stage, done, total):
    if stage == "tiles" and done:
        raise KeyboardInterrupt


@pytest.mark.parametrize("show", [_show_in_arcgis, _build_pyramids])
def test_match_pair__resumes_when_its_image_was_shown_meanwhile(small_pair, show):
    folder, settings = small_pair
    images = folder / "left.tif", folder / "right.tif", folder / "out"
    with pytest.raises(KeyboardInterrupt):
        match_pair(*images, settings, progress=_stop_at_tiles)
    show(folder / "left.tif")
    assert list(folder.glob("left.tif.*"))
    done = {file: file.stat().st_mtime_ns for file in folder.glob("out/tiles/tiles/*")}
    finished = match_pair(*images, settings, keep_tiles=True)["finished"]
    assert done
    assert all(file.stat().st_mtime_ns == time for file, time in done.items())
    show(folder / "right.tif")
    assert match_pair(*images, settings)["finished"] == finished


def test_changes__are_none_of_a_file_whose_server_is_away():
    there = {"path": "s3://bucket/left.tif", "bytes": 9, "etag": "one"}
    assert changes("left.tif", there, there | {"etag": "two"}) == ['etag was "one", now "two"']
    with pytest.raises(RunError, match=r"left.tif cannot be compared now .*: rerun the same command"):
        changes("left.tif", there, {"path": "s3://bucket/left.tif"})


def test_match_pair__refuses_to_resume_with_a_changed_input(small_pair):
    folder, settings = small_pair
    images = folder / "left.tif", folder / "right.tif", folder / "out"
    with pytest.raises(KeyboardInterrupt):
        match_pair(*images, settings, progress=_stop_at_tiles)
    kept = (folder / "right.tif").read_bytes()
    shutil.copy(folder / "other.tif", folder / "right.tif")
    with pytest.raises(ChangedInputError, match=r"holds the tiles of another run: inputs\.right\..*sha256 was "):
        match_pair(*images, settings)
    (folder / "right.tif").write_bytes(kept)
    match_pair(*images, settings)
