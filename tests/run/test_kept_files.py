"""Files of the user are never lost: inputs, unrelated files in a folder, and a finished run."""

import html
import itertools
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import threading
import zipfile
from contextlib import suppress
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
import yaml
from cameras import cameras, sensor_words
from finished import random_bands, write_run
from helpers import COMMAND, OUTPUTS, PLACE, calibration, hashes, invoke, write_pair
from matplotlib.figure import Figure
from rasterio.errors import RasterioDeprecationWarning
from rasterio.shutil import copy

from sat_intervals.cli.matching import PairArguments
from sat_intervals.config import load_config
from sat_intervals.config.pairs import PairOfBatch
from sat_intervals.demo import make_scene
from sat_intervals.errors import ChangedInputError, RunError, SatIntervalsError
from sat_intervals.heights import dsm
from sat_intervals.interop.export import export
from sat_intervals.products import BANDS
from sat_intervals.raster import (
    MARK,
    RUN_FILES,
    Georeferencing,
    InputError,
    OutputError,
    OutputWriter,
    gdal,
    layers,
    open_image,
    other_files,
    publishing,
    put_back,
    read_layers,
    read_window,
    remove_scratch,
    replaceable,
    restore,
    stamps,
    watched_rasters,
    write_layer,
)
from sat_intervals.raster import writer as raster_writer
from sat_intervals.raster.files import File
from sat_intervals.raster.identity import check_not_replaced, identity
from sat_intervals.results import Run, open_results, open_run
from sat_intervals.run import assemble as run_assemble
from sat_intervals.run import copying, search_range, source, strips
from sat_intervals.run.batch import match_batch
from sat_intervals.run.before import report_before
from sat_intervals.run.inputs import appeared_file, describe_inputs
from sat_intervals.run.job import prepare
from sat_intervals.run.pair import match_pair
from sat_intervals.run.tile import match_block
from sat_intervals.show.canvas import page
from sat_intervals.show.profile import draw_profile
from sat_intervals.show.report import write_report
from sat_intervals.store.folder import LocalFolder
from sat_intervals.tiling import Window

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

LOCK = ".sat-intervals.lock"
VRT = """<VRTDataset rasterXSize="100" rasterYSize="80"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>
<SourceFilename relativeToVRT="1">mask.tif</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"""


NODATA = '<PAMDataset><PAMRasterBand band="1"><NoDataValue>7</NoDataValue></PAMRasterBand></PAMDataset>'
STATISTICS = (
    '<PAMDataset><PAMRasterBand band="1"><Metadata><MDI key="STATISTICS_MEAN">7</MDI></Metadata></PAMRasterBand>'
    "</PAMDataset>"
)


@pytest.fixture(scope="module")
def scene():
    return make_scene(80, 100, seed=2)


@pytest.fixture
def pair(scene, tmp_path):
    """A folder with left.tif, right.tif, mask.tif, mask.vrt of it, and other.tif; and settings of four tiles."""
    write_layer(tmp_path / "other.tif", scene.right[::-1].copy(), 0, PLACE)
    write_layer(tmp_path / "mask.tif", np.zeros(scene.left.shape, np.uint8), 0, PLACE)
    (tmp_path / "mask.vrt").write_text(VRT)
    tiles, cluster = {"size": 64, "overlap": 20}, {"workers": 1, "retries": 0}
    disparity = {"minimum": -18, "maximum": 40}
    return tmp_path, write_pair(tmp_path, scene, disparity=disparity, tiles=tiles, cluster=cluster)


