"""Inputs that change while a run reads them, or after it."""

import html
import itertools
import os
import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import rasterio
import yaml
from cameras import cameras, sensor_words
from helpers import NODATA, PLACE, STATISTICS, calibration, hashes, invoke, refused
from rasterio.errors import RasterioDeprecationWarning
from rasterio.shutil import copy

from sat_intervals.cli.matching import PairArguments
from sat_intervals.config import load_config
from sat_intervals.errors import ChangedInputError, RunError, SatIntervalsError
from sat_intervals.raster import (
    InputError,
    gdal,
    open_image,
    other_files,
    read_layers,
    read_window,
    watched_rasters,
    watching,
    write_layer,
)
from sat_intervals.raster import identity as identities
from sat_intervals.raster.identity import identity
from sat_intervals.results import open_results
from sat_intervals.run import search_range, source
from sat_intervals.run.before import report_before
from sat_intervals.run.inputs import appeared_file, describe_inputs
from sat_intervals.run.job import prepare
from sat_intervals.run.pair import match_pair
from sat_intervals.run.tile import match_block
from sat_intervals.tiling import Window

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
def test_read_window__ends_where_a_mask_cannot_be_found_any_more(small_pair, name):
    """As on a server that is busy: GDAL would read the image without its mask."""
    folder, _ = small_pair
    profile = {"driver": "GTiff", "height": 80, "width": 100, "count": 1, "dtype": "uint8"}
    with rasterio.open(folder / name, "w", **profile) as mask:
        mask.update_tags(INTERNAL_MASK_FLAGS_1=2)  # for all bands
    image = open_image(folder / "left.tif")
    assert image.use_mask
    assert read_window(image, Window(0, 0, 8, 8))[1].all()
    (folder / name).unlink()
    with pytest.raises(RunError, match=rf"{name} was there when .*left.tif was opened, but cannot be found now"):
        read_window(image, Window(0, 0, 8, 8))


@pytest.mark.parametrize("way", ["link", "rename", "folder", "folder that gets a file"])
def test_match_pair__reads_again_where_an_input_was_another_one_for_a_moment(small_pair, monkeypatch, way):
    folder, settings = small_pair
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


def test_match_pair__reads_again_where_a_mask_beside_a_source_was_there_for_a_moment(small_pair, monkeypatch):
    folder, settings = small_pair
    copy(folder / "right.tif", folder / "right.vrt", driver="VRT")
    match_pair(folder / "left.tif", folder / "right.vrt", folder / "once", settings)
    read_views, moments = source.read_views, iter(range(2))

    def with_mask(*arguments):
        if next(moments, None) is None:
            return read_views(*arguments)
        (folder / "right.tif.msk").touch()
        views = read_views(*arguments)
        (folder / "right.tif.msk").unlink()
        return views[::-1]  # as if another image had been read

    monkeypatch.setattr(source, "read_views", with_mask)
    match_pair(folder / "left.tif", folder / "right.vrt", folder / "out", settings)
    assert next(moments, None) is None
    assert hashes(folder / "out") == hashes(folder / "once")


@pytest.mark.parametrize("kind", ["/vsizip/{}", "/vsizip/{{{}}}"])
def test_match_pair__knows_an_image_in_an_archive(small_pair, kind):
    folder, settings = small_pair
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
    with pytest.raises(
        ChangedInputError, match=r"a\.zip was replaced since this process read it first.*: extract it or"
    ):
        match_pair(left, folder / "right.tif", folder / "out", settings)
    identities._ARCHIVES.clear()  # as in a new process
    with pytest.raises(SatIntervalsError, match=r"holds the tiles of another run: inputs\.left\.bytes was "):
        match_pair(left, folder / "right.tif", folder / "out", settings)
    (folder / "in" / "tiles").mkdir(parents=True)
    inside = shutil.copy(folder / "a.zip", folder / "in" / "tiles")
    with pytest.raises(SatIntervalsError, match="is an input inside"):
        match_pair(f"/vsizip/{inside}/left.tif", folder / "right.tif", folder / "in", settings)


