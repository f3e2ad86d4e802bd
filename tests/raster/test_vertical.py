"""Vertical CRS of surface models, as GDAL, rioxarray and our own commands read it."""

import numpy as np
import pytest
import rasterio
import xarray as xr
from pyproj import CRS
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform_bounds
from rio_cogeo.cogeo import cog_validate
from surfaces import PLACE, write_surface

import sat_intervals
from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import SURFACE
from sat_intervals.raster import HeightRaster, OutputWriter, Vertical, north_up, read_place, surface_file

HEIGHT = np.arange(12.0, dtype=np.float32).reshape(3, 4)
ELLIPSOID = "above the WGS 84 ellipsoid"


def write(folder, level, crs="EPSG:32631", name="dsm.tif"):
    tags = {"COVERAGE": "0.9", "HEIGHTS": level}
    place = north_up(crs, PLACE.c, PLACE.f, 1.0)
    with OutputWriter(folder, [surface_file(name)], *HEIGHT.shape, place, tags) as writer:
        writer.write(0, np.stack([HEIGHT] * len(SURFACE)))
        writer.publish()
    return folder / name


@pytest.mark.parametrize(
    ("level", "crs", "axis", "code", "name"),
    [
        (ELLIPSOID, "EPSG:32631", "Ellipsoidal height", None, None),
        (ELLIPSOID, "EPSG:2154", "Ellipsoidal height", None, None),
        (ELLIPSOID, "EPSG:27700", "Up", None, "heights above the WGS 84 ellipsoid"),  # not of this base
        ("above /grids/us_nga_egm96_15.tif", "EPSG:32631", "Gravity-related height", 5773, "EGM96 height"),
        ("above egm08_25.gtx", "EPSG:2154", "Gravity-related height", 3855, "EGM2008 height"),
        ("above grids/raf20.gtx", "EPSG:2154", "Up", None, "heights above raf20.gtx"),
    ],
)
def test_surface__has_a_crs_with_its_heights(tmp_path, level, crs, axis, code, name):
    path = write(tmp_path, level, crs)
    assert cog_validate(path, strict=True) == (True, [], [])
    with rasterio.open(path) as dataset:
        whole = CRS.from_wkt(dataset.crs.to_wkt())
        assert dataset.units == ("m", "m", "m", "1", "1", "1")  # beside a vertical CRS GDAL takes none for metres
        found = transform_bounds(dataset.crs, "EPSG:4326", *dataset.bounds)
        assert found == transform_bounds(crs, "EPSG:4326", *dataset.bounds)
        with WarpedVRT(dataset, crs=crs) as flat:
            np.testing.assert_array_equal(flat.read(1), HEIGHT)
    assert ([one.name for one in whole.axis_info][2], f"EPSG:{whole.to_2d().to_epsg()}") == (axis, crs)
    if name:
        assert (whole.sub_crs_list[1].name, whole.sub_crs_list[1].to_epsg()) == (name, code)
    flat = read_place(path)[1].crs
    assert flat == rasterio.CRS.from_user_input(crs)  # as that of a file without heights
    assert CRS.from_wkt(sat_intervals.open_surface(path)["spatial_ref"].attrs["crs_wkt"]) == whole


def test_surface__has_the_code_that_the_geotiff_of_a_geoid_names(tmp_path):
    with rasterio.open(
        tmp_path / "raf20.tif", "w", driver="GTiff", height=2, width=2, count=1, dtype="float32", crs="EPSG:4326",
        transform=PLACE,
    ) as dataset:  # fmt: skip
        dataset.update_tags(target_crs_epsg_code="5720")
    with rasterio.open(write(tmp_path, f"above {tmp_path / 'raf20.tif'}", "EPSG:2154")) as dataset:
        assert CRS.from_wkt(dataset.crs.to_wkt()).sub_crs_list[1].to_epsg() == 5720


def test_surface__of_unknown_heights_has_a_horizontal_crs(tmp_path):
    with rasterio.open(write(tmp_path, "unknown")) as dataset:
        assert dataset.crs == "EPSG:32631"


def test_surface__as_a_reference_names_its_geoid(tmp_path):
    path = write(tmp_path, "above egm96_15.gtx")
    with pytest.raises(SatIntervalsError, match="has heights of EGM96 height: give the grid of this geoid"):
        HeightRaster(path, None, Vertical())
    HeightRaster(path, None, Vertical(ellipsoid=True))  # as a person states it
    HeightRaster(write(tmp_path, ELLIPSOID), None, Vertical())


def test_surface__is_compared_with_one_of_an_earlier_version(tmp_path):
    rows = np.add.outer(np.arange(60.0) % 7, np.arange(60.0) % 11)
    tags = {"COVERAGE": "0.9", "HEIGHTS": ELLIPSOID, "RUNS": "one"}
    old = write_surface(tmp_path / "old.tif", rows, rows - 1, rows + 1, tags)
    with OutputWriter(tmp_path, [surface_file("new.tif")], 60, 60, read_place(old)[1], tags) as writer:
        writer.write(0, np.stack([rows, rows - 1, rows + 1, *np.ones((3, 60, 60))]))
        writer.publish()
    report = sat_intervals.change(old, tmp_path / "new.tif", tmp_path / "out", registers=False)
    assert (report["cells"]["compared"], report["areas"]) == (3600, 0)
    for one, other in ((old, tmp_path / "new.tif"), (tmp_path / "new.tif", old)):
        found = sat_intervals.evaluate_surface(one, other, registers=False)
        assert found["all"]["median"] == 0


@pytest.mark.peer("rioxarray")
def test_surface__has_bands_that_one_line_names_in_rioxarray(tmp_path):
    import rioxarray  # noqa: F401

    with xr.open_dataset(write(tmp_path, ELLIPSOID), engine="rasterio", band_as_variable=True) as bands:
        named = bands.rename({name: band.attrs["long_name"] for name, band in bands.items()})
        assert [*named] == [band.name for band in SURFACE]
        assert len(CRS(named.rio.crs).axis_info) == 3
        np.testing.assert_array_equal(named["height"], HEIGHT)
