"""Reading and writing of rasters, on real files: refusals, pixels, metadata, temporary files."""

import itertools
import os
import pickle
import subprocess
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rasterio.control import GroundControlPoint
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning
from rasterio.rpc import RPC
from rasterio.transform import Affine

from sat_intervals.errors import InputError
from sat_intervals.kernels.resampling import Step, reduced
from sat_intervals.products import BANDS, FLAGS, INVALID, MASKED, NO_DATA
from sat_intervals.raster import RUN_FILES, File, Georeferencing, Image, OutputError, OutputWriter, gdal, points_file
from sat_intervals.raster.images import check_pair, open_image
from sat_intervals.raster.projection import utm_of
from sat_intervals.raster.windows import kept_view, read_reduced, read_window, restored_view
from sat_intervals.tiling import View, Window

UTM = {"crs": "EPSG:32631", "transform": Affine(0.5, 0, 360000.1, 0, -0.5, 4800000.3)}
POINTS = [
    GroundControlPoint(row, column, 1.4 + column * 1e-5 / 3, 43.6 - row * 1e-5 / 3, 152.5)
    for row, column in ((0, 0), (0, 1000), (999.5, 0), (1000, 1000.25))
]
RPCS = RPC(
    height_off=152.1,
    height_scale=500.0,
    lat_off=43.123456789,
    lat_scale=0.1,
    long_off=1.4,
    long_scale=0.1 / 3,
    line_off=2000.25,
    line_scale=2000.0,
    samp_off=1234.5,
    samp_scale=3000.0,
    line_num_coeff=[index / 3 for index in range(20)],
    line_den_coeff=[1.0] + [1e-7 / 3] * 19,
    samp_num_coeff=[0.3] * 20,
    samp_den_coeff=[1.0] + [1e-9] * 19,
    err_bias=0.0,
    err_rand=0.25,
)
KINDS = {
    "none": {},
    "crs and transform": UTM,
    "rotated": {"crs": "EPSG:32631", "transform": Affine(0.5, 0.1, 360000.1, 0.1, -0.5, 4800000.3)},
    "crs": {"crs": "EPSG:32631"},
    "transform": {"transform": UTM["transform"]},
    "gcps": {"gcps": POINTS, "crs": "EPSG:4326"},
    "gcps without crs": {"gcps": POINTS, "crs": CRS()},
    "rpcs": {"rpcs": RPCS},
    "rpcs, crs and transform": {"rpcs": RPCS, **UTM},
}


def make(path: Path, bands, *, internal=None, alpha=None, external=None, **options) -> Path:
    """Write a GeoTIFF: ``bands`` ``(rows, columns)`` or ``(band, rows, columns)``, a mask inside or beside it."""
    bands = np.atleast_3d(bands) if np.ndim(bands) == 3 else np.asarray(bands)[np.newaxis]
    shape = {"count": len(bands), "height": bands.shape[1], "width": bands.shape[2], "dtype": bands.dtype}
    with warnings.catch_warnings(), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=external is None):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="GTiff", **shape, **options) as dataset:
            if alpha is not None:
                colours = ColorInterp.gray, ColorInterp.alpha
                dataset.colorinterp = [colours[band == alpha] for band in dataset.indexes]
            dataset.write(bands)
            for mask in (internal, external):
                if mask is not None:
                    dataset.write_mask(np.asarray(mask, bool))
    return path