@pytest.mark.parametrize("name", ["left.tif.aux.xml", "left_RPC.TXT"])
def test_match_pair__refuses_a_link_to_nothing_beside_the_source_of_a_virtual_raster(small_pair, name):
    """Its target could come while tiles are matched."""
    folder, settings = small_pair
    copy(folder / "left.tif", folder / "virtual.vrt", driver="VRT")
    (folder / name).symlink_to(folder / "later")
    with pytest.raises(
        ChangedInputError, match=rf"{name} cannot be read: it is missing, or a link to nothing: restore"
    ):
        match_pair(folder / "virtual.vrt", folder / "right.tif", folder / "out", settings)
    (folder / name).unlink()
    match_pair(folder / "virtual.vrt", folder / "right.tif", folder / "out", settings)


def test_other_files__are_those_of_the_sources_of_a_virtual_raster_too(small_pair):
    folder, _ = small_pair
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False), rasterio.open(folder / "mask.tif", "r+") as file:
        file.write_mask(np.full((80, 100), 255, np.uint8))
    assert other_files(str(folder / "mask.vrt")) == [str(folder / "mask.tif"), str(folder / "mask.tif.msk")]


@pytest.mark.parametrize("name", ["outer.vrt", "outer.xml"])
@pytest.mark.parametrize("source", ["vrt://{}?bands=1", "<![CDATA[vrt://{}?bands=1]]>", "GTIFF_DIR:1:{}", "{}.vrt"])
def test_other_files__are_those_of_sources_with_other_names_than_files(small_pair, source, name):
    folder, _ = small_pair
    inner = (folder / "mask.vrt").read_text().replace("mask.tif", str(folder / "left.tif"))
    inner = inner.replace('relativeToVRT="1"', 'relativeToVRT="0"').replace("Byte", "UInt16")
    source = html.escape(inner) if source == "{}.vrt" else source.format(folder / "left.tif")
    outer = re.sub(r"(<SourceFilename[^>]*>)[^<]*", lambda found: found[1] + source, inner)
    (folder / name).write_text(outer)
    np.testing.assert_array_equal(read_layers(folder / name), read_layers(folder / "left.tif"))
    assert str(folder / "left.tif") in other_files(str(folder / name))


def test_other_files__are_those_of_mask_bands(small_pair):
    folder, _ = small_pair
    band = (folder / "mask.vrt").read_text().replace("mask.tif", "left.tif").replace("Byte", "UInt16")
    mask = re.search("<VRTRasterBand.*</VRTRasterBand>", (folder / "mask.vrt").read_text(), re.DOTALL)[0]
    mask = mask.replace(' band="1"', "")
    (folder / "masked.vrt").write_text(band.replace("</VRTDataset>", f"<MaskBand>{mask}</MaskBand></VRTDataset>"))
    assert other_files(str(folder / "masked.vrt")) == [str(folder / "left.tif"), str(folder / "mask.tif")]


def test_other_files__are_those_of_other_spellings(small_pair):
    folder, _ = small_pair
    text = (folder / "mask.vrt").read_text()
    others = {"<VRTDataset": '<VRTDataset xmlns="urn:x"', "Filename": "FILENAME", "relativeToVRT": "RELATIVETOVRT"}
    for other in (text.replace(*spelling) for spelling in others.items()):
        (folder / "other.vrt").write_text(other)
        assert other_files(str(folder / "other.vrt")) == [str(folder / "mask.tif")]