def refused(arguments, *parts):
    """Run a command that must end with status 2 and one line."""
    result = invoke(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    for part in parts:
        assert part in result.stderr


def contents(folder):
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# Inputs that change


def swap(file, content):
    """Replace a file by another, if possible of the same size and time."""
    status, new = file.stat(), file.with_name("new")
    new.write_bytes(content)
    os.utime(new, ns=(status.st_atime_ns, status.st_mtime_ns))
    os.replace(new, file)


@pytest.mark.parametrize(
    ("name", "stage"), [("right.tif", "tiles"), ("right.tif", "bands"), ("mask.tif", "bands"), ("link", "tiles")]
)
def test_match_pair__ends_where_an_input_is_replaced_and_mixes_nothing(pair, name, stage):
    folder, settings = pair
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

    images = open_image(folder / "left.tif", mask=mask), open_image(right)
    with pytest.raises(ChangedInputError, match=rf"{name}.* was replaced or changed during the run") as error:
        match_pair(*images, folder / "out", settings, progress=progress)
    assert "\n" not in str(error.value)
    assert isinstance(error.value, RunError)
    assert not list((folder / "out").glob("*.*"))
    with pytest.raises(SatIntervalsError, match=r"holds the tiles of another run: inputs\..*sha256 was "):
        match_pair(open_image(folder / "left.tif", mask=mask), open_image(right), folder / "out", settings)
    if name == "link":
        right.unlink()
        right.symlink_to("right.tif")
    swap(folder / "mask.tif", before)
    swap(folder / "right.tif", kept)
    images = open_image(folder / "left.tif", mask=mask), open_image(right)
    match_pair(*images, folder / "out", settings)
    match_pair(*images, folder / "once", settings)
    assert hashes(folder / "out") == hashes(folder / "once")


@pytest.mark.parametrize("name", ["left.tif.msk", "left.tif.MSK"])
def test_read_window__ends_where_a_mask_cannot_be_found_any_more(pair, name):
    """As on a server that is busy: GDAL would read the image without its mask."""
    folder, _ = pair
    profile = {"driver": "GTiff", "height": 80, "width": 100, "count": 1, "dtype": "uint8"}
    with rasterio.open(folder / name, "w", **profile) as mask:
        mask.update_tags(INTERNAL_MASK_FLAGS_1=2)  # for all bands
    image = open_image(folder / "left.tif")
    assert image.use_mask
    assert read_window(image, Window(0, 0, 8, 8))[1].all()
    (folder / name).unlink()
    with pytest.raises(RunError, match=rf"{name} was there when .*left.tif was opened, but cannot be found now"):
        read_window(image, Window(0, 0, 8, 8))


@pytest.mark.parametrize("name", ["intervals.tif", "run.json"])
def test_match__overwrites_no_result_that_was_changed_since(pair, name):
    folder, settings = pair
    out = folder / "out"
    match_pair(folder / "left.tif", folder / "right.tif", out, settings)
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
def test_match__overwrites_no_file_that_came_after_its_check(pair, monkeypatch, stage):
    """Put aside by a run that was killed before it put it back, or new since the images were opened."""
    folder, settings = pair
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


@pytest.mark.parametrize("way", ["link", "rename", "folder", "folder that gets a file"])
def test_match_pair__reads_again_where_an_input_was_another_one_for_a_moment(pair, monkeypatch, way):
    folder, settings = pair
    (folder / "link.tif").symlink_to("right.tif")
    for name in ("right", "other"):
        (folder / f"{name}s").mkdir()
        shutil.copy(folder / f"{name}.tif", folder / f"{name}s" / "image.tif")
    images = folder / "left.tif", folder / ("rights/image.tif" if "folder" in way else "link.tif")
    match_pair(*images, folder / "once", settings)
    read_views, moments = source.read_views, iter(range(2))

    def exchange():
        right, other = ("right.tif", "other.tif") if way == "rename" else ("rights", "others")
        for before, after in ((right, "kept"), (other, right), ("kept", other)):
            os.rename(folder / before, folder / after)

    def put(name):
        (folder / "new").symlink_to(name)
        os.replace(folder / "new", folder / "link.tif")

    def blink(*arguments):
        if next(moments, None) is None:
            return read_views(*arguments)
        put("other.tif") if way == "link" else exchange()
        views = read_views(*arguments)
        put("right.tif") if way == "link" else exchange()
        if "file" in way:
            (folder / "rights" / f"new{len(os.listdir(folder / 'rights'))}").touch()
        return views

    monkeypatch.setattr(source, "read_views", blink)
    match_pair(*images, folder / "out", settings)
    assert next(moments, None) is None
    assert hashes(folder / "out") == hashes(folder / "once")


@pytest.mark.parametrize("kind", ["/vsizip/{}", "/vsizip/{{{}}}"])
def test_match_pair__knows_an_image_in_an_archive(pair, kind):
    folder, settings = pair
    left = kind.format(folder / "a.zip") + "/left.tif"

    def pack(name):
        with zipfile.ZipFile(folder / "a.zip", "w") as archive:
            archive.write(folder / name, "left.tif")

    pack("left.tif")
    report = match_pair(left, folder / "right.tif", folder / "out", settings, keep_tiles=True)
    assert report["inputs"]["left"]["path"] == left
    assert report["inputs"]["left"]["sha256"] == identity(str(folder / "a.zip"))["sha256"]
    assert open_results(folder / "out").left.path == left
    (folder / "out" / "run.json").unlink()
    (folder / "out" / "tiles" / "records" / "1_1.json").unlink()
    pack("other.tif")
    with pytest.raises(SatIntervalsError, match=r"holds the tiles of another run: inputs\.left\.bytes was "):
        match_pair(left, folder / "right.tif", folder / "out", settings)
    (folder / "in" / "tiles").mkdir(parents=True)
    inside = shutil.copy(folder / "a.zip", folder / "in" / "tiles")
    with pytest.raises(SatIntervalsError, match="is an input inside"):
        match_pair(f"/vsizip/{inside}/left.tif", folder / "right.tif", folder / "in", settings)


def test_other_files__are_those_of_the_sources_of_a_virtual_raster_too(pair):
    folder, _ = pair
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False), rasterio.open(folder / "mask.tif", "r+") as file:
        file.write_mask(np.full((80, 100), 255, np.uint8))
    assert other_files(str(folder / "mask.vrt")) == [str(folder / "mask.tif"), str(folder / "mask.tif.msk")]


@pytest.mark.parametrize("name", ["outer.vrt", "outer.xml"])
@pytest.mark.parametrize("source", ["vrt://{}?bands=1", "<![CDATA[vrt://{}?bands=1]]>", "GTIFF_DIR:1:{}", "{}.vrt"])
def test_other_files__are_those_of_sources_with_other_names_than_files(pair, source, name):
    folder, _ = pair
    inner = (folder / "mask.vrt").read_text().replace("mask.tif", str(folder / "left.tif"))
    inner = inner.replace('relativeToVRT="1"', 'relativeToVRT="0"').replace("Byte", "UInt16")
    source = html.escape(inner) if source == "{}.vrt" else source.format(folder / "left.tif")
    outer = re.sub(r"(<SourceFilename[^>]*>)[^<]*", lambda found: found[1] + source, inner)
    (folder / name).write_text(outer)
    np.testing.assert_array_equal(read_layers(folder / name), read_layers(folder / "left.tif"))
    assert str(folder / "left.tif") in other_files(str(folder / name))


def test_other_files__are_those_of_mask_bands(pair):
    folder, _ = pair
    band = (folder / "mask.vrt").read_text().replace("mask.tif", "left.tif").replace("Byte", "UInt16")
    mask = re.search("<VRTRasterBand.*</VRTRasterBand>", (folder / "mask.vrt").read_text(), re.DOTALL)[0]
    mask = mask.replace(' band="1"', "")
    (folder / "masked.vrt").write_text(band.replace("</VRTDataset>", f"<MaskBand>{mask}</MaskBand></VRTDataset>"))
    assert other_files(str(folder / "masked.vrt")) == [str(folder / "left.tif"), str(folder / "mask.tif")]