def look(path: Path, read=lambda dataset: dataset.read(), **options):
    """Content of a file as another program reads it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, **options) as dataset:
            return read(dataset)


def whole(image: Image) -> Window:
    return Window(0, 0, image.height, image.width)


def message(failure: pytest.ExceptionInfo, *parts: object) -> None:
    """One line that holds the parts."""
    text = str(failure.value)
    assert "\n" not in text
    for part in parts:
        assert str(part) in text


RAMP = np.arange(12, dtype=np.uint16).reshape(3, 4)


# Images


def test_open_image__tells_what_the_file_has(tmp_path):
    path = make(tmp_path / "left.tif", RAMP, nodata=7, **UTM)
    image = open_image(path)
    assert (image.path, image.band, image.height, image.width) == (str(path), 1, 3, 4)
    assert (image.dtype, image.nodata, image.use_mask, image.alpha, image.mask) == ("uint16", 7, False, None, None)
    assert image.georeferencing == Georeferencing(CRS.from_epsg(32631), UTM["transform"])


def test_open_image__finds_a_relative_path_from_anywhere(tmp_path, monkeypatch):
    make(tmp_path / "left.tif", RAMP)
    monkeypatch.chdir(tmp_path)
    assert open_image("left.tif").path == str(tmp_path / "left.tif")


def test_open_image__reads_through_the_virtual_file_systems_of_gdal(tmp_path):
    path = make(tmp_path / "left.tif", RAMP)
    subprocess.run(["gzip", str(path)], check=True)
    image = open_image(f"/vsigzip/{path}.gz")
    assert image.path == f"/vsigzip/{path}.gz"
    np.testing.assert_array_equal(read_window(image, whole(image))[0], RAMP)


@pytest.mark.parametrize("kind", KINDS)
def test_open_image__survives_pickling(tmp_path, kind):
    image = open_image(make(tmp_path / "left.tif", RAMP, **KINDS[kind]), mask=make(tmp_path / "mask.tif", RAMP))
    assert pickle.loads(pickle.dumps(image)) == image


@pytest.mark.parametrize("name", ["missing.tif", "text.tif", "folder", "https://localhost:1/left.tif"])
def test_open_image__refuses_what_is_no_image(tmp_path, name):
    (tmp_path / "text.tif").write_text("no image\n")
    (tmp_path / "folder").mkdir()
    path = name if ":" in name else tmp_path / name
    with pytest.raises(InputError) as failure:
        open_image(path)
    message(failure, path, "cannot be read", "give the path of a raster")


REFUSED = {
    "complex": (np.ones((3, 4), np.complex64), {}, {}, ("complex64", "amplitude")),
    "several bands": (np.stack([RAMP, RAMP, RAMP]), {}, {}, ("bands 1 to 3", "--band")),
    "band below": (RAMP, {}, {"band": 0}, ("no image band 0", "band 1 only")),
    "band above": (RAMP, {}, {"band": 2}, ("no image band 2", "band 1 only")),
    "alpha band": (np.stack([RAMP, RAMP]), {"alpha": 2}, {"band": 3}, ("no image band 3", "band 1 only (band 2 is")),
    "alpha alone": (RAMP, {"alpha": 1}, {}, ("no image band",)),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_open_image__refuses_what_cannot_be_matched(tmp_path, kind):
    pixels, options, choice, parts = REFUSED[kind]
    path = make(tmp_path / "left.tif", pixels, **options)
    with pytest.raises(InputError) as failure:
        open_image(path, **choice)
    message(failure, path, *parts)


def test_open_image__takes_the_band_that_is_chosen(tmp_path):
    image = open_image(make(tmp_path / "rgb.tif", np.stack([RAMP, RAMP + 100])), band=2)
    np.testing.assert_array_equal(read_window(image, whole(image))[0], RAMP + 100)


def test_open_image__refuses_a_mask_of_another_size(tmp_path):
    path, mask = make(tmp_path / "left.tif", RAMP), make(tmp_path / "mask.tif", RAMP.T)
    with pytest.raises(InputError) as failure:
        open_image(path, mask=mask)
    message(failure, path, mask, "4 x 3", "3 x 4")


# Pairs


def pair(folder: Path, left=RAMP, right=RAMP, left_options=UTM, right_options=UTM) -> tuple[Image, Image]:
    images = (("left.tif", left, left_options), ("right.tif", right, right_options))
    return tuple(open_image(make(folder / name, pixels, **options)) for name, pixels, options in images)


def test_check_pair__accepts_other_widths_and_origins(tmp_path):
    moved = {**UTM, "transform": Affine(0.5, 0, 0, 0, -0.5000000001, 0)}
    check_pair(*pair(tmp_path, RAMP, RAMP[:, :3], UTM, moved), 3)


@pytest.mark.parametrize("kind", ["none", "crs", "transform", "rpcs"])
def test_check_pair__compares_what_both_images_have(tmp_path, kind):
    check_pair(*pair(tmp_path, left_options=KINDS[kind]), 3)


WIDE = Affine(0.7, 0, 0, 0, -0.5, 0)


@pytest.mark.parametrize(
    ("right", "options", "count", "part"),
    [
        (RAMP[:2], UTM, 3, "3 and 2 rows"),
        (RAMP, {**UTM, "crs": "EPSG:32632"}, 3, "EPSG:32631 and EPSG:32632"),
        (RAMP, KINDS["gcps"], 3, "EPSG:32631 and EPSG:4326"),
        (RAMP, {"crs": "EPSG:32631", "transform": WIDE}, 3, "0.5 x 0.5 and 0.7 x 0.5"),
        (RAMP, {"transform": WIDE}, 3, "0.5 x 0.5 and 0.7 x 0.5"),
        (RAMP, UTM, 5, "4 columns, fewer than the 5 disparities"),
    ],
)
def test_check_pair__refuses_images_that_do_not_correspond(tmp_path, right, options, count, part):
    with pytest.raises(InputError) as failure:
        check_pair(*pair(tmp_path, RAMP, right, UTM, options), count)
    message(failure, tmp_path / "right.tif", part)


# Windows


@settings(max_examples=60, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(-9, 9), st.integers(-9, 9), st.integers(1, 12), st.integers(1, 12))
def test_read_window__is_the_same_window_of_a_padded_image(tmp_path, row, column, height, width):
    path = tmp_path / "left.tif"
    image = open_image(path if path.exists() else make(path, RAMP + 1))
    pixels, state = read_window(image, Window(row, column, height, width))
    padded = np.pad(RAMP + 1, 30)[row + 30 : row + 30 + height, column + 30 : column + 30 + width]
    np.testing.assert_array_equal(pixels, padded)
    np.testing.assert_array_equal(state, np.where(padded == 0, NO_DATA, 0))


@pytest.mark.parametrize("window", [Window(0, 0, 64, 96), Window(-9, -12, 45, 60), Window(30, -90, 12, 78)])
def test_read_reduced__is_the_reduced_window_whatever_is_read_at_once(tmp_path, monkeypatch, window):
    pixels = np.random.default_rng(0).integers(0, 9, (50, 70), np.uint16)
    image, step = open_image(make(tmp_path / "a.tif", pixels, nodata=0)), Step(3, 2)
    expected = reduced(*read_window(image, window), step)
    for pixels in (1, 500, 10**6):
        monkeypatch.setattr("sat_intervals.raster.windows._STRIP", pixels)
        np.testing.assert_array_equal(read_reduced(image, window, step), expected)


@pytest.mark.parametrize(
    ("dtype", "expected"),
    [
        *((dtype, np.float32) for dtype in ("uint8", "int8", "uint16", "int16", "float32")),
        *((dtype, np.float64) for dtype in ("uint32", "int32", "float64")),
    ],
)
def test_read_window__keeps_every_value_of_the_type(tmp_path, dtype, expected):
    limits = np.finfo(dtype) if "float" in dtype else np.iinfo(dtype)
    values = np.array([[limits.min, 0, limits.max]], dtype)
    image = open_image(make(tmp_path / "left.tif", values))
    pixels, state = read_window(image, whole(image))
    assert (pixels.dtype, state.dtype) == (expected, np.uint8)
    np.testing.assert_array_equal(pixels.astype(dtype), values)
    assert not state.any()


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "float32", "int32", "float64", "uint64"])
def test_restored_view__is_the_view_that_was_kept(tmp_path, dtype):
    limits = np.finfo(dtype) if "float" in dtype else np.iinfo(np.int32 if dtype == "uint64" else dtype)
    values = np.array([[max(limits.min, 0), 1, 2, limits.max]], dtype)
    image = open_image(make(tmp_path / "left.tif", values), nodata=1)
    for window, sizes in (Window(0, 0, 1, 4), (4, 4)), (Window(0, 2, 1, 2), (2, 0)):  # the latter is usable everywhere
        view = View(window, *read_window(image, window))
        pixels, state = kept_view(image, view)
        assert (pixels.dtype, pixels.size, state.size) == (dtype, *sizes)
        found = restored_view(image, window, pixels, state)
        assert found.pixels.dtype == view.pixels.dtype
        np.testing.assert_array_equal(found.pixels, view.pixels)
        np.testing.assert_array_equal(found.state, view.state)


def test_read_window__takes_nan_and_infinity_for_no_data(tmp_path):
    values = np.array([[np.nan, np.inf, -np.inf, 1]], np.float32)
    image = open_image(make(tmp_path / "left.tif", values, nodata=-1))
    pixels, state = read_window(image, whole(image))
    assert state.tolist() == [[NO_DATA, NO_DATA, NO_DATA, 0]]
    assert pixels.tolist() == [[0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("dtype", "nodata", "values", "usable"),
    [
        ("uint8", 255, [255, 254, 0], [0, 1, 1]),
        ("uint8", -9999, [241, 0, 255], [1, 1, 1]),  # -9999 modulo 256 is 241
        ("uint8", 0.5, [0, 1, 2], [1, 1, 1]),
        ("uint8", float("nan"), [0, 1, 2], [1, 1, 1]),
        ("int16", -9999, [-9999, 9999, 0], [0, 1, 1]),
        ("float32", 0.1, [0.1, 0.25, 0], [0, 1, 1]),
        ("float32", -3.402823e38, [-3.4028234663852886e38, -1e38, 2], [0, 1, 1]),  # as people write it
        ("float32", -3.4e38, [-3.4028234663852886e38, -3.3e38, 2], [0, 1, 1]),
        ("float32", 9.96921e36, [9.969209968386869e36, 9.97e36, 0], [0, 1, 1]),
        ("float32", -32767.9, [-32767.9, -32768, -32767.8], [0, 1, 1]),
        ("float32", 0, [0, 1e-30, -1e-30], [0, 1, 1]),
        ("float32", -1.7976931348623157e308, [1, 2, 3], [1, 1, 1]),
        ("float32", float("nan"), [np.nan, 1, 2], [0, 1, 1]),
        ("float64", 0.1, [0.1, np.float32(0.1), 1], [0, 1, 1]),
        ("int32", -(2**31), [-(2**31), 2**31 - 1, 0], [0, 1, 1]),
    ],
)
@pytest.mark.parametrize("declared", ["by the user", "by the file"])
def test_read_window__compares_no_data_as_the_file_holds_it(tmp_path, declared, dtype, nodata, values, usable):
    values = np.array([values], dtype)
    if declared == "by the user":
        image = open_image(make(tmp_path / "left.tif", values), nodata=nodata)
    else:
        source = make(tmp_path / "source.tif", values)
        path = tmp_path / "left.vrt"  # which, unlike rasterio's writer, takes any value
        path.write_text(
            f'<VRTDataset rasterXSize="3" rasterYSize="1"><VRTRasterBand band="1" dataType="{GDAL_TYPES[dtype]}">'
            f"<NoDataValue>{nodata!r}</NoDataValue><SimpleSource><SourceFilename>{source}</SourceFilename>"
            "</SimpleSource></VRTRasterBand></VRTDataset>"
        )
        image = open_image(path)
    pixels, state = read_window(image, whole(image))
    np.testing.assert_array_equal(state == 0, np.array([usable], bool))
    np.testing.assert_array_equal(pixels, np.where(usable, values, 0))


GDAL_TYPES = {"uint8": "Byte", "int16": "Int16", "int32": "Int32", "float32": "Float32", "float64": "Float64"}

# Columns: 0 has the file's no-data value 5, 1 the user's 6, 2 is out of the file's mask, 3 has alpha 0.
PIXELS = np.array([[5, 6, 7, 8, 9]], np.uint8)
IN_MASK = np.array([[1, 1, 0, 1, 1]], bool)
ALPHA = np.array([[255, 255, 1, 0, 1]], np.uint8)


@pytest.mark.parametrize("users", [None, 6])
@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("mask", [None, "internal", "external"])
@pytest.mark.parametrize("nodata", [None, 5])
def test_read_window__counts_all_that_says_no_data(tmp_path, nodata, mask, alpha, users):
    # GDAL's own mask of a band counts one of them only.
    bands, options = (np.stack([PIXELS, ALPHA]), {"alpha": 2}) if alpha else (PIXELS, {})
    options |= {mask: IN_MASK} if mask else {}
    image = open_image(make(tmp_path / "left.tif", bands, nodata=nodata, **options), nodata=users)
    pixels, state = read_window(image, whole(image))
    no_data = [nodata == 5 and users is None, users == 6, mask is not None, alpha, False]
    assert state.tolist() == [[NO_DATA * flag for flag in no_data]]
    np.testing.assert_array_equal(pixels, np.where(no_data, 0, PIXELS))


def test_read_window__tells_the_users_mask_from_no_data(tmp_path):
    image = open_image(
        make(tmp_path / "left.tif", PIXELS, nodata=5),
        mask=make(tmp_path / "mask.tif", np.array([[1, 0, 255, 0, 0]], np.uint8), nodata=255),
    )
    pixels, state = read_window(image, Window(0, -1, 1, 7))
    assert state.tolist() == [[NO_DATA, NO_DATA | MASKED, 0, MASKED, 0, 0, NO_DATA]]
    assert pixels.tolist() == [[0, 0, 6, 0, 8, 9, 0]]


@pytest.mark.parametrize("options", [{}, {"tiled": True, "blockxsize": 64, "blockysize": 64, "compress": "deflate"}])
def test_read_window__names_a_file_cut_short_and_the_place(tmp_path, options):
    noise = np.random.default_rng(0).integers(0, 65535, (300, 200), np.uint16)
    path = make(tmp_path / "left.tif", noise, **options)
    os.truncate(path, path.stat().st_size // 2)
    image = open_image(path)
    pixels, _ = read_window(image, Window(0, 0, 50, 50))
    np.testing.assert_array_equal(pixels, noise[:50, :50])
    with pytest.raises(InputError) as failure:
        read_window(image, Window(240, 100, 100, 50))
    message(failure, path, "rows 240 to 299", "columns 100 to 149", "truncated")


def mosaic(folder: Path, side: int) -> Image:
    """Write a VRT of two images side by side, of which the right one has no file any more."""
    sources = ""
    for number, name in enumerate(("west.tif", "east.tif")):
        make(folder / name, np.full((side, side), 7, np.uint8))
        sources += (
            f'<SimpleSource><SourceFilename relativeToVRT="1">{name}</SourceFilename>'
            f'<SrcRect xOff="0" yOff="0" xSize="{side}" ySize="{side}"/>'
            f'<DstRect xOff="{number * side}" yOff="0" xSize="{side}" ySize="{side}"/></SimpleSource>'
        )
    path = folder / "mosaic.vrt"
    band = f'<VRTRasterBand dataType="Byte" band="1">{sources}</VRTRasterBand>'
    path.write_text(f'<VRTDataset rasterXSize="{2 * side}" rasterYSize="{side}">{band}</VRTDataset>')
    image = open_image(path)
    (folder / "east.tif").unlink()
    return image


def test_read_window__names_a_mosaic_whose_source_is_missing(tmp_path):
    image = mosaic(tmp_path, 800)  # GDAL reads more than a million pixels of several sources in threads of its own
    with pytest.raises(InputError) as failure:
        read_window(image, Window(0, 0, 800, 1600))
    message(failure, "mosaic.vrt")


def test_read_window__of_a_mosaic_fails_in_every_thread(tmp_path, monkeypatch):
    image = mosaic(tmp_path, 16)

    class ClosedLate(gdal.DatasetReader):
        def close(self):
            time.sleep(0.001)
            super().close()

    monkeypatch.setattr(gdal, "DatasetReader", ClosedLate)

    def fails(_: int) -> bool:
        try:
            read_window(image, Window(0, 0, 16, 32))
        except InputError:
            return True
        return False

    with ThreadPoolExecutor(4) as threads:
        assert all(threads.map(fails, range(200)))


def test_read_window__is_quiet_and_right_in_many_threads(tmp_path):
    noise = np.random.default_rng(0).integers(0, 65535, (256, 256), np.uint16)
    image = open_image(make(tmp_path / "left.tif", noise))
    windows = [Window(row, column, 16, 16) for row, column in itertools.product(range(0, 256, 16), repeat=2)]
    with ThreadPoolExecutor(8) as threads:
        for window, (pixels, _) in zip(windows, threads.map(read_window, [image] * 256, windows), strict=True):
            np.testing.assert_array_equal(pixels, noise[window.slices])


def test_open_image__leaves_the_warning_to_others(tmp_path):
    path = make(tmp_path / "left.tif", RAMP)
    open_image(path)
    with pytest.warns(NotGeoreferencedWarning):
        rasterio.open(path).close()


# Georeferencing


def test_shifted__moves_transform_points_and_rpcs(tmp_path):
    window = Window(30, 20, 5, 5)
    where = Georeferencing.of(rasterio.open(make(tmp_path / "a.tif", RAMP, **KINDS["rotated"]))).shifted(window)
    assert where.transform @ (0, 0) == pytest.approx(KINDS["rotated"]["transform"] @ (20, 30), rel=1e-15)
    assert where.transform @ (1, 0) == pytest.approx(KINDS["rotated"]["transform"] @ (21, 30), rel=1e-15)
    where = open_image(make(tmp_path / "b.tif", RAMP, **KINDS["gcps"])).georeferencing.shifted(window)
    assert [(point.row, point.column) for point in where.gcps] == [(p.row - 30, p.col - 20) for p in POINTS]
    assert [(point.x, point.y, point.z) for point in where.gcps] == [(p.x, p.y, p.z) for p in POINTS]
    rpcs = open_image(make(tmp_path / "c.tif", RAMP, **KINDS["rpcs"])).georeferencing.shifted(window).rpcs
    assert (rpcs.line_off, rpcs.samp_off) == (1970.25, 1214.5)
    assert (rpcs.lat_off, rpcs.line_scale, rpcs.line_num_coeff[1]) == (43.123456789, 2000, 0.333333333333333)


# Outputs

HEIGHT, WIDTH = 560, 520  # enough for an overview


@pytest.fixture(scope="module")
def products() -> tuple[np.ndarray, np.ndarray]:
    """Bands ``(4, rows, columns)`` and validity of a run."""
    random = np.random.default_rng(0)
    validity = random.choice(np.array([0, 4, 8, 256, 2048], np.uint16), (HEIGHT, WIDTH))
    intervals = random.normal(0, 9, (4, HEIGHT, WIDTH)).astype(np.float32)
    intervals[:3, validity & INVALID != 0] = np.nan
    return intervals, validity


def produce(folder: Path, products, *, where=None, rows=256, tags=None, publish=True) -> None:
    intervals, validity = products
    with OutputWriter(folder, RUN_FILES, *validity.shape, where or Georeferencing(), tags or {}) as output:
        for row in range(0, len(validity), rows):
            output.write(row, intervals[:, row : row + rows], validity[row : row + rows])
        if publish:
            output.publish()


@pytest.mark.parametrize("rows", [37, 256, HEIGHT])
def test_output_writer__writes_what_it_is_given(tmp_path, products, rows):
    produce(tmp_path / "out", products, rows=rows)
    np.testing.assert_array_equal(look(tmp_path / "out" / "intervals.tif"), products[0])
    np.testing.assert_array_equal(look(tmp_path / "out" / "validity.tif")[0], products[1])
    assert sorted(os.listdir(tmp_path / "out")) == ["intervals.tif", "validity.tif"]


def test_output_writer__writes_large_numbers_of_many_bands(tmp_path):
    file = points_file("points.tif")
    points = np.random.default_rng(0).uniform(-180, 9000, (len(file.bands), 70, 530))
    with OutputWriter(tmp_path, [file], 70, 530, Georeferencing(), {}) as output:
        for row in range(0, 70, 30):
            output.write(row, points[:, row : row + 30])
        output.publish()
    np.testing.assert_array_equal(look(tmp_path / "points.tif"), points)


@pytest.mark.parametrize("kind", KINDS)
def test_output_writer__keeps_the_georeferencing(tmp_path, products, kind):
    where = open_image(make(tmp_path / "left.tif", RAMP, **KINDS[kind])).georeferencing
    assert (where == Georeferencing()) is (kind == "none")
    small = products[0][:, :64, :64], products[1][:64, :64]
    for name, expected in (("whole", where), ("region", where.shifted(Window(7, 13, 64, 64)))):
        produce(tmp_path / name, small, where=expected)
        for file in ("intervals.tif", "validity.tif"):
            assert look(tmp_path / name / file, Georeferencing.of) == expected
        assert sorted(os.listdir(tmp_path / name)) == ["intervals.tif", "validity.tif"]


def test_output_writer__says_what_the_bands_are(tmp_path, products):
    produce(tmp_path, products, tags={"ALPHA": "0.9"})
    path = tmp_path / "intervals.tif"
    assert look(path, lambda dataset: dataset.descriptions) == ("disparity", "lower", "upper", "confidence")
    assert look(path, lambda dataset: dataset.units) == ("px", "px", "px", None)
    assert look(path, lambda dataset: dataset.tags())["ALPHA"] == "0.9"
    assert [look(path, lambda dataset, i=i: dataset.tags(i)["meaning"]) for i in (1, 2, 3, 4)] == [
        band.meaning for band in BANDS
    ]
    assert np.isnan(look(path, lambda dataset: dataset.nodatavals)).all()
    assert set(look(path, lambda dataset: dataset.dtypes)) == {"float32"}


def test_output_writer__says_what_the_flags_are(tmp_path, products):
    produce(tmp_path, products, tags={"ALPHA": "0.9"})
    path = tmp_path / "validity.tif"
    assert look(path, lambda dataset: (dataset.descriptions, dataset.dtypes)) == (("validity",), ("uint16",))
    assert look(path, lambda dataset: dataset.nodata) is None
    assert look(path, lambda dataset: dataset.tags())["ALPHA"] == "0.9"
    tags = look(path, lambda dataset: dataset.tags(1))
    assert f"{INVALID}" in tags["meaning"]
    for flag in FLAGS:
        assert flag.name in tags[f"bit_{flag.bit:02}"]
        assert flag.meaning in tags[f"bit_{flag.bit:02}"]
        assert ("(invalid)" in tags[f"bit_{flag.bit:02}"]) is flag.invalid


def left_behind(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize("built", [False, True])
def test_output_writer__leaves_nothing_when_interrupted(tmp_path, products, built):
    intervals, validity = products

    def interrupted() -> None:
        with OutputWriter(tmp_path, RUN_FILES, HEIGHT, WIDTH, Georeferencing(), {}) as output:
            output.write(0, intervals, validity)
            if built:
                output.build()
            assert left_behind(tmp_path)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert left_behind(tmp_path) == []


def test_output_writer__keeps_what_was_there_until_publish(tmp_path, products):
    (tmp_path / "intervals.tif").write_text("of the run before")
    produce(tmp_path, products, publish=False)
    assert (tmp_path / "intervals.tif").read_text() == "of the run before"
    assert left_behind(tmp_path) == ["intervals.tif"]
    produce(tmp_path, products)
    np.testing.assert_array_equal(look(tmp_path / "intervals.tif"), products[0])


def test_output_writer__names_a_folder_that_cannot_be_made(tmp_path, products):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OutputError) as failure:
        produce(tmp_path / "file" / "out", products)
    message(failure, tmp_path / "file" / "out", "Not a directory")


def test_output_writer__publishes_no_file_with_rows_that_were_not_written(tmp_path, products):
    intervals, validity = products
    with OutputWriter(tmp_path, RUN_FILES, HEIGHT, WIDTH, Georeferencing(), {}) as output:
        output.write(0, intervals[:, :300], validity[:300])
        with pytest.raises(OutputError, match="300 of 560 rows were written"):
            output.publish()
    assert left_behind(tmp_path) == []


def test_output_writer__draws_pictures_with_their_tags_in_them(tmp_path):
    pixels = np.arange(60, dtype=np.uint8).reshape(6, 10)
    file = File("disparity.png", "uint8", None, BANDS[:1], driver="PNG")
    with OutputWriter(tmp_path, [file], 6, 10, Georeferencing(), {"SOFTWARE": "sat-intervals"}) as output:
        output.write(0, pixels[:4])
        output.write(4, pixels[4:])
        output.publish()
    assert left_behind(tmp_path) == ["disparity.png"]
    np.testing.assert_array_equal(look(tmp_path / "disparity.png")[0], pixels)
    assert look(tmp_path / "disparity.png", lambda dataset: dataset.tags())["Software"] == "sat-intervals"


# The bands have 18 bytes a pixel, 5.2 MB, and their files at most 3.5 MB with overviews if they were no noise, which
# hardly shortens: there is no room for the files, for what they are made of beside them, or for another file.
@pytest.mark.parametrize(
    ("size", "others", "reason"),
    [
        (3 << 20, 0, "has 3.1 MB free, files may need 3.5 MB"),
        (6 << 20, 0, "has 6.3 MB free, files may need 7.0 MB"),
        (9 << 20, 1 << 20, "No space left on device"),
    ],
)
def test_output_writer__leaves_nothing_on_a_full_disk(disk, products, size, others, reason):
    place = disk(size)
    intervals, validity = products

    def fill() -> None:
        with OutputWriter(place / "out", RUN_FILES, HEIGHT, WIDTH, Georeferencing(), {}) as output:
            (place / "other").write_bytes(bytes(others))
            for row in range(0, HEIGHT, 100):
                output.write(row, intervals[:, row : row + 100], validity[row : row + 100])
            output.publish()

    with pytest.raises(OutputError) as failure:
        fill()
    message(failure, place / "out", reason, "choose another folder")
    assert set(left_behind(place)) <= {"other", "out"}


# ---- Colours and CRS ---------------------------------------------------------------------------------------------
def test_open_image__says_that_a_fourth_band_is_read_as_alpha_and_takes_it_by_its_number(tmp_path, caplog):
    bands = np.stack([RAMP, RAMP + 1, RAMP + 2, np.where(RAMP.min() < RAMP, RAMP, 0)])
    path = make(tmp_path / "rgbn.tif", bands, alpha=4)
    with pytest.raises(InputError, match=r"has bands 1 to 3 \(band 4 is read as alpha\): give a file of one band"):
        open_image(path)
    assert open_image(path, band=2).alpha == 4
    assert "band 4 is read as alpha, 0 is no data: if it is an image band" in caplog.text
    infrared = open_image(path, band=4)
    pixels, state = read_window(infrared, Window(0, 0, *RAMP.shape))
    assert (infrared.alpha, state.any()) == (None, False)
    np.testing.assert_array_equal(pixels, bands[3])


def test_check_pair__takes_crs_that_differ_only_in_their_heights(tmp_path):
    images = [
        open_image(make(tmp_path / f"{number}.tif", RAMP, crs=crs, transform=Affine(2, 0, 0, 0, -2, 0)))
        for number, crs in enumerate(["EPSG:32633", "EPSG:32633+5773", "EPSG:32634"])
    ]
    check_pair(images[0], images[1], 1)
    with pytest.raises(InputError, match="different CRS"):
        check_pair(images[0], images[2], 1)


@pytest.mark.parametrize(
    ("place", "code"), [((10.0, 86.0), 32661), ((30.0, -82.0), 32761), ((-70.1, -33.0), 32719), ((180.5, 10.0), 32601)]
)
def test_utm_of__has_a_map_for_every_place(place, code):
    assert utm_of(*place) == f"EPSG:{code}"
