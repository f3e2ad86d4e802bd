"""Finished runs and surface models as lazy datasets."""

import dask.array
import numpy as np
import pytest
import xarray as xr
from finished import PLACE, random_bands, write_run
from numpy.testing import assert_allclose, assert_array_equal
from surfaces import PLACE as SURFACE_PLACE
from surfaces import write_surface

import sat_intervals
from sat_intervals import SatIntervalsError, decode_flags, evaluate_run
from sat_intervals.interop.dataset import Intervals
from sat_intervals.products import FLAGS, INVALID


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A dataset of a run, opened with small chunks, its folder, bands, validity and truth."""
    bands, validity, truth = random_bands(70, 90)
    out = write_run(tmp_path_factory.mktemp("run"), bands, validity, truth)
    return sat_intervals.open(out, chunks=32), out, bands, validity, truth


def test_open__is_lazy_and_has_the_pixels_of_the_files(made):
    dataset, _, bands, validity, _ = made
    assert all(isinstance(variable.data, dask.array.Array) for variable in dataset.data_vars.values())
    assert dataset["lower"].chunksizes == {"y": (32, 32, 6), "x": (32, 32, 26)}
    for name, band in zip(("disparity", "lower", "upper", "confidence"), bands, strict=True):
        assert_array_equal(dataset[name], band)
    assert_array_equal(dataset["validity"], validity)
    part = dataset["disparity"][5:60:7, ::-3]
    assert_array_equal(part, bands[0][5:60:7, ::-3])
    assert_allclose(dataset["confidence"][3, 4], bands[3, 3, 4])


def test_open__without_chunks_reads_when_indexed(made):
    _, out, bands, _, _ = made
    dataset = sat_intervals.open(out, chunks=None)
    assert dataset.chunks == {}
    assert_array_equal(dataset["upper"][10:2:-2, 7:7], bands[2][10:2:-2, 7:7])
    assert_array_equal(dataset["upper"][10:2:-2, 7], bands[2][10:2:-2, 7])
    assert_array_equal(dataset["upper"].isel(x=[5, 2, 80]), bands[2][:, [5, 2, 80]])


@pytest.mark.peer("rioxarray", "odc.geo")
def test_open__has_a_place_that_rioxarray_and_odc_geo_recognise(made, tmp_path):
    import odc.geo.xr  # noqa: F401
    import rioxarray  # noqa: F401

    dataset = made[0]
    assert dataset.rio.crs == dataset["lower"].rio.crs == PLACE.crs
    assert tuple(dataset["lower"].rio.transform())[:6] == tuple(PLACE.transform)[:6]
    box = dataset["lower"].odc.geobox
    assert (box.shape, box.crs.epsg, tuple(box.transform)[:6]) == ((70, 90), 32631, tuple(PLACE.transform)[:6])
    assert tuple(dataset.isel(y=slice(10, 20))["lower"].rio.transform())[5] == PLACE.transform.f - 5


def test_open_surface__has_the_heights_their_place_and_their_datum(made, tmp_path):
    height = np.arange(12.0).reshape(3, 4)
    tags = {"HEIGHTS": "above egm96.gtx", "COVERAGE": "0.9"}
    file = write_surface(tmp_path / "dsm.tif", height, height - 1, height + np.nan, tags)
    surface = sat_intervals.open_surface(file, chunks=2)
    assert surface["height"].chunksizes == {"y": (2, 1), "x": (2, 2)}
    assert_array_equal(surface["height"], height)
    assert_array_equal(surface["height_lower"], height - 1)
    assert np.isnan(surface["height_upper"]).all()
    assert (surface.vertical_datum, surface.coverage) == ("egm96.gtx", 0.9)
    assert surface["height"].attrs["standard_name"] == "height_above_geopotential_datum"
    assert (float(surface["x"][0]), float(surface["y"][0])) == (SURFACE_PLACE.c + 0.5, SURFACE_PLACE.f - 0.5)
    assert "UTM zone 31N" in surface["spatial_ref"].attrs["crs_wkt"]
    with pytest.raises(SatIntervalsError, match="is not a surface model"):
        sat_intervals.open_surface(made[1] / "intervals.tif")


def test_decode_flags__has_each_flag_and_what_is_valid(made):
    dataset, _, _, validity, _ = made
    flags = decode_flags(dataset["validity"])
    assert [*flags] == ["valid", *(flag.name for flag in FLAGS)]
    assert isinstance(flags["occlusion"].data, dask.array.Array)
    for flag in FLAGS:
        assert_array_equal(flags[flag.name], validity & flag.value != 0)
        assert flags[flag.name].attrs["long_name"] == flag.meaning
    assert_array_equal(flags["valid"], validity & INVALID == 0)
    xr.testing.assert_identical(flags.compute(), dataset.intervals.flags().compute())


def test_accessor__coverage_is_the_accuracy_of_evaluate(made):
    dataset, out, _, _, truth = made
    assert isinstance(dataset.intervals, Intervals)
    expected = evaluate_run(out, out.parent / "truth.tif")["all"]["accuracy"]
    assert 0.2 < expected < 0.98
    labels = {"y": np.arange(70), "x": np.arange(90)}  # other labels than those of the dataset
    for true in (truth, xr.DataArray(truth, dims=("y", "x"), coords=labels)):
        assert_allclose(dataset.intervals.coverage(true), expected, atol=1e-9)
    assert np.isnan(dataset.intervals.coverage(np.full((70, 90), np.nan)))
    with pytest.raises(SatIntervalsError, match=r"truth has the shape \(3, 90\), the intervals \(70, 90\)"):
        dataset.intervals.coverage(truth[:3])


def test_accessor__width_and_profile(made):
    dataset, _, bands, _, _ = made
    for width in (dataset["width"], dataset.intervals.width()):
        assert_array_equal(width, bands[2] - bands[1])
    profile = dataset.intervals.profile(69, (3, 8))
    assert isinstance(profile["upper"].data, np.ndarray)
    assert_array_equal(profile["upper"], bands[2, 69, 3:9])
    assert profile.sizes == {"x": 6}
    for row, columns in ((70, None), (-1, None), (0, (5, 90)), (0, (8, 3))):
        with pytest.raises(SatIntervalsError, match="are outside the dataset: rows are 0 to 69, columns 0 to 89"):
            dataset.intervals.profile(row, columns)


@pytest.mark.peer("shareloc")
def test_open__of_many_images_has_heights_in_metres(swept):
    dataset, surface = sat_intervals.open(swept), sat_intervals.open_surface(swept / "dsm.tif")
    assert {"height", "height_lower", "height_upper", "count", "confidence", "validity", "width"} <= set(dataset)
    assert "disparity" not in dataset
    assert_array_equal(dataset["height"], surface["height"])
    assert dataset["width"].attrs["units"] == surface.intervals.width().attrs["units"] == "m"
    assert dataset.attrs["vertical_datum"] == "the WGS 84 ellipsoid"
    assert dataset.intervals.coverage(dataset["height"]) == 1
    assert dataset.intervals.profile(5)["height"].sizes == {"x": dataset.sizes["x"]}