def test_other_files__are_those_of_other_spellings(pair):
    folder, _ = pair
    text = (folder / "mask.vrt").read_text()
    others = {"<VRTDataset": '<VRTDataset xmlns="urn:x"', "Filename": "FILENAME", "relativeToVRT": "RELATIVETOVRT"}
    for other in (text.replace(*spelling) for spelling in others.items()):
        (folder / "other.vrt").write_text(other)
        assert other_files(str(folder / "other.vrt")) == [str(folder / "mask.tif")]


def test_open_image__refuses_a_folder_whose_files_gdal_does_not_list(pair):
    folder, _ = pair
    with rasterio.open(folder / "left.zarr", "w", driver="Zarr", width=100, height=80, count=1, dtype="uint16") as file:
        file.write(np.ones((1, 80, 100), np.uint16))
    with pytest.raises(InputError, match=r"left\.zarr is read from files that GDAL does not list, .*: convert it"):
        open_image(folder / "left.zarr")
    with pytest.raises(InputError, match=r'^ZARR:.*left\.zarr" has the format Zarr, .*: convert it'):
        open_image(f'ZARR:"{folder}/left.zarr"')


@pytest.mark.parametrize("driver", ["AAIGrid", "ENVI", "PCIDSK", "MRF", "ILWIS", "GPKG"])
def test_open_image__refuses_formats_of_which_gdal_does_not_notice_missing_data_or_lists_no_files(tmp_path, driver):
    path = tmp_path / "image.mpr"
    kind = {"width": 30, "height": 20, "count": 1, "dtype": "uint8", "crs": "EPSG:32631", "transform": PLACE.transform}
    with rasterio.open(path, "w", driver=driver, **kind) as file:
        file.write(np.ones((1, 20, 30), np.uint8))
    with pytest.raises(InputError, match=rf"image.mpr has the format {driver}, .*: convert it with gdal_translate"):
        open_image(path)


MASK_BAND = (
    "{}</SimpleSource></VRTRasterBand><MaskBand><VRTRasterBand dataType='Byte'><SimpleSource>{}"
    "<SourceBand>mask,1</SourceBand></SimpleSource></VRTRasterBand></MaskBand></VRTDataset>"
)
USED_MASK = (
    "<NoDataValue>0</NoDataValue><ComplexSource>{}<UseMaskBand>true</UseMaskBand></ComplexSource></VRTRasterBand>"
    "</VRTDataset>"
)


@pytest.mark.parametrize("band", ["<SimpleSource>" + MASK_BAND, USED_MASK])
@pytest.mark.parametrize(
    ("image", "name"),
    [
        *itertools.product(["left.vrt", "left"], ["left.tif.msk", "left.tif.MSK", "left.tif.aux.xml", "left.tif.ovr"]),
        ("left.vrt", "left.aux"),
    ],
)
def test_match_pair__ends_where_a_mask_of_a_source_appears(pair, monkeypatch, band, name, image):
    folder, settings = pair
    source = f"<SourceFilename>{folder / 'left.tif'}</SourceFilename>"
    (folder / image).write_text(
        '<VRTDataset rasterXSize="100" rasterYSize="80"><VRTRasterBand dataType="UInt16" band="1">'
        + band.format(source, source)
    )

    def match_and_mask(job, block):
        match_block(job, block)
        if name.endswith("xml"):
            (folder / name).write_text(NODATA)
        elif name.endswith("aux"):
            of_image = {"AUX": "YES", "DEPENDENT_FILE": "left.tif", "nodata": 7}
            with rasterio.open(folder / name, "w", "HFA", 100, 80, 1, dtype="uint16", **of_image):
                pass
        else:
            shutil.copy(folder / "mask.tif", folder / name)

    monkeypatch.setattr("sat_intervals.run.pair.match_block", match_and_mask)
    with pytest.raises(RunError, match=rf"{name} appeared during the run, whose tiles are deleted: rerun the com"):
        match_pair(folder / image, folder / "right.tif", folder / "out", settings)
    assert not list(folder.glob("out/tiles/records/*"))


@pytest.mark.parametrize("which", ["image", "mask"])
def test_match_pair__ends_where_a_link_to_a_virtual_raster_gets_another_target_of_the_same_bytes(
    pair, monkeypatch, which
):
    """GDAL finds their sources beside the target."""
    folder, settings = pair
    source = "mask.tif" if which == "mask" else "left.tif"
    for name in "ab":
        (folder / name).mkdir()
        shutil.copy(folder / source, folder / name / source)
        copy(folder / name / source, folder / name / "virtual.vrt", driver="VRT")
    assert (folder / "a" / "virtual.vrt").read_bytes() == (folder / "b" / "virtual.vrt").read_bytes()
    link = folder / "link.vrt"
    link.symlink_to("a/virtual.vrt")

    def and_exchange(job, block):
        match_block(job, block)
        link.unlink()
        link.symlink_to("b/virtual.vrt")

    monkeypatch.setattr("sat_intervals.run.pair.match_block", and_exchange)
    left = open_image(folder / "left.tif", mask=link) if which == "mask" else link
    with pytest.raises(RunError, match=rf"b/{source} appeared during the run, whose tiles are deleted: rerun the com"):
        match_pair(left, folder / "right.tif", folder / "out", settings)


@pytest.mark.parametrize("name", ["mask.vrt", "mask.tif"])
def test_open_results__refuses_a_run_whose_mask_was_changed_since(pair, name):
    folder, settings = pair
    left = open_image(folder / "left.tif", mask=folder / "mask.vrt")
    match_pair(left, folder / "right.tif", folder / "out", settings)
    open_results(folder / "out")
    with (folder / name).open("ab") as file:
        file.write(b" ")
    with pytest.raises(SatIntervalsError, match=rf"{name} has changed since it was matched"):
        open_results(folder / "out")


def test_open_results__refuses_a_run_whose_image_got_a_mask_since(pair):
    folder, settings = pair
    match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    shutil.copy(folder / "mask.tif", folder / "left.tif.msk")
    with rasterio.open(folder / "left.tif.msk", "r+") as dataset:
        dataset.update_tags(INTERNAL_MASK_FLAGS_1="2")
    with pytest.raises(SatIntervalsError, match=r"left\.tif has got or lost a mask since it was matched: restore it"):
        open_results(folder / "out")


