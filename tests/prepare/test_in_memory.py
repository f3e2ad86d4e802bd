"""Matching of arrays: accepted and refused inputs, coordinates and metadata of the dataset."""

import numpy as np
import pytest
import reference
import xarray as xr

from sat_intervals import SatIntervalsError, load_config, match_arrays
from sat_intervals.demo import make_scene
from sat_intervals.products import BANDS, FLAGS, NO_DATA

BAND_NAMES = [band.name for band in BANDS]


@pytest.fixture(scope="module")
def scene():
    """A pair of 14 x 40 pixels, some of them without data; small, for the slow twin."""
    whole = make_scene(60, 120, seed=5)
    part = np.s_[20:34, 40:80]
    left, right = (np.ma.masked_equal(image[part].copy(), 0) for image in (whole.left, whole.right))
    left[4, 7] = right[9, 21] = right[9, 22] = np.ma.masked
    return (
        left,
        right,
        load_config({"preset": "paper", "disparity": {"minimum": -6, "maximum": 9}, "cost": {"window": 3}}),
    )


@pytest.fixture(scope="module")
def expected(scene):
    left, right, config = scene
    states = [np.where(np.ma.getmaskarray(image), NO_DATA, 0).astype(np.uint8) for image in (left, right)]
    return reference.match_arrays(*(image.filled(0).astype(float) for image in (left, right)), *states, config)


def with_nan(image, dtype=np.float32, value=np.nan):
    return image.astype(dtype).filled(value)


def check(dataset, expected):
    np.testing.assert_array_equal(dataset["validity"], expected.validity)
    np.testing.assert_array_equal(dataset["disparity"], expected.disparity)
    for name in ("lower", "upper", "confidence"):
        np.testing.assert_allclose(dataset[name], getattr(expected, name), rtol=1e-6, atol=1e-6)


def test_match_arrays__takes_masked_pixels_as_no_data(scene, expected):
    left, right, config = scene
    check(match_arrays(left, right, config), expected)
    assert 0.3 < np.isfinite(expected.disparity).mean() < 1


# Ways to hand over the same numbers.
WAYS = {
    "nan": with_nan,
    "inf": lambda image: with_nan(image, value=np.inf),
    "float64": lambda image: with_nan(image, np.float64),
    "big-endian": lambda image: with_nan(image, ">f4"),
    "columns first": lambda image: np.asfortranarray(with_nan(image)),
    "list": lambda image: with_nan(image).tolist(),
    "mask over nan": lambda image: np.ma.masked_array(with_nan(image), np.ma.getmaskarray(image)),
    "long integers": lambda image: image.astype(np.int64),
    "DataArray": lambda image: xr.DataArray(with_nan(image)),
    "chunked DataArray": lambda image: xr.DataArray(with_nan(image)).chunk(7),
}


@pytest.mark.parametrize("give", WAYS.values(), ids=WAYS)
def test_match_arrays__gives_the_same_for_the_same_numbers(scene, expected, give):
    left, right, config = scene
    check(match_arrays(give(left), give(right), config), expected)
    check(match_arrays(left, give(right), config), expected)


def test_match_arrays__leaves_its_input_alone(scene):
    left, right, config = scene
    images = with_nan(left), with_nan(right)
    for image in images:
        image.flags.writeable = False
    before = [image.copy() for image in images]
    match_arrays(*images, config)
    np.testing.assert_array_equal(images[0], before[0])
    np.testing.assert_array_equal(images[1], before[1])


def test_match_arrays__keeps_dimensions_and_coordinates_of_the_left(scene, expected):
    left, right, config = scene
    rows, columns = left.shape
    coordinates = {
        "y": 4_800_000 - 0.5 * np.arange(rows),
        "x": 300_000 + 0.5 * np.arange(columns),
        "longitude": (("y", "x"), np.zeros(left.shape)),
        "spatial_ref": xr.DataArray(0, attrs={"crs_wkt": "EPSG:32631"}),
    }
    labelled = xr.DataArray(with_nan(left), dims=("y", "x"), coords=coordinates, name="left", attrs={"sensor": "none"})
    found = match_arrays(labelled, xr.DataArray(with_nan(right), dims=("line", "sample")), config)
    check(found, expected)
    assert all(found[name].dims == ("y", "x") for name in found.data_vars)
    found.attrs.clear()
    xr.testing.assert_identical(found.coords.to_dataset(), labelled.coords.to_dataset())


