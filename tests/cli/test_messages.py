"""Errors that happen in practice: each is one line with the way out."""

import logging
import os
import subprocess

import numpy as np
import pytest
import rasterio
from helpers import COMMAND

from sat_intervals import SatIntervalsError, load_config, match_arrays, open_image
from sat_intervals.config.batch import read_batch
from sat_intervals.evaluate.surface_accuracy import evaluate_surface
from sat_intervals.products import SURFACE
from sat_intervals.raster import Projection, read_window
from sat_intervals.tiling import Window

LOCAL = 'LOCAL_CS["site grid",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'


def write(path, bands, crs="EPSG:32631", tags=None, **options):
    bands = np.atleast_3d(bands).reshape(-1, *np.shape(bands)[-2:])
    profile = {"driver": "GTiff", "height": bands.shape[1], "width": bands.shape[2], "count": len(bands)}
    profile |= {"dtype": bands.dtype, "crs": crs, "transform": rasterio.Affine(1, 0, 3e5, 0, -1, 48e5)}
    with rasterio.open(path, "w", **profile | options) as file:
        file.write(bands)
        file.update_tags(**tags or {})
        if len(bands) == len(SURFACE):
            file.descriptions = [band.name for band in SURFACE]
    return path


@pytest.mark.process
@pytest.mark.parametrize("arguments", [["config"], ["--help"], ["--version"], ["match", "--help"]])
def test_main__ends_quietly_when_its_reader_goes(arguments):
    read, written = os.pipe()
    os.close(read)
    result = subprocess.run([COMMAND, *arguments], stdout=written, stderr=subprocess.PIPE, check=False, timeout=60)
    os.close(written)
    assert (result.returncode, result.stderr) == (1, b"")


# ---- Settings and lists ------------------------------------------------------------------------------------------
def test_read_batch__names_what_cannot_be_read_and_names_that_are_too_long(tmp_path):
    with pytest.raises(SatIntervalsError, match=r"nope.csv cannot be read: No such file or directory: "):
        read_batch(tmp_path / "nope.csv")
    (tmp_path / "pairs.csv").write_text(f"name,left,right\n{201 * 'a'},l,r\n")
    with pytest.raises(SatIntervalsError, match=r"row 1: name 'a+' cannot be .*: choose another of at most 200 bytes$"):
        read_batch(tmp_path / "pairs.csv")


def test_load_config__refuses_a_preset_that_would_change_nothing_of_a_config():
    config = load_config({"preset": "satellite", "disparity": {"minimum": 0, "maximum": 9}})
    with pytest.raises(SatIntervalsError, match="preset 'paper' has no effect on a Config"):
        load_config(config, {"preset": "paper"})
    assert load_config(config, {"preset": "satellite"}) == config


# ---- Images ------------------------------------------------------------------------------------------------------


def test_open_image__refuses_a_colour_table(tmp_path):
    path = write(tmp_path / "palette.tif", np.ones((9, 9), np.uint8))
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {0: (0, 0, 0, 255), 1: (255, 0, 0, 255)})
    with pytest.raises(
        SatIntervalsError, match=r"palette.tif: band 1 has a colour table.* gdal_translate -expand gray"
    ):
        open_image(path)


def test_open_image__warns_of_further_pages(tmp_path, caplog):
    pixels = np.ones((9, 9), np.uint8)
    path = write(tmp_path / "pages.tif", pixels)
    open_image(path)
    assert not caplog.records
    write(path, pixels + 1, APPEND_SUBDATASET="YES")
    caplog.set_level(logging.WARNING)
    open_image(path)
    (record,) = caplog.records
    assert f"{path} has 2 pages: the first is used; name another as GTIFF_DIR:2:{path}" in record.getMessage()
    assert open_image(f"GTIFF_DIR:2:{path}").height == 9


def test_read_window__refuses_integers_that_no_float_holds(tmp_path):
    pixels = 2**60 + np.arange(81, dtype=np.int64).reshape(9, 9)
    with pytest.raises(SatIntervalsError, match=r"int64 values such as 1152921504606846976, beyond 2\^53"):
        read_window(open_image(write(tmp_path / "large.tif", pixels)), Window(0, 0, 9, 9))
    pixels[1:] = 2**53
    kept, state = read_window(open_image(write(tmp_path / "some.tif", pixels, nodata=None)), Window(1, 0, 8, 9))
    assert (kept == 2**53).all()
    assert not state.any()


@pytest.mark.parametrize("sign", [1, -1])
def test_match_arrays__refuses_integers_that_no_float_holds(sign):
    pixels = sign * (2**60 + np.arange(81, dtype=np.int64).reshape(9, 9))
    with pytest.raises(SatIntervalsError, match="the left array has int64 values that float64 cannot represent"):
        match_arrays(pixels, pixels, {"disparity": {"minimum": 0, "maximum": 1}})


# ---- Maps and heights --------------------------------------------------------------------------------------------
def test_projection__refuses_a_map_whose_metres_are_none():
    with pytest.raises(SatIntervalsError, match=r"a metre of EPSG:3857 is 0.724 m on the ground .* such as EPSG:32631"):
        Projection("EPSG:3857").check(1.4, 43.6)
    for crs in ("EPSG:32631", "EPSG:32632", "EPSG:2154"):
        Projection(crs).check(1.4, 43.6)


def dsm(path, heights):
    bands = np.stack([np.full((9, 9), value, np.float32) for value in (10, 9, 11, 1, 1, 1)])
    return write(path, bands, tags={"HEIGHTS": heights})


def test_evaluate_surface__refuses_a_reference_above_a_geoid(tmp_path):
    reference = write(tmp_path / "reference.tif", np.full((9, 9), 10, np.float32), crs="EPSG:32631+5773")
    surface = dsm(tmp_path / "dsm.tif", "above the WGS 84 ellipsoid")
    with pytest.raises(SatIntervalsError, match=r"reference.tif has heights of EGM96 height, .* with --geoid"):
        evaluate_surface(surface, reference)
    above_geoid = dsm(tmp_path / "geoid.tif", "above egm96.gtx")
    assert evaluate_surface(above_geoid, reference)["all"]["coverage"] == 1


def test_evaluate_surface__refuses_a_reference_of_a_local_crs(tmp_path):
    reference = write(tmp_path / "reference.tif", np.full((9, 9), 10, np.float32), crs=LOCAL)
    with pytest.raises(SatIntervalsError, match=r"the CRS of .*reference.tif, site grid, is a local one: give a"):
        evaluate_surface(dsm(tmp_path / "dsm.tif", "above the WGS 84 ellipsoid"), reference)


@pytest.mark.parametrize(("crs", "unit"), [("EPSG:32631", "ft"), ("EPSG:32631+6360", None)])
def test_evaluate_surface__refuses_a_reference_in_feet(tmp_path, crs, unit):
    reference = write(tmp_path / "reference.tif", np.full((9, 9), 10, np.float32), crs=crs)
    with rasterio.open(reference, "r+") as dataset:
        dataset.units = (unit,) if unit else dataset.units
    with pytest.raises(SatIntervalsError, match=r"reference.tif has heights in (ft|US survey foot): convert them to m"):
        evaluate_surface(dsm(tmp_path / "dsm.tif", "above egm96.gtx"), reference)