def test_appeared_file__opens_a_mosaic_with_new_overviews_once(pair, monkeypatch):
    """Not once for each of them: there may be thousands."""
    folder, _ = pair
    part = "<SimpleSource><SourceFilename relativeToVRT='1'>{}.tif</SourceFilename>{}</SimpleSource>"
    sizes = "<SrcRect xSize='100' ySize='80'/><DstRect xSize='100' ySize='80'/>"
    band = "".join(part.format(number, sizes) for number in range(9))
    for number in range(9):
        shutil.copy(folder / "left.tif", folder / f"{number}.tif")
    (folder / "left.vrt").write_text(
        f"<VRTDataset rasterXSize='100' rasterYSize='80'><VRTRasterBand dataType='UInt16' band='1'>{band}"
        "</VRTRasterBand></VRTDataset>"
    )
    images = open_image(folder / "left.vrt"), open_image(folder / "right.tif")
    files = describe_inputs(*images, load_config({"disparity": {"minimum": 0, "maximum": 9}}), {})[1]
    opened, reading = [], gdal.reading

    def counted(path, **options):
        opened.append(path)
        return reading(path, **options)

    monkeypatch.setattr(gdal, "reading", counted)
    assert appeared_file(*images, files) is None
    once = len(opened)
    for number in range(9):
        shutil.copy(folder / "mask.tif", folder / f"{number}.tif.ovr")
    assert appeared_file(*images, files) is None
    assert len(opened) < 4 * once


@pytest.mark.parametrize("name", ["left.tif.ovr", "left.vrt.ovr", "left.tif.aux.xml", "mask.tif.aux.xml"])
def test_match_pair__goes_on_where_a_file_appears_that_changes_nothing(pair, monkeypatch, name):
    """Overviews are not read where nothing is resampled, and a mask in the file comes before a no-data value.

    The finished run is that of the same images.
    """
    folder, settings = pair
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(folder / "left.tif", "r+") as file:
        file.write_mask(np.full(file.shape, 255, np.uint8))
    copy(folder / "left.tif", folder / "left.vrt", driver="VRT")
    left = folder / ("left.vrt" if name.endswith("ovr") else "left.tif")

    def and_appears(job, block):
        match_block(job, block)
        if name.endswith("xml"):
            (folder / name).write_text(NODATA)
        else:
            shutil.copy(folder / "mask.tif", folder / name)

    monkeypatch.setattr("sat_intervals.run.pair.match_block", and_appears)
    match_pair(open_image(left, mask=folder / "mask.tif"), folder / "right.tif", folder / "out", settings)
    if name.endswith("ovr"):
        images = open_image(left, mask=folder / "mask.tif"), open_image(folder / "right.tif")
        assert report_before(*images, folder / "out", load_config(settings), None)


ARCGIS = (
    '<PAMDataset><Metadata domain="Esri"><MDI key="PyramidResamplingType">NEAREST</MDI></Metadata>'
    '<PAMRasterBand band="1"><Metadata><MDI key="STATISTICS_MEAN">7</MDI></Metadata></PAMRasterBand></PAMDataset>'
)


def _show_in_qgis(image):
    with rasterio.open(image) as dataset, pytest.warns(RasterioDeprecationWarning):
        dataset.statistics(1, approx=False)


def _show_in_arcgis(image):
    Path(f"{image}.aux.xml").write_text(ARCGIS)


def _build_pyramids(image):
    other = shutil.copy(image, image.with_name("other.tif"))
    with rasterio.Env(TIFF_USE_OVR=True), rasterio.open(other, "r+") as dataset:
        dataset.build_overviews([2, 4])
    Path(f"{other}.ovr").rename(f"{image}.ovr")


@pytest.mark.parametrize("show", [_show_in_qgis, _show_in_arcgis, _build_pyramids])
def test_match_pair__resumes_when_its_image_was_shown_meanwhile(pair, show):
    folder, settings = pair

    def stop(stage, done, total):
        if stage == "tiles" and done:
            raise KeyboardInterrupt

    images = folder / "left.tif", folder / "right.tif", folder / "out"
    with pytest.raises(KeyboardInterrupt):
        match_pair(*images, settings, progress=stop)
    show(folder / "left.tif")
    assert list(folder.glob("left.tif.*"))
    done = {file: file.stat().st_mtime_ns for file in folder.glob("out/tiles/records/*")}
    match_pair(*images, settings, keep_tiles=True)
    assert done
    assert all(file.stat().st_mtime_ns == time for file, time in done.items())
    show(folder / "right.tif")
    assert report_before(*map(open_image, images[:2]), images[2], load_config(settings), None)
    assert open_results(images[2]).left.path == str(images[0])