def test_match_arrays__names_the_dimensions_of_plain_arrays(scene):
    left, right, config = scene
    found = match_arrays(left, with_nan(right), config)
    assert dict(found.sizes) == {"y": left.shape[0], "x": left.shape[1]}
    assert not found.coords


def test_match_arrays__says_what_its_variables_are(scene, tmp_path):
    left, right, config = scene
    found = match_arrays(left, right, config)
    assert list(found.data_vars) == [*BAND_NAMES, "validity", "width"]
    assert [found[name].dtype for name in found.data_vars] == [np.float32] * 4 + [np.uint16, np.float32]
    assert [found[name].attrs.get("units") for name in BAND_NAMES] == ["px", "px", "px", None]
    assert all(found[name].attrs["long_name"] for name in found.data_vars)
    flags = found["validity"].attrs
    assert flags["flag_meanings"].split() == [flag.name for flag in FLAGS]
    assert flags["flag_masks"].dtype == np.uint16  # by CF that of the variable
    np.testing.assert_array_equal(flags["flag_masks"], [flag.value for flag in FLAGS])


def test_match_arrays__takes_images_of_different_widths(scene):
    left, right, config = scene
    found = match_arrays(left, right[:, :25], config)
    states = [np.where(np.ma.getmaskarray(image), NO_DATA, 0).astype(np.uint8) for image in (left, right)]
    pixels = [image.filled(0).astype(float) for image in (left, right)]
    check(found, reference.match_arrays(pixels[0], pixels[1][:, :25], states[0], states[1][:, :25], config))


def test_match_arrays__takes_what_load_config_takes(scene, expected):
    left, right, _ = scene
    sections = {"preset": "paper", "disparity": {"minimum": -6, "maximum": 9}, "cost": {"window": 3}}
    check(match_arrays(left, right, sections), expected)
    with pytest.raises(SatIntervalsError, match="disparity is null"):
        match_arrays(left, right, {"disparity": None})


def test_match_arrays__needs_no_section_that_can_be_off(scene):
    left, right, _ = scene
    off = dict.fromkeys(("sgm", "ambiguity", "interval", "refinement", "cross_check", "median", "regularization"), None)
    found = match_arrays(left, right, {"disparity": {"minimum": -6, "maximum": 9}} | off)
    disparity = found["disparity"].values
    np.testing.assert_array_equal(disparity[np.isfinite(disparity)] % 1, 0)
    assert all(np.isnan(found[name]).all() for name in ("lower", "upper", "confidence"))


IMAGE = np.zeros((5, 8), np.float32)


@pytest.mark.parametrize(
    ("left", "right", "message"),
    [
        (IMAGE[:4], IMAGE, "the left array has 4 rows, the right 5, but rows must correspond"),
        (IMAGE[np.newaxis], IMAGE, "the left array has 3 dimensions of float32: give 2"),
        (IMAGE, IMAGE[0], "the right array has 1 dimensions of float32: give 2"),
        (IMAGE + 1j, IMAGE, "the left array has 2 dimensions of complex64: .*real numbers"),
        (IMAGE, IMAGE.astype(str), "the right array has 2 dimensions of <U"),
        (None, IMAGE, "the left array has 0 dimensions of object"),
        (IMAGE[:0], IMAGE[:0], r"nothing to match: shapes \(0, 8\) and \(0, 8\)"),
    ],
)
def test_match_arrays__refuses_what_is_no_pair_of_images(left, right, message):
    with pytest.raises(SatIntervalsError, match=message):
        match_arrays(left, right, {"disparity": {"minimum": -1, "maximum": 1}})


@pytest.mark.parametrize(("minimum", "maximum"), [(8, 12), (-12, -8)])
def test_match_arrays__refuses_a_range_that_meets_no_right_pixel(minimum, maximum):
    with pytest.raises(
        SatIntervalsError, match=rf"disparities {minimum} to {maximum} move every pixel .* \(8 columns\)"
    ):
        match_arrays(IMAGE, IMAGE, {"disparity": {"minimum": minimum, "maximum": maximum}})
    for meets in (7, -7):
        match_arrays(IMAGE, IMAGE, {"disparity": {"minimum": meets, "maximum": meets}})


def test_match_arrays__tells_how_much_memory_a_volume_needs():
    wide = np.broadcast_to(np.float32(1), (10**6, 10**6))  # one number in memory
    with pytest.raises(
        SatIntervalsError, match=r"1000000 x 1000000 pixels x 64 disparities need 128000\.0 GB, this process may use"
    ):
        match_arrays(wide, wide, {"disparity": {"minimum": -63, "maximum": 0}})
