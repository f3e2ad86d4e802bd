import os

import numpy as np
import pytest
from helpers import PLACE
from rasterio.shutil import copy

from sat_intervals.errors import ChangedInputError, SatIntervalsError
from sat_intervals.raster import watched_rasters, write_layer
from sat_intervals.raster.beside import check_place
from sat_intervals.raster.identity import identity
from sat_intervals.raster.watching import read_unchanged

STATISTICS = "<PAMRasterBand band='1'><Metadata><MDI key='STATISTICS_MEAN'>{}</MDI></Metadata></PAMRasterBand>"
POSITION = "<GeoTransform>1, 1, 0, 0, 0, -1</GeoTransform>"


@pytest.fixture
def image(tmp_path):
    (tmp_path / "images").mkdir()
    write_layer(tmp_path / "images" / "left.tif", np.zeros((8, 9), np.uint8), 0, PLACE)
    return tmp_path / "images" / "left.tif"


def come_and_go(folder, *names):
    for name in names:
        (folder / "aside").touch()
        (folder / "aside").rename(folder / name)
        (folder / name).unlink()


def test_check_place__does_not_wait_for_a_pipe_with_the_name_of_statistics(tmp_path):
    os.mkfifo(tmp_path / "dsm.tif.aux.xml")
    with pytest.raises(SatIntervalsError, match=r"dsm\.tif\.aux\.xml changes what is read from .*: move it away"):
        check_place(tmp_path / "dsm.tif")


@pytest.mark.parametrize("through", ["own", "link", "virtual"])
@pytest.mark.parametrize("name", ["left.tif.aux.xml", "left_RPC.TXT", "LEFT.tfw", "left.tif.msk", "left.XML"])
def test_watched_rasters__raises_if_a_file_beside_one_comes_and_goes(image, tmp_path, name, through):
    folder = image.parent
    (tmp_path / "link").symlink_to(folder)
    if through == "link":
        image = tmp_path / "link" / "left.tif"
    elif through == "virtual":
        copy(image, tmp_path / "of.vrt", driver="VRT")
        image = tmp_path / "of.vrt"
    come_and_go(folder, name)
    check = watched_rasters([image])
    come_and_go(folder, "another.tif.aux.xml", "left.tif.ovr.tmp", "left.tif.ovr", ".left.tif.swp")
    check()
    come_and_go(folder, name)
    with pytest.raises(ChangedInputError, match=f"{name} came, and went or was replaced, while files were read"):
        check()


def test_watched_rasters__raises_if_overviews_come_and_go_where_they_are_read(image):
    check, check_small = watched_rasters([image]), watched_rasters([f"vrt://{image}?outsize=4,4"])
    come_and_go(image.parent, "left.tif.ovr")
    check()
    with pytest.raises(ChangedInputError, match=r"left\.tif\.ovr came, and went"):
        check_small()


def test_read_unchanged__reads_again_if_overviews_came_and_went(image):
    coming = iter([True, False])

    def read():
        if is_coming := next(coming):
            come_and_go(image.parent, "left.tif.ovr")
        return is_coming

    assert not read_unchanged({str(image): identity(str(image))}, read)


@pytest.mark.parametrize("way", ["made", "renamed"])
def test_watched_rasters__allows_what_other_programs_write_again_and_again(image, way):
    """QGIS writes statistics, then histograms, and styles."""

    def write(name, text):
        (image.parent / (name if way == "made" else "new")).write_text(text)
        if way == "renamed":
            (image.parent / "new").rename(image.parent / name)

    check = watched_rasters([image])
    for number in range(3):
        write("left.tif.aux.xml", f"<PAMDataset>{STATISTICS.format(number)}</PAMDataset>")
        write("left.qml", f"{number}")
        write("left.txt", f"{number}")
        check()
    write("left.tif.aux.xml", f"<PAMDataset>{STATISTICS.format(0)}{POSITION}</PAMDataset>")
    with pytest.raises(ChangedInputError, match=r"a file beside .*left\.tif appeared while it was read"):
        check()


@pytest.mark.parametrize("name", ["DIM_A_B.XML", "RPC_A_B.XML", "img_a_b_r1c2.rpb"])
def test_watched_rasters__raises_if_a_sensor_model_of_a_product_comes_and_goes(image, name):
    tile = image.rename(image.with_name("IMG_A_B_R1C2.TIF"))
    check = watched_rasters([tile])
    come_and_go(image.parent, "DIM_A_C.XML", "IMG_A_B_R1C1.RPB")
    check()
    come_and_go(image.parent, name)
    with pytest.raises(ChangedInputError, match=f"{name} came, and went"):
        check()
