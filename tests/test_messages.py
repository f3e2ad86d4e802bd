"""Causes that do happen, each told in one line with the way out."""

import logging
import os
import resource
import subprocess
from functools import partial

import numpy as np
import pytest
import rasterio
from helpers import COMMAND, invoke

from sat_intervals import SatIntervalsError, match_arrays, open_image
from sat_intervals.cli import app
from sat_intervals.evaluate.dsm import evaluate_surface
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


def ended(*arguments, **options):
    return subprocess.run(
        [COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=60, check=False, **options
    )


# ---- Processes ---------------------------------------------------------------------------------------------------
def limited(*, address_space):
    return partial(resource.setrlimit, resource.RLIMIT_AS, (address_space, address_space))


def test_main__names_a_limit_of_the_address_space():
    result = ended("match", "a", "b", "c", "--disparity", 0, 4, preexec_fn=limited(address_space=10**9))
    assert result.stderr == (
        "sat-intervals: the address space is limited to 1.0 GB, at least 1.5 GB are needed: raise ulimit -v\n"
    )
    assert result.returncode == 2


@pytest.mark.parametrize("threads", ["0", "many"])
def test_main__names_a_variable_that_numba_cannot_start_with(threads, monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    result = invoke("match", "a", "b", "c", "--disparity", "0", "4")
    assert result.exit_code == 2
    assert f"NUMBA_NUM_THREADS is {threads!r}: set it to a number above 0, or not at all" in result.stderr


def test_main__names_a_malformed_dask_configuration(tmp_path):
    (tmp_path / "distributed.yaml").write_text("a: [1\n b: }")
    image = write(tmp_path / "image.tif", np.ones((9, 9), np.uint8))
    result = ended(
        "match", image, image, tmp_path / "out", "--disparity", 0, 4, env=os.environ | {"DASK_CONFIG": str(tmp_path)}
    )
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert str(tmp_path / "distributed.yaml") in line
    assert line.endswith("mend it, or point DASK_CONFIG elsewhere")


@pytest.mark.skipif(os.geteuid() != 0, reason="a network of its own needs root")
def test_main__needs_no_network(tmp_path):
    image = write(tmp_path / "image.tif", np.random.default_rng(0).integers(1, 255, (64, 64), np.uint8))
    command = ["unshare", "-n", COMMAND, "match", image, image, tmp_path / "out", "--disparity", "-2", "2", "--quiet"]
    result = subprocess.run(command, capture_output=True, check=False, timeout=300)  # kernels may have to be compiled
    assert (result.returncode, result.stderr) == (0, b"")


@pytest.mark.parametrize(
    "error", [MemoryError("no array"), SystemError("returned NULL"), OSError(12, "Cannot allocate memory")]
)
def test_explained__a_failed_allocation_is_a_lack_of_memory(error):
    status, line = app._explained(error)
    assert status == 1
    assert "not enough memory: choose a smaller --tile-size or fewer --workers" in line


def test_main__ends_quietly_when_its_reader_goes():
    read, written = os.pipe()
    os.close(read)
    result = subprocess.run([COMMAND, "config"], stdout=written, stderr=subprocess.PIPE, check=False, timeout=60)
    os.close(written)
    assert (result.returncode, result.stderr) == (141, b"")


def test_main__ends_quietly_when_the_reader_of_its_progress_goes(tmp_path):
    image = write(tmp_path / "image.tif", np.random.default_rng(0).integers(1, 255, (64, 64), np.uint8))
    read, written = os.pipe()
    os.close(read)
    command = [COMMAND, "match", image, image, tmp_path / "out", "--disparity", "-2", "2"]
    result = subprocess.run(command, stdout=written, stderr=subprocess.PIPE, check=False, timeout=60)
    os.close(written)
    assert (result.returncode, result.stderr) == (141, b"")


@pytest.mark.parametrize("argument", ["config", "--help", "--version"])
def test_main__says_that_stdout_cannot_be_written(argument):
    with open("/dev/full", "wb") as full:
        result = subprocess.run([COMMAND, argument], stdout=full, stderr=subprocess.PIPE, check=False, timeout=60)
    message = b"sat-intervals: stdout cannot be written: No space left on device\n"
    assert (result.returncode, result.stderr) == (1, message)


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
    assert f"{path} has 2 pages: the first is taken; name another as GTIFF_DIR:2:{path}" in record.getMessage()
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
    with pytest.raises(SatIntervalsError, match="the left array has int64 values that float64 does not hold"):
        match_arrays(pixels, pixels, {"disparity": {"minimum": 0, "maximum": 1}})


# ---- Maps and heights --------------------------------------------------------------------------------------------
def test_projection__refuses_a_map_whose_metres_are_none():
    with pytest.raises(
        SatIntervalsError, match=r"a metre of EPSG:3857 is 0.724 m on the ground .* such as its UTM zone EPSG:32631"
    ):
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
    assert evaluate_surface(above_geoid, reference)["all"]["accuracy"] == 1


def test_evaluate_surface__refuses_a_reference_of_a_local_crs(tmp_path):
    reference = write(tmp_path / "reference.tif", np.full((9, 9), 10, np.float32), crs=LOCAL)
    with pytest.raises(SatIntervalsError, match=r"the CRS of .*reference.tif, site grid, is a local one: give a"):
        evaluate_surface(dsm(tmp_path / "dsm.tif", "above the WGS 84 ellipsoid"), reference)