def test_open_image__refuses_a_folder_whose_files_gdal_does_not_list(small_pair):
    folder, _ = small_pair
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
def test_match_pair__ends_where_a_mask_of_a_source_appears(small_pair, monkeypatch, band, name, image):
    folder, settings = small_pair
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
    small_pair, monkeypatch, which
):
    """GDAL finds their sources beside the target."""
    folder, settings = small_pair
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
def test_open_results__refuses_a_run_whose_mask_was_changed_since(small_pair, name):
    folder, settings = small_pair
    left = open_image(folder / "left.tif", mask=folder / "mask.vrt")
    match_pair(left, folder / "right.tif", folder / "out", settings)
    open_results(folder / "out")
    with (folder / name).open("ab") as file:
        file.write(b" ")
    with pytest.raises(SatIntervalsError, match=rf"{name} has changed since it was matched"):
        open_results(folder / "out")


def test_open_results__refuses_a_run_whose_image_got_a_mask_since(small_pair):
    folder, settings = small_pair
    match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    shutil.copy(folder / "mask.tif", folder / "left.tif.msk")
    with rasterio.open(folder / "left.tif.msk", "r+") as dataset:
        dataset.update_tags(INTERNAL_MASK_FLAGS_1="2")
    with pytest.raises(SatIntervalsError, match=r"left\.tif has got or lost a mask since it was matched: restore it"):
        open_results(folder / "out")


def test_appeared_file__opens_a_mosaic_with_new_overviews_once(small_pair, monkeypatch):
    """Not once for each of them: there may be thousands."""
    folder, _ = small_pair
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
def test_match_pair__goes_on_where_a_file_appears_that_changes_nothing(small_pair, monkeypatch, name):
    """Overviews are not read where nothing is resampled, and a mask in the file comes before a no-data value.

    The finished run is that of the same images.
    """
    folder, settings = small_pair
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
def test_match_pair__resumes_when_its_image_was_shown_meanwhile(small_pair, show):
    folder, settings = small_pair

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


def test_match_pair__ends_where_a_memory_map_changes_an_input(small_pair, monkeypatch):
    folder, settings = small_pair
    with (folder / "left.tif").open("ab") as file:
        file.write(b"not of the image")
    image = np.memmap(folder / "left.tif", np.uint8, "r+")

    def change(job, block):
        match_block(job, block)
        image[-1] += 1

    for module in (identities, watching):  # until the page is written
        monkeypatch.setattr(module, "local_stamp", lambda file: "as before")
    monkeypatch.setattr("sat_intervals.run.pair.match_block", change)
    with pytest.raises(RunError, match="was changed during the run without a change of its modification time"):
        match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    assert not list(folder.glob("out/tiles/records/*"))


@pytest.mark.parametrize("name", ["mask.tif", "points.tif"])
def test_watched_rasters__sees_a_changed_source_and_a_new_file(small_pair, name):
    folder, _ = small_pair
    check = watched_rasters([folder / "mask.vrt", folder / "points.tif", None, "http://127.0.0.1:1/image.tif"])
    check()
    with (folder / name).open("ab") as file:
        file.write(b"more")
    with pytest.raises(ChangedInputError, match=rf"{name} was replaced or changed while it was read"):
        check()


def test_prepare__takes_an_image_that_was_shown_since_it_was_opened(small_pair):
    folder, settings = small_pair
    left, right = open_image(folder / "left.tif"), open_image(folder / "right.tif")
    (folder / "left.tif.aux.xml").write_text(STATISTICS)
    prepare(left, right, folder / "out", settings)


def test_watched_rasters__sees_a_file_that_appears_beside_one(small_pair):
    folder, _ = small_pair
    check = watched_rasters([folder / "left.tif"])
    check()
    (folder / "left.tif.aux.xml").write_text(STATISTICS)
    check()
    (folder / "left.tif.aux.xml").write_text(NODATA)
    with pytest.raises(ChangedInputError, match=r"a file beside .*left\.tif appeared while it was read"):
        check()