def test_match_pair__ends_where_a_memory_map_changes_an_input(pair, monkeypatch):
    folder, settings = pair
    with (folder / "left.tif").open("ab") as file:
        file.write(b"not of the image")
    image = np.memmap(folder / "left.tif", np.uint8, "r+")

    def change(job, block):
        match_block(job, block)
        image[-1] += 1

    monkeypatch.setattr("sat_intervals.raster.identity._stamp", lambda file: "as before")  # until the page is written
    monkeypatch.setattr("sat_intervals.run.pair.match_block", change)
    with pytest.raises(RunError, match="was changed during the run without a change of its modification time"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert not list(folder.glob("out/tiles/records/*"))


@pytest.mark.parametrize("name", ["mask.tif", "points.tif"])
def test_watched_rasters__sees_a_changed_source_and_a_new_file(pair, name):
    folder, _ = pair
    check = watched_rasters([folder / "mask.vrt", folder / "points.tif", None, "http://127.0.0.1:1/image.tif"])
    check()
    with (folder / name).open("ab") as file:
        file.write(b"more")
    with pytest.raises(ChangedInputError, match=rf"{name} was replaced or changed while it was read"):
        check()


def test_prepare__takes_an_image_that_was_shown_since_it_was_opened(pair):
    folder, settings = pair
    left, right = open_image(folder / "left.tif"), open_image(folder / "right.tif")
    (folder / "left.tif.aux.xml").write_text(STATISTICS)
    prepare(left, right, folder / "out", settings)


def test_watched_rasters__sees_a_file_that_appears_beside_one(pair):
    folder, _ = pair
    check = watched_rasters([folder / "left.tif"])
    check()
    (folder / "left.tif.aux.xml").write_text(STATISTICS)
    check()
    (folder / "left.tif.aux.xml").write_text(NODATA)
    with pytest.raises(ChangedInputError, match=r"a file beside .*left\.tif appeared while it was read"):
        check()


@pytest.mark.parametrize("when", ["before", "after"])
def test_find_here__ends_where_an_image_is_replaced(pair, monkeypatch, when):
    folder, _ = pair
    images = open_image(folder / "left.tif"), open_image(folder / "right.tif")

    def search(*arguments):
        shutil.copy(folder / "other.tif", folder / "right.tif")

    if when == "before":
        search()
    monkeypatch.setattr(search_range, "search_range", search)
    with pytest.raises(ChangedInputError, match=r"right\.tif was replaced or changed"):
        search_range.find_here(*images, lambda *progress: None)


def test_match_pair__goes_on_where_an_input_is_touched_and_not_changed(pair):
    folder, settings = pair

    def progress(stage, done, total):
        if stage == "tiles":
            (folder / "left.tif").chmod(0o600 + done % 2)
            shutil.copy(folder / "right.tif", folder / "copy")
            os.replace(folder / "copy", folder / "right.tif")

    report = match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, progress=progress)
    assert report["inputs"]["right"]["sha256"] == identity(str(folder / "right.tif"))["sha256"]


def test_prepare__refuses_an_image_that_was_replaced_since_it_was_opened(scene, pair):
    folder, settings = pair
    left, right = open_image(folder / "left.tif"), open_image(folder / "right.tif")
    write_layer(folder / "left.tif", scene.left, int(scene.left[70, 80]), PLACE)  # another no-data value
    with pytest.raises(ChangedInputError, match=r"left\.tif was replaced or changed since .*left\.tif was opened"):
        prepare(left, right, folder / "out", settings)


@pytest.mark.parametrize("ending", [".aux.xml", ".msk"])
def test_prepare__refuses_an_image_that_got_another_file_since_it_was_opened(pair, ending):
    folder, settings = pair
    left, right = open_image(folder / "left.tif"), open_image(folder / "right.tif")
    if ending == ".msk":
        shutil.copy(folder / "mask.tif", folder / "left.tif.msk")
    else:
        (folder / "left.tif.aux.xml").write_text(NODATA)
    with pytest.raises(ChangedInputError, match=rf"left\.tif\{ending} was replaced or changed since .*left\.tif was o"):
        prepare(left, right, folder / "out", settings)


