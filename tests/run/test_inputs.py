"""Inputs that change while a run reads them, between two calls, or after it."""

import os
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import rasterio
from helpers import PLACE, STATISTICS, hashes, refused
from rasterio.errors import RasterioDeprecationWarning

from sat_intervals.errors import ChangedInputError, RunError, SatIntervalsError
from sat_intervals.raster import open_image, write_layer
from sat_intervals.raster.identity import identity
from sat_intervals.results import open_results
from sat_intervals.run.pair import match_pair

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def swap(file, content):
    """Replace a file by another, if possible of the same size and time."""
    status, new = file.stat(), file.with_name("new")
    new.write_bytes(content)
    os.utime(new, ns=(status.st_atime_ns, status.st_mtime_ns))
    os.replace(new, file)


@pytest.mark.parametrize(
    ("name", "stage"), [("right.tif", "tiles"), ("right.tif", "bands"), ("mask.tif", "bands"), ("link", "tiles")]
)
def test_match_pair__ends_where_an_input_is_replaced_and_mixes_nothing(small_pair, name, stage):
    folder, settings = small_pair
    right, mask, kept = folder / "right.tif", folder / "mask.vrt", (folder / "right.tif").read_bytes()
    if name == "link":
        right = folder / "link.tif"
        right.symlink_to("right.tif")
    before = (folder / "mask.tif").read_bytes()
    write_layer(folder / "masked.tif", np.ones((80, 100), np.uint8), 0, PLACE)
    undone = True

    def progress(now, done, total):
        nonlocal undone
        if now == stage and done and undone:
            undone = False
            if name == "link":
                right.unlink()
                right.symlink_to("other.tif")
            else:
                swap(folder / name, (folder / ("other.tif" if name == "right.tif" else "masked.tif")).read_bytes())

    def images():
        return open_image(folder / "left.tif", mask=mask), open_image(right)

    with pytest.raises(ChangedInputError, match=r" was changed during the run \(.*tiles are deleted: rerun") as error:
        match_pair(*images(), folder / "out", settings, progress=progress)
    assert "\n" not in str(error.value)
    assert isinstance(error.value, RunError)
    assert not list((folder / "out").glob("[a-z]*.*"))
    if name == "link":
        right.unlink()
        right.symlink_to("right.tif")
    swap(folder / "mask.tif", before)
    swap(folder / "right.tif", kept)
    match_pair(*images(), folder / "out", settings)
    match_pair(*images(), folder / "once", settings)
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


def test_match_pair__knows_an_image_in_an_archive(small_pair):
    folder, settings = small_pair
    with zipfile.ZipFile(folder / "a.zip", "w") as archive:
        archive.write(folder / "left.tif", "left.tif")
    left = f"/vsizip/{folder}/a.zip/left.tif"
    report = match_pair(left, folder / "right.tif", folder / "out", settings)
    assert report["inputs"]["left"]["path"] == left
    assert report["inputs"]["left"]["sha256"] == identity(str(folder / "a.zip"))["sha256"]
    assert open_results(folder / "out").left.path == left


def test_match_pair__goes_on_where_an_input_is_touched_and_not_changed(small_pair):
    folder, settings = small_pair

    def progress(stage, done, total):
        if stage == "tiles":
            (folder / "left.tif").chmod(0o600 + done % 2)
            shutil.copy(folder / "right.tif", folder / "copy")
            os.replace(folder / "copy", folder / "right.tif")

    report = match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, progress=progress)
    assert report["inputs"]["right"]["sha256"] == identity(str(folder / "right.tif"))["sha256"]


def _show_in_qgis(image):
    with rasterio.open(image) as dataset, pytest.warns(RasterioDeprecationWarning):
        dataset.statistics(1, approx=False)


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


@pytest.mark.parametrize("show", [_show_in_qgis, _show_in_arcgis, _build_pyramids])
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


@pytest.mark.parametrize("dry_run", [[], ["--dry-run"]])
def test_match__names_settings_that_cannot_be_looked_for(small_pair, dry_run):
    folder, _ = small_pair
    name = f"{'a' * 300}.yaml"
    images = folder / "left.tif", folder / "right.tif"
    refused(["match", *images, folder / "out", "--config", name, *dry_run], name, "File name too long")


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
