"""Rasters of heights in their own grid: positions, vertical references, parts, and what they lack."""

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose, assert_array_equal
from rasterio.transform import Affine
from surfaces import write_geoid

from sat_intervals import SatIntervalsError
from sat_intervals.raster import HeightRaster, Vertical
from sat_intervals.tiling import Window

ELLIPSOID = Vertical(ellipsoid=True)
PLACE = Affine(2, 0, 370_000, 0, -2, 4_830_000)


def write(path, heights, crs="EPSG:32631", place=PLACE, nodata=None, **tags):
    heights = np.asarray(heights)
    kind = {"height": heights.shape[0], "width": heights.shape[1], "count": 1, "dtype": heights.dtype}
    with rasterio.open(path, "w", driver="GTiff", nodata=nodata, crs=crs, transform=place, **kind) as dataset:
        dataset.write(heights, 1)
        dataset.update_tags(**tags)
    return path


def test_height_raster__positions_are_those_of_cells(tmp_path):
    raster = HeightRaster(write(tmp_path / "a.tif", np.zeros((5, 7), np.float32)), None, ELLIPSOID)
    # the centre of the cell in row 3, column 5
    longitude, latitude, height = raster.frame.to_ellipsoid(370_011.0, 4_829_993.0, np.array(12.0))
    assert_allclose(raster.positions(longitude, latitude, height), (5, 3, 12), atol=1e-6)
    assert raster.cell == pytest.approx(2)
    assert raster.shape == (5, 7)


def test_height_raster__takes_a_geoid_and_a_foot(tmp_path):
    geoid = Vertical(geoid=write_geoid(tmp_path / "geoid.tif", 47.5))
    path = write(tmp_path / "a.tif", np.zeros((5, 7), np.float32))
    raster = HeightRaster(path, None, geoid)
    assert raster.frame.to_ellipsoid(370_011.0, 4_829_993.0, np.array(100.0))[2] == pytest.approx(147.5, abs=1e-3)
    with pytest.raises(SatIntervalsError, match=r"geoid.tif has no geoid height at longitude 9.00, latitude 43.00"):
        raster.frame.check(9.0, 43.0)
    feet = HeightRaster(path, "EPSG:32631+6360", geoid)  # US survey feet
    assert feet.frame.to_ellipsoid(370_011.0, 4_829_993.0, np.array(100.0))[2] == pytest.approx(77.98, abs=1e-2)


def test_height_raster__reads_any_window_the_same(tmp_path, monkeypatch):
    random = np.random.default_rng(0)
    heights = random.uniform(0, 900, (50, 60)).astype(np.float32)
    heights[3, 4], heights[20, 30], heights[40, 50] = -9999, np.nan, 20_000  # undeclared no data, and a spike
    monkeypatch.setattr("sat_intervals.raster.heightfield._BLOCK", 16)
    raster = HeightRaster(write(tmp_path / "a.tif", heights), None, ELLIPSOID)
    expected = np.where((heights > -600) & (heights < 9500), heights, np.nan)
    for window in (Window(0, 0, 50, 60), Window(3, 4, 1, 1), Window(15, 10, 20, 40), Window(40, 33, 10, 27)):
        assert_array_equal(raster.read(window), expected[window.slices])


def test_height_raster__applies_scale_and_offset(tmp_path):
    path = write(tmp_path / "a.tif", np.array([[15, 10], [20, 0]], np.int16), nodata=0)
    with rasterio.open(path, "r+") as dataset:
        dataset.scales, dataset.offsets = (0.1,), (100.0,)
    read = HeightRaster(path, None, ELLIPSOID).read(Window(0, 0, 2, 2))
    assert_allclose(read, [[101.5, 101], [102, np.nan]])


def test_height_raster__knows_what_a_surface_of_this_tool_refers_to(tmp_path):
    heights = np.zeros((5, 7), np.float32)
    HeightRaster(write(tmp_path / "a.tif", heights, HEIGHTS="above the WGS 84 ellipsoid"), None, Vertical())
    HeightRaster(write(tmp_path / "b.tif", heights, crs="EPSG:4979"), None, Vertical())
    with pytest.raises(SatIntervalsError, match=r"c.tif has heights above egm.gtx: give this grid with --geoid"):
        HeightRaster(write(tmp_path / "c.tif", heights, HEIGHTS="above egm.gtx"), None, Vertical())


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_height_raster__says_what_is_missing(tmp_path):
    heights = np.zeros((5, 7), np.float32)
    local = 'LOCAL_CS["site",UNIT["metre",1]]'
    for path, crs, message in (
        (write(tmp_path / "a.tif", heights), None, "a.tif does not say what its heights refer to: give --ellipsoid"),
        (write(tmp_path / "b.tif", heights, crs=None), None, "b.tif has no CRS: give it with --crs"),
        (write(tmp_path / "c.tif", heights, crs=local), None, "is a local one: give one of the Earth"),
        (write(tmp_path / "d.tif", heights, place=Affine.identity()), None, "d.tif has no transform"),
        (write(tmp_path / "e.tif", heights[:1]), None, "e.tif has 1 x 7 cells: give at least 2 x 2"),
        (tmp_path / "a.tif", "EPSG:32631+5773", "has heights of EGM96 height: give the grid of this geoid with"),
        (tmp_path / "a.tif", "EPSG:1", "EPSG:1 is not a CRS known to PROJ"),
        (tmp_path / "none.tif", None, "none.tif cannot be read"),
    ):
        vertical = Vertical(ellipsoid=path.name != "a.tif")
        with pytest.raises(SatIntervalsError) as error:
            HeightRaster(path, crs, vertical)
        assert message in str(error.value)


@pytest.mark.parametrize(
    ("unit", "is_metre"),
    [
        *(("ft", False), ("US survey foot", False), ("mm", False), ("m/s", False)),
        *(("metre", True), ("m", True), ("m above ellipsoid", True)),
    ],
)
def test_height_raster__refuses_bands_in_feet(tmp_path, unit, is_metre):
    path = write(tmp_path / "a.tif", np.zeros((5, 7), np.float32))
    with rasterio.open(path, "r+") as dataset:
        dataset.units = (unit,)
    if is_metre:
        HeightRaster(path, None, ELLIPSOID)
        return
    with pytest.raises(SatIntervalsError, match=f"a.tif has heights in {unit}: convert them to metres"):
        HeightRaster(path, None, ELLIPSOID)


@pytest.mark.parametrize(
    ("value", "share", "warns"), [(-32.0, 0.04, True), (-32.0, 0.0005, False), (430.0, 0.04, False)]
)
def test_warn_of_no_data__names_a_value_far_from_all_others(tmp_path, caplog, value, share, warns):
    heights = np.random.default_rng(3).normal(440, 15, (90, 110)).astype(np.float32)
    heights[-9:] = -9999.0  # which no ground has, so it is left out anyway
    heights.ravel()[: int(share * heights.size)] = value
    HeightRaster(write(tmp_path / "a.tif", heights), None, ELLIPSOID)
    assert (f"are exactly {value:g}, " in caplog.text) == warns
    assert ("rio edit-info --nodata -32 " in caplog.text) == warns
    caplog.clear()
    HeightRaster(write(tmp_path / "b.tif", heights, nodata=value), None, ELLIPSOID)
    assert not caplog.text
