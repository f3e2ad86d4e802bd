"""The files that a raster is read from, as GDAL lists them, recursively through virtual rasters."""

import gzip
import re
import shutil
import zipfile

import numpy as np
import pytest
import rasterio

from sat_intervals.raster import files_of

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SIZE = 16
SOURCE = '<SourceFilename relativeToVRT="{}">{}</SourceFilename>'


def virtual(is_relative, name):
    """The text of a virtual raster of an image."""
    source = f"<SimpleSource>{SOURCE.format(is_relative, name)}<SourceBand>1</SourceBand></SimpleSource>"
    band = f'<VRTRasterBand dataType="UInt16" band="1">{source}</VRTRasterBand>'
    return f'<VRTDataset rasterXSize="{SIZE}" rasterYSize="{SIZE}">{band}</VRTDataset>'


@pytest.fixture
def folder(tmp_path):
    for name, dtype in (("image.tif", "uint16"), ("mask.tif", "uint8")):
        with rasterio.open(tmp_path / name, "w", "GTiff", SIZE, SIZE, 1, dtype=dtype) as file:
            file.write(np.ones((1, SIZE, SIZE), dtype))
    return tmp_path


def zipped(folder, name, *files):
    with zipfile.ZipFile(folder / f"{name}.zip", "w") as archive:
        for file in files:
            archive.write(folder / file, file)
    return f"/vsizip/{folder}/{name}.zip/{files[0]}"


def compressed(folder, file):
    (folder / f"{file}.gz").write_bytes(gzip.compress((folder / file).read_bytes()))
    return f"/vsigzip/{folder}/{file}.gz"


SOURCES = {
    "relative": lambda folder: (1, "image.tif"),
    "absolute": lambda folder: (0, folder / "image.tif"),
    "entity": lambda folder: (1, "image&#46;tif"),
    "in an archive": lambda folder: (0, zipped(folder, "image", "image.tif")),
    "compressed": lambda folder: (0, compressed(folder, "image.tif")),
}
FILES = {"in an archive": "image.zip", "compressed": "image.tif.gz"}


def local_files(name):
    """The local files behind the names of a raster's other files."""
    return {re.sub(r"^/vsi\w+/(.*\.(zip|gz)|.*).*", r"\1", file) for file in files_of(name)[1:]}


@pytest.mark.parametrize("spelling", SOURCES)
def test_files_of__a_virtual_raster_have_its_source_in_any_spelling(folder, spelling):
    (folder / "image.vrt").write_text(virtual(*SOURCES[spelling](folder)))
    name = str(folder / "image.vrt")
    assert files_of(name)[0] == name
    assert local_files(name) == {str(folder / FILES.get(spelling, "image.tif"))}


def test_files_of__virtual_rasters_of_virtual_rasters_have_all_sources_and_their_masks(folder):
    shutil.copy(folder / "mask.tif", folder / "image.tif.msk")
    (folder / "inner.vrt").write_text(virtual(1, "image.tif"))
    (folder / "outer.vrt").write_text(virtual(0, folder / "inner.vrt"))
    names = ["outer.vrt", "image.tif", "image.tif.msk", "inner.vrt"]
    assert files_of(str(folder / "outer.vrt")) == [str(folder / name) for name in names]


def test_files_of__have_no_overviews_and_statistics(folder):
    for name in ("image.tif.msk", "image.tif.msk.ovr", "image.tif.ovr"):
        shutil.copy(folder / "mask.tif", folder / name)
    (folder / "image.tif.aux.xml").write_text("<PAMDataset/>")
    assert files_of(str(folder / "image.tif")) == [str(folder / name) for name in ("image.tif", "image.tif.msk")]


def test_files_of__lists_the_source_of_a_mask_band(folder):
    mask = f'<VRTRasterBand dataType="Byte"><SimpleSource>{SOURCE.format(1, "mask.tif")}</SimpleSource></VRTRasterBand>'
    text = virtual(1, "image.tif").replace("</VRTDataset>", f"<MaskBand>{mask}</MaskBand></VRTDataset>")
    (folder / "masked.vrt").write_text(text)
    assert str(folder / "mask.tif") in files_of(str(folder / "masked.vrt"))