@pytest.mark.parametrize("when", ["before", "after"])
def test_find_here__ends_where_an_image_is_replaced(small_pair, monkeypatch, when):
    folder, _ = small_pair
    images = open_image(folder / "left.tif"), open_image(folder / "right.tif")

    def search(*arguments):
        shutil.copy(folder / "other.tif", folder / "right.tif")

    if when == "before":
        search()
    monkeypatch.setattr(search_range, "search_range", search)
    with pytest.raises(ChangedInputError, match=r"right\.tif was replaced or changed"):
        search_range.find_here(*images, lambda *progress: None)


def test_match_pair__goes_on_where_an_input_is_touched_and_not_changed(small_pair):
    folder, settings = small_pair

    def progress(stage, done, total):
        if stage == "tiles":
            (folder / "left.tif").chmod(0o600 + done % 2)
            shutil.copy(folder / "right.tif", folder / "copy")
            os.replace(folder / "copy", folder / "right.tif")

    report = match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, progress=progress)
    assert report["inputs"]["right"]["sha256"] == identity(str(folder / "right.tif"))["sha256"]


def test_prepare__refuses_an_image_that_was_replaced_since_it_was_opened(small_scene, small_pair):
    folder, settings = small_pair
    left, right = open_image(folder / "left.tif"), open_image(folder / "right.tif")
    write_layer(folder / "left.tif", small_scene.left, int(small_scene.left[70, 80]), PLACE)  # another no-data value
    with pytest.raises(ChangedInputError, match=r"left\.tif was replaced or changed since .*left\.tif was opened"):
        prepare(left, right, folder / "out", settings)


@pytest.mark.parametrize("ending", [".aux.xml", ".msk"])
def test_prepare__refuses_an_image_that_got_another_file_since_it_was_opened(small_pair, ending):
    folder, settings = small_pair
    left, right = open_image(folder / "left.tif"), open_image(folder / "right.tif")
    if ending == ".msk":
        shutil.copy(folder / "mask.tif", folder / "left.tif.msk")
    else:
        (folder / "left.tif.aux.xml").write_text(NODATA)
    with pytest.raises(ChangedInputError, match=rf"left\.tif\{ending} was replaced or changed since .*left\.tif was o"):
        prepare(left, right, folder / "out", settings)


def test_match_tile__does_not_match_in_vain(small_pair, monkeypatch):
    folder, settings = small_pair
    job = prepare(folder / "left.tif", folder / "right.tif", folder / "out", settings)
    job.begin()
    (folder / "left.tif").unlink()
    monkeypatch.setattr("sat_intervals.run.source.cost_areas", None)
    with pytest.raises(ChangedInputError, match=r"left\.tif was replaced or changed"):
        match_block(job, next(iter(job.store.grid)))


@pytest.mark.parametrize("named", ["settings.yaml", "of settings", "given"])
@pytest.mark.parametrize("command", ["match", pytest.param("surface", marks=pytest.mark.peer("shareloc"))])
def test_commands__end_where_settings_are_replaced_before_images_are_opened(small_pair, monkeypatch, command, named):
    """Else old settings and new images would be mixed, where a whole folder is exchanged."""
    folder, _ = small_pair
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
def test_match__names_settings_that_cannot_be_looked_for(small_pair, dry_run):
    folder, _ = small_pair
    name = f"{'a' * 300}.yaml"
    images = folder / "left.tif", folder / "right.tif"
    refused(["match", *images, folder / "out", "--config", name, *dry_run], name, "File name too long")


@pytest.mark.parametrize("name", ["other.tif", "larger.tif"])
def test_describe_inputs__of_a_mask_that_is_replaced_when_it_is_open(small_pair, name):
    folder, settings = small_pair
    write_layer(folder / "larger.tif", np.zeros((200, 300), np.uint8), 0, PLACE)
    images = open_image(folder / "left.tif", mask=folder / "mask.tif"), open_image(folder / "right.tif")
    describe_inputs(*images, load_config(settings), {})
    os.replace(folder / name, folder / "mask.tif")
    with pytest.raises(ChangedInputError, match=r"mask\.tif was replaced or changed since .*left\.tif was opened"):
        describe_inputs(*images, load_config(settings), {})