def test_match_tile__does_not_match_in_vain(pair, monkeypatch):
    folder, settings = pair
    job = prepare(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    job.begin()
    (folder / "left.tif").unlink()
    monkeypatch.setattr("sat_intervals.run.source.cost_areas", None)
    with pytest.raises(ChangedInputError, match=r"left\.tif was replaced or changed"):
        match_block(job, next(iter(job.store.grid)))


# Tiles of another run


def test_store__removes_no_tiles_of_another_run_that_took_their_place(pair):
    folder, settings = pair
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
def test_match__refuses_an_input_that_it_would_lose(pair, way):
    folder, _ = pair
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
def test_commands__refuse_settings_that_they_would_lose(pair, name):
    folder, _ = pair
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


def test_match__takes_no_file_of_the_user_for_a_mark_of_its_own(pair):
    folder, settings = pair
    images, out = (folder / "left.tif", folder / "right.tif"), folder / "out"
    marks = {out / "tiles" / name: "mine" for name in ("replacing", "finished")}
    (out / "tiles").mkdir(parents=True)
    for mark, text in marks.items():
        mark.write_text(text)
    match_pair(*images, out, settings)
    with pytest.raises(SatIntervalsError, match="already holds a run"):
        match_pair(*images, out, settings | {"median": None})
    assert {mark: mark.read_text() for mark in marks} == marks


def test_match__refuses_an_input_inside_the_store(pair):
    folder, settings = pair
    settings["cluster"]["store"] = str(folder / "store")
    images = folder / "left.tif", folder / "right.tif"
    place = Path(prepare(*images, folder / "out", settings).store.elsewhere)
    (place / "records").mkdir(parents=True)
    shutil.move(folder / "left.tif", place / "records" / "left.json")
    (folder / "left.tif").symlink_to(place / "records" / "left.json")
    with pytest.raises(SatIntervalsError, match="is an input inside"):
        match_pair(*images, folder / "out", settings, overwrite=True)


def test_batch__refuses_an_input_that_another_pair_or_its_report_would_replace(pair):
    folder, settings = pair
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


def test_log_file__is_no_input(pair):
    folder, _ = pair
    before = contents(folder)
    command = ["match", folder / "left.tif", folder / "right.tif", folder / "out", "--disparity", "-18", "40"]
    refused([*command, "--log-file", folder / "left.tif"], "left.tif is an input")
    assert contents(folder) == before


@pytest.fixture
def finished(tmp_path):
    """A made-up run with its images; the left image has a name that each tool writes to."""
    return write_run(tmp_path, *random_bands(40, 50))


@pytest.mark.parametrize("name", ["run.json", "intervals.tif"])
def test_log_file__is_no_file_of_the_run(finished, name):
    before = contents(finished)
    refused(["report", finished, "--log-file", finished / name], f"{name} is an input")
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
            SatIntervalsError, match=r"cannot be written: (.*symbolic link|Is a dir|.*not a regular file)"
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
    for look in (replaceable, restore, remove_scratch, lambda out, files: writer(out).__enter__()):
        with pytest.raises(OutputError, match="is a symbolic link"):
            look(tmp_path / "out", RUN_FILES)
        assert contents(precious) == before


def writer(out):
    return OutputWriter(out, RUN_FILES, 4, 5, Georeferencing(), {})


def test_output_writer__deletes_no_files_that_no_process_made(tmp_path):
    place = tmp_path / ".unpublished-intervals.tif" / "files" / "replaced"
    place.mkdir(parents=True)
    for file in (place / "intervals.tif", place.parent / "run.json"):
        file.write_text("mine")
        before = contents(tmp_path)
        for look in (replaceable, restore, remove_scratch, lambda out, files: writer(out).__enter__()):
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


def written(output, *rasters):
    output.write(0, *rasters)
    output.publish(("run.json", "{}"))


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


def exchanged_for_link(file, mine, way="symlink_to"):
    """What a hostile process does as soon as it sees a temporary file."""
    file.rename(mine.with_name("moved"))
    getattr(file, way)(mine)


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


def test_page__draws_nothing_behind_a_link_that_takes_the_place_of_its_temporary_file(tmp_path, monkeypatch):
    (tmp_path / "mine").write_text("mine")
    savefig = Figure.savefig

    def late(*arguments, **named):
        (temporary,) = tmp_path.glob(".overview.png-*/files/*.png")
        exchanged_for_link(temporary, tmp_path / "mine")
        return savefig(*arguments, **named)

    monkeypatch.setattr(Figure, "savefig", late)
    with (
        pytest.raises(OutputError, match=r"its temporary file .*\.png was replaced"),
        page(tmp_path / "overview.png", (1, 1), 50, ""),
    ):
        pass
    assert ((tmp_path / "mine").read_text(), (tmp_path / "overview.png").exists()) == ("mine", False)


def test_output_writer__draws_nothing_behind_a_link_with_the_name_of_its_picture(tmp_path):
    (tmp_path / "mine").write_text("mine")
    file = File("disparity.png", "uint8", None, BANDS[:1], driver="PNG")
    with OutputWriter(tmp_path / "out", [file], 4, 5, Georeferencing(), {}) as output:
        (tmp_path / "out" / ".unpublished-disparity.png" / "files" / "disparity.png").symlink_to(tmp_path / "mine")
        written(output, np.zeros((1, 4, 5), np.uint8))
    assert ((tmp_path / "mine").read_text(), (tmp_path / "out" / "disparity.png").is_symlink()) == ("mine", False)


def exchanged_for_run(monkeypatch, step, out, user):
    """Before a step of the writer, put a link to the folder of another run into the place of its finished files."""
    work = getattr(raster_writer, step)

    def exchanged(*arguments, **named):
        files = out / ".unpublished-intervals.tif" / "files"
        if not files.is_symlink():
            files.rename(out.with_name("moved"))
            files.symlink_to(user)
        return work(*arguments, **named)

    monkeypatch.setattr(raster_writer, step, exchanged)


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


def test_match_pair__writes_no_files_of_a_folder_that_took_the_place_of_its_own(pair, monkeypatch):
    folder, settings = pair
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


@pytest.mark.parametrize("way", ["symlink_to", "hardlink_to"])
def test_match_pair__copies_no_part_behind_a_link_that_takes_the_place_of_a_temporary_file(pair, monkeypatch, way):
    folder, settings = pair
    (folder / "mine").write_text("mine")
    tasks = copying._tasks

    def exchanged(job, path, parts):
        exchanged_for_link(path, folder / "mine", way)
        return tasks(job, path, parts)

    monkeypatch.setattr(copying, "_tasks", exchanged)
    with pytest.raises(SatIntervalsError, match=r"its temporary file .*intervals\.tif was replaced"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert ((folder / "mine").read_text(), (folder / "out" / "intervals.tif").exists()) == ("mine", False)


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


@pytest.mark.parametrize(
    "ending", [".tif.aux.xml", ".tif.msk", ".tif.OVR", ".tif.aux", ".aux", ".RPB", ".rpc", "_rpc.txt", ".IMD"]
)
def test_match_pair__refuses_a_file_that_would_change_what_is_read_from_its_results(pair, ending):
    folder, settings = pair
    mine = folder / "out" / f"intervals{ending}"
    mine.parent.mkdir()
    mine.write_text(NODATA)
    with pytest.raises(SatIntervalsError, match=rf"{ending} changes what is read from .*intervals.tif: move it away"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert [file.name for file in mine.parent.iterdir()] == [mine.name]


def test_match_pair__refuses_a_world_file_beside_its_results_before_it_matches(pair):
    """Images without a transform have results without one."""
    folder, settings = pair
    for side in ("left", "right"):
        write_layer(folder / f"{side}.tif", read_layers(folder / f"{side}.tif")[0], 0, Georeferencing())
    (folder / "out").mkdir()
    (folder / "out" / "intervals.tfw").write_text("2\n0\n0\n-2\n9\n9\n")
    with pytest.raises(SatIntervalsError, match=r"intervals\.tfw changes what is read from .*: move it away"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert [file.name for file in (folder / "out").iterdir()] == ["intervals.tfw"]


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


def test_match_pair__resumes_after_a_file_that_appeared_beside_its_results(pair, monkeypatch):
    folder, settings = pair

    def and_appears(job, block):
        match_block(job, block)
        (folder / "out" / "intervals.tif.ovr").write_text("mine")

    with monkeypatch.context() as patch:
        patch.setattr("sat_intervals.run.pair.match_block", and_appears)
        with pytest.raises(RunError, match=r"ovr changes what is read from .*: move it away; rerun .*: it resumes"):
            match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    (folder / "out" / "intervals.tif.ovr").unlink()
    match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)


@pytest.mark.parametrize("named", ["settings.yaml", "of settings", "given"])
@pytest.mark.parametrize("command", ["match", pytest.param("surface", marks=pytest.mark.peer("shareloc"))])
def test_commands__end_where_settings_are_replaced_before_the_images_are_opened(pair, monkeypatch, command, named):
    """Else old settings and new images would be mixed, where a whole folder is exchanged."""
    folder, _ = pair
    settings, levels, opened = folder / "settings.yaml", folder / "levels.yaml", PairArguments.open
    replaced, words = settings, ["--config", settings]
    if named != "settings.yaml":
        replaced, interval = levels, {"coverage": 0.8, "calibration": str(levels)}
        levels.write_text(yaml.safe_dump(calibration(load_config(settings), 50, 5, 0.9)))
        if named == "given":
            words += ["--coverage", interval["coverage"], "--calibration", levels]
        else:
            settings.write_text(yaml.safe_dump(yaml.safe_load(settings.read_text()) | {"interval": interval}))

    def replaced_before(arguments):
        shutil.copy(replaced, folder / "new")
        (folder / "new").replace(replaced)
        return opened(arguments)

    monkeypatch.setattr(PairArguments, "open", replaced_before)
    images = folder / "left.tif", folder / "right.tif", folder / "out"
    sensors = [*sensor_words(cameras(folder, 80, 100)), "--resolution", 1] if command == "surface" else []
    result = invoke(command, *images, *sensors, *words)
    assert (result.exit_code, f"{replaced.name} was replaced or changed" in result.stderr) == (1, True), result.output
    assert not (folder / "out" / "intervals.tif").exists()


@pytest.mark.parametrize("dry_run", [[], ["--dry-run"]])
def test_match__names_settings_that_cannot_be_looked_for(pair, dry_run):
    folder, _ = pair
    name = f"{'a' * 300}.yaml"
    images = folder / "left.tif", folder / "right.tif"
    refused(["match", *images, folder / "out", "--config", name, *dry_run], name, "File name too long")


def test_match_pair__keeps_a_result_that_is_the_source_of_ranges(pair):
    folder, settings = pair
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


def test_match_pair__replaces_no_results_that_come_with_the_mark_of_a_killed_overwrite(pair, monkeypatch):
    folder, settings = pair
    out = folder / "out"
    before = killed_overwrite(pair, folder / "other", monkeypatch)
    assemble = run_assemble._publish

    def late(*arguments, **named):
        for name in (*OUTPUTS, "tiles/.sat-intervals.replacing"):
            shutil.copy2(folder / "other" / name, out / name)
        return assemble(*arguments, **named)

    monkeypatch.setattr(run_assemble, "_publish", late)
    with pytest.raises(SatIntervalsError, match="is not of this run, or was changed since it started: move it away"):
        match_pair(folder / "left.tif", folder / "other.tif", out, settings)
    assert {name: (out / name).read_bytes() for name in OUTPUTS} == before


def test_match_pair__takes_no_mark_of_another_killed_overwrite_for_its_own(pair, monkeypatch):
    folder, settings = pair
    out, images = folder / "out", (folder / "left.tif", folder / "right.tif")
    before = killed_overwrite(pair, out, monkeypatch)
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


def test_match_pair__is_complete_where_its_tiles_cannot_be_removed(pair, monkeypatch, caplog):
    folder, settings = pair
    tiles, publish = folder / "out" / "tiles", OutputWriter.publish

    def and_exchanged(*arguments, **named):
        publish(*arguments, **named)
        tiles.rename(folder / "away")
        tiles.symlink_to(folder / "away")

    monkeypatch.setattr(OutputWriter, "publish", and_exchanged)
    report = match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert open_run(folder / "out").report == report
    assert "tiles has become a symbolic link" in caplog.text
    assert (folder / "away" / "manifest.json").exists()


def test_whole_file__may_have_a_name_as_long_as_the_system_allows(tmp_path):
    with layers.whole_file(tmp_path / f"{240 * 'a'}.txt") as new:
        new.write_text("content")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["content"]


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


def test_match__refuses_tiles_that_are_a_link_and_takes_an_out_that_is_one(pair):
    folder, settings = pair
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
    match_pair(*images, folder / "out", settings)
    assert (folder / "real" / "run.json").exists()


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["records", "parts", "arrays.zarr", "arrays.zarr/int16", "arrays.zarr/right/c"])
def test_match__refuses_a_link_among_the_folders_of_its_tiles(pair, name, overwrite):
    folder, settings = pair
    (folder / "precious").mkdir()
    (folder / "precious" / "0_0.json").write_text("mine")
    link = folder / "out" / "tiles" / name
    link.parent.mkdir(parents=True)
    link.symlink_to(folder / "precious")
    with pytest.raises(SatIntervalsError, match=rf"{name} is a file or a symbolic link, .*: move it away"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, overwrite=overwrite)
    assert contents(folder / "precious") == {str(folder / "precious" / "0_0.json"): b"mine"}


def test_match__takes_the_tiles_of_a_user_for_no_run_of_its_own(pair):
    folder, settings = pair
    (folder / "out" / "tiles").mkdir(parents=True)
    (folder / "out" / "tiles" / "12_34.png").write_text("mine")
    (folder / "out" / "validity.tif").write_text("mine")
    before = contents(folder)
    with pytest.raises(SatIntervalsError, match=r"validity.tif exists and was not made by sat-intervals"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert contents(folder) == before


def test_match__takes_no_folder_for_one_of_a_run_because_of_its_records(pair):
    folder, settings = pair
    records = folder / "out" / "tiles" / "records"
    records.mkdir(parents=True)
    (records / "0_0.json").write_text('{"crc32": 1}')
    with pytest.raises(SatIntervalsError, match=r"tiles has files that no run made, such as records/0_0.json"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, overwrite=True)
    assert (records / "0_0.json").read_text() == '{"crc32": 1}'


@pytest.mark.parametrize("content", [b'{"finished": 1}', b"II*\0some raster", b"<html>", b"mine\n"])
def test_log_file__is_not_added_to_what_is_no_log(finished, tmp_path, content):
    file = tmp_path / "file"
    file.write_bytes(content)
    refused(["export", finished, tmp_path / "target", "--to", "otb", "--log-file", file], "is not a log", "--log-file")
    assert file.read_bytes() == content


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
def test_commands__follow_no_note_of_a_received_folder(pair, elsewhere, kind):
    folder, settings = pair
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


def test_match__with_the_noted_store_deletes_only_what_its_manifest_names(pair, elsewhere):
    folder, settings = pair
    precious, _, _ = elsewhere
    (folder / "out" / "tiles").mkdir(parents=True)
    (folder / "out" / "tiles" / ".sat-intervals.store").write_text(json.dumps(str(precious)))
    before = contents(precious)
    settings["cluster"]["store"] = str(precious.parent)
    match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, overwrite=True)
    assert contents(precious) == before


def test_status__looks_into_the_store_that_is_named(pair):
    folder, settings = pair
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


def fail(*arguments, **options):
    raise OSError(5, "Input/output error")


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


def test_write_rows__keeps_a_file_that_appears_while_it_is_written(tmp_path):
    def rows():
        yield np.zeros((2, 9, 9), np.int16)
        (tmp_path / "ranges.tif").write_text("mine")

    with pytest.raises(SatIntervalsError, match=r"ranges\.tif exists and was not made by"):
        layers.write_rows(tmp_path / "ranges.tif", rows(), (2, 9, 9), PLACE, {}, {})
    assert contents(tmp_path) == {str(tmp_path / "ranges.tif"): b"mine"}


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


def test_output_writer__publishes_no_file_that_is_truncated_after_it_was_compared(tmp_path):
    with writer(tmp_path) as output:
        output.write(0, np.zeros((4, 4, 5), np.float32), np.zeros((4, 5), np.uint16))
        made = tmp_path / ".unpublished-intervals.tif" / "files" / "intervals.tif"
        with pytest.raises(OutputError, match=r"changed temporary files in .*: rerun the command"):
            output.publish(("run.json", "{}"), announce=lambda stamps: os.truncate(made, 100))
    assert not list(tmp_path.glob("*.*"))


@pytest.mark.parametrize("name", ["other.tif", "larger.tif"])
def test_describe_inputs__of_a_mask_that_is_replaced_when_it_is_open(pair, name):
    folder, settings = pair
    write_layer(folder / "larger.tif", np.zeros((200, 300), np.uint8), 0, PLACE)
    images = open_image(folder / "left.tif", mask=folder / "mask.tif"), open_image(folder / "right.tif")
    describe_inputs(*images, load_config(settings), {})
    os.replace(folder / name, folder / "mask.tif")
    with pytest.raises(ChangedInputError, match=r"mask\.tif was replaced or changed since .*left\.tif was opened"):
        describe_inputs(*images, load_config(settings), {})


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


def test_put_back__of_a_killed_process_keeps_a_file_that_came_after_it(tmp_path):
    file, report = tmp_path / "left.tif", tmp_path / "run.json"
    write_layer(file, np.ones((9, 9), np.uint16), 0, PLACE, MARK)
    report.write_text("before")
    os.rename(file, layers._aside(file, report))  # as a killed process leaves it
    file.write_text("mine")
    with pytest.raises(SatIntervalsError, match=r"left\.tif exists and was not made by"), put_back([file], report):
        pass
    assert file.read_text() == "mine"


def test_match_batch__that_fails_to_overwrite_keeps_the_runs(pair, monkeypatch):
    folder, settings = pair
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
            (finished / own).write_bytes(made[str(finished / own)] + b"older")
    assert invoke(*command).exit_code == 0
    assert not (finished / name).read_bytes().endswith(b"older")
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
    whole = Path.write_text

    def half(path, text, **options):
        whole(path, text[:100], **options)
        fail()

    monkeypatch.setattr(Path, "write_text", half)
    monkeypatch.setattr(Figure, "savefig", lambda figure, stream, **options: stream.write(b"x" * 100) and fail())
    with pytest.raises(SatIntervalsError, match=rf"{name} cannot be written: Input/output error"):
        write()
    monkeypatch.undo()
    assert contents(finished) == before


# Files of others with the names of ours


NAMES = "intervals.tif", "validity.tif", "run.json"


class Killed(BaseException):
    """As a kill by the system: nothing is tidied up."""


def killed(number, *arguments, **options):
    """`match_pair` that is killed at its n-th change of names; at 0 before it writes any file of the run."""
    calls = itertools.count(1)

    def counted(function):
        def call(*arguments, **options):
            if next(calls) >= number:
                raise Killed
            return function(*arguments, **options)

        return call

    def publish(*arguments):
        changing = {name: counted(getattr(os, name)) for name in ("replace", "link", "unlink")}
        patch.setattr(publishing, "os", SimpleNamespace(**vars(os) | changing))
        publishing.publish(*arguments)

    def assemble(*arguments):
        raise Killed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OutputWriter, "_clean", lambda writer: writer._locked.close())
        patch.setattr("sat_intervals.raster.writer.publish", publish)
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


@pytest.mark.parametrize("number", range(1, 7))
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


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5, 8, 9])
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
        publish(*arguments, **options)

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


def test_whole_file__is_on_the_disk_before_it_gets_its_name(tmp_path, monkeypatch):
    written, path = [], tmp_path / "file"
    monkeypatch.setattr(layers.os, "fsync", lambda file: written.append((os.pread(file, 9, 0), path.exists())))
    with layers.whole_file(path) as new:
        new.write_text("content")
    assert (written, path.read_text()) == ([(b"content", False)], "content")


@pytest.mark.parametrize("command", ["demo", "project"])
def test_commands__refuse_masks_beside_the_rasters_that_they_write(pair, command):
    folder, settings = pair
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
