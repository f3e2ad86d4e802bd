"""Raw pairs to epipolar pairs and surfaces: grids, images, models, and what is refused."""

import json
import re
import shutil
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import rasterio
from cameras import sensor_words
from helpers import contents, fail, invoke, refused
from numpy.testing import assert_allclose, assert_array_equal
from rasterio.shutil import copy
from rasterio.transform import Affine

from sat_intervals.demo import make_scene
from sat_intervals.raster import open_image, read_heights, read_layers, read_place
from sat_intervals.tiling import Window

pytestmark = [
    pytest.mark.peer("shareloc"),
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),
]

SETTINGS = "--resolution", 0.5, "--crs", "EPSG:32631"


@pytest.fixture(scope="module")
def scene():
    return make_scene(400, 500, seed=3)


@pytest.fixture(scope="module")
def raw(tmp_path_factory, scene):
    from raw import raw_pair

    return raw_pair(tmp_path_factory.mktemp("raw") / "pair", scene)


@pytest.fixture(scope="module")
def made(tmp_path_factory, raw):
    """A folder of `rectify`."""
    out = tmp_path_factory.mktemp("made") / "out"
    result = invoke("rectify", *raw, out)
    assert result.exit_code == 0, result.output
    return out


def sensor_images(folder):
    from sat_intervals.heights.models import SensorImage

    return [SensorImage.readings(open_image(folder / f"{side}.tif"), None)[0] for side in ("left", "right")]


def read_altitude(folder):
    return json.loads((folder / "rectify.json").read_text())["altitude"]


def errors_of(dsm, scene):
    """Heights of a surface minus those of the scene, at its left pixels, and the share of these with a height."""
    from raw import heights_of

    x, y, height = heights_of(scene)
    with rasterio.open(dsm) as dataset:
        column, row = (np.floor(place).astype(int) for place in ~dataset.transform * (x, y))
        inside = (row >= 0) & (column >= 0) & (row < dataset.height) & (column < dataset.width)
        bands = dataset.read((1, 2, 3))[:, row[inside], column[inside]]
    known = np.isfinite(bands[0])
    return bands[:, known] - height[inside][known], known.sum() / inside.size


def test_grids__equal_those_of_shareloc(shared_data):
    from sat_intervals.heights.epipolar import shareloc_grids

    pair = sensor_images(shared_data / "raw_picanteo_pre")
    grids, shape, base = shareloc_grids(pair, (Window(0, 0, 1000, 1000),) * 2, 706.0)
    assert shape == (1216, 1262)
    assert base == pytest.approx(1 / 1.7128, abs=1e-3)  # metres_per_disparity of its meta.json
    for side, nodes in zip(("left", "right"), grids, strict=True):
        published = read_layers(shared_data / "dsm_picanteo" / f"{side}_grid.tif")
        assert_allclose(np.moveaxis(nodes[..., ::-1], -1, 0), published, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("data", "few"), [("scene", 100), ("shared", 100), ("shared", 8)])
def test_grids__rows_of_points_at_five_heights_are_equal(data, few, raw, request, monkeypatch):
    from sat_intervals.heights.epipolar import MARGIN, STEP, Terrain, epipolar_geometry

    monkeypatch.setattr("sat_intervals.heights.epipolar._FEW", few)  # of 8 nodes along an image the others are splines
    is_scene = data == "scene"
    folder = raw[0].parent if is_scene else request.getfixturevalue("shared_data") / "raw_picanteo_pre"
    left, right = sensor_images(folder)
    geometry = epipolar_geometry(left, right, Terrain(), "coarser")
    rows, columns = np.indices(geometry.left.shape[:2])[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
    nodes = geometry.left[MARGIN:-MARGIN, MARGIN:-MARGIN].reshape(-1, 2)
    for height in (-10, 0, 12, 30, 60) if is_scene else (600, 650, 706, 750, 900):
        ground = left.model.direct_loc_h(nodes[:, 0], nodes[:, 1], float(height))
        there = np.stack(right.model.inverse_loc(*ground.T)[:2], axis=-1)
        # Newton steps through the grid of the right image, from the row and column of the left one
        place = np.stack([rows.ravel(), columns.ravel()], axis=-1).astype(float)
        for _ in range(8):
            i, j = np.clip(np.floor(place).astype(int), 0, np.array(geometry.right.shape[:2]) - 2).T
            corner, below, beside = geometry.right[i, j], geometry.right[i + 1, j], geometry.right[i, j + 1]
            slopes = np.stack([below - corner, beside - corner], axis=-1)
            place = np.stack([i, j], axis=-1) + np.linalg.solve(slopes, (there - corner)[..., None])[..., 0]
        inside = (place >= 0).all(axis=1) & (place < np.array(geometry.right.shape[:2]) - 1).all(axis=1)
        assert inside.mean() > 0.5
        assert np.abs((place[:, 0] - rows.ravel()) * STEP)[inside].max() < 0.01


def test_rectify__makes_the_overlap_and_a_record(made, raw):
    record = json.loads((made / "rectify.json").read_text())
    assert record["altitude"] == pytest.approx(20.5, abs=4)  # the middle of heights of 3.5 to 37.4 m
    assert record["base_to_height"] == pytest.approx(0.5, abs=0.005)  # VIEWS differ by 1 px of .5 m a metre
    assert record["metres_per_disparity"] == pytest.approx(-1, abs=0.01)
    assert record["pixel_size"] == pytest.approx(0.5, abs=0.005)
    assert record["rows"]["survey"]["rows"]["before"][0] < 0.1
    assert [record["inputs"][f"{side}_model"]["path"] for side in ("left", "right")] == [str(file) for file in raw]
    for side in ("left", "right"):
        with rasterio.open(made / f"{side}.tif") as dataset:
            assert dataset.dtypes == ("uint16",)
            assert dataset.nodata == 0
            assert max(dataset.shape) < 760
            assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert (dataset.read(1) > 0).mean() > 0.3  # the raw images have empty corners
    (left_longitude, left_latitude), *_ = record["footprint"]
    assert (left_longitude, left_latitude) == pytest.approx((1.45, 43.6), abs=0.005)


def test_rectify__is_done_once_and_refuses_other_settings(made, raw, tmp_path):
    before = contents(made)
    assert invoke("rectify", *raw, made).exit_code == 0
    assert contents(made) == before
    refused(["rectify", *raw, made, "--altitude", 20], "settings.altitude was null, now 20.0", "--overwrite")
    epipolar = made / "left.tif", made / "right.tif"
    refused(["rectify", *epipolar, made / "again", "--left-model", raw[0]], "are an epipolar pair already")
    models = "--left-model", raw[0], "--right-model", raw[1]
    wrong = {"a model without a grid": models, "resolution_of": ("--resolution-of", "left")}
    wrong["altitude"] = "--altitude", 20
    for name, words in wrong.items():
        refused(["surface", *epipolar, made / "again", *words, *SETTINGS], f"{name} is for raw images")
    mask = shutil.copy(raw[0], tmp_path / "left_grid.tif")
    refused(["rectify", *raw, tmp_path, "--left-mask", mask, "--overwrite"], "left_grid.tif is an input")


def test_rectify__keeps_a_finished_pair_until_the_new_one_is_made_and_compares_rows_later(
    made, raw, tmp_path, monkeypatch
):
    from sat_intervals.heights import rectify

    left, right = (Path(shutil.copy(file, tmp_path)) for file in raw)
    model = Path(shutil.copy(left, tmp_path / "model.tif"))
    out = tmp_path / "out"
    words = "rectify", left, right, out, "--left-model", model
    write_images = rectify._write_images

    def changing(*arguments):
        write_images(*arguments)
        with model.open("ab") as stream:
            stream.write(b" ")

    with monkeypatch.context() as patched:
        patched.setattr(rectify, "_write_images", changing)
        result = invoke(*words)
        assert result.exit_code == 1
        assert "left_model" in result.stderr
        assert not [*out.glob("*.tif"), *out.glob("*.json")]
    assert "rows correspond within 0.1 px" in invoke(*words).output
    before = contents(out)
    record = json.loads((out / "rectify.json").read_text())
    (out / "rectify.json").write_text(json.dumps(record | {"rows": None}))  # as `surface` leaves it
    assert "resampling" not in invoke(*words).output
    assert json.loads((out / "rectify.json").read_text()) == record
    with monkeypatch.context() as patched:
        patched.setattr(rectify, "_write_images", fail)
        assert invoke(*words, "--altitude", 20, "--overwrite").exit_code == 1
    assert contents(out) == before


def test_rectify__resumes_what_a_death_left_and_keeps_files_of_others(made, raw, tmp_path):
    out = shutil.copytree(made, tmp_path / "died")
    record = json.loads((out / "rectify.json").read_text())
    (out / "rectify.json").write_text(json.dumps(record | {"finished": None}))
    refused(["surface", out / "left.tif", out / "right.tif", tmp_path / "run", *SETTINGS], "unfinished pair")
    (out / "right.tif").unlink()
    assert invoke("rectify", *raw, out).exit_code == 0
    for name in ("left.tif", "right.tif", "left_grid.tif", "right_grid.tif"):
        assert (out / name).read_bytes() == (made / name).read_bytes()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "left_grid.tif").write_text("mine")
    refused(["rectify", *raw, tmp_path / "other"], "left_grid.tif exists")
    assert (tmp_path / "other" / "left_grid.tif").read_text() == "mine"


@pytest.mark.parametrize("kinds", [("RPB", "RPCTXT"), ("geom", "RPB")])
def test_models__of_all_files_give_the_same_images(kinds, made, raw, tmp_path):
    from sat_intervals.heights.models import read_model

    pair, models = [], []
    for file, kind in zip(raw, kinds, strict=True):
        pair.append(tmp_path / file.name)
        if kind == "geom":
            _without_tags(file, pair[-1])
            _write_geom(file, pair[-1].with_suffix(".geom"))
        else:
            copy(str(file), str(pair[-1]), driver="GTiff", PROFILE="BASELINE", **{kind: "YES"})
            with rasterio.open(pair[-1], "r+") as dataset:
                dataset.nodata = 0
        end = {"RPB": ".RPB", "RPCTXT": "_RPC.TXT", "geom": ".geom"}[kind]
        models.append(tmp_path / f"{file.stem}{end}")
    result = invoke("rectify", *pair, tmp_path / "found")
    for side, file in zip(("left", "right"), models, strict=True):
        assert f"model of the {side} image: {file}\n" in result.output
    assert_array_equal(read_layers(tmp_path / "found" / "left.tif"), read_layers(made / "left.tif"))
    # the same function reads those of `surface`, `dsm` and `triangulate`
    place = np.array([1.451]), np.array([43.599]), np.array([30.0])
    for model, file in zip(models, raw, strict=True):
        assert_allclose(read_model(model).inverse_loc(*place), read_model(file).inverse_loc(*place), rtol=0, atol=1e-9)


def _write_text(path, file, *, separator=": ", unit="", names=True):
    """Write the model in an image as text: a name before each value, or the values alone."""
    with rasterio.open(file) as dataset:
        known = dataset.rpcs.to_dict()
    axes = "LINE", "SAMP", "LAT", "LONG", "HEIGHT"
    single = [f"{axis}_{what}" for what in ("OFF", "SCALE") for axis in axes]
    values = {name: known[name.lower()] for name in single}
    for axis in ("LINE", "SAMP"):
        for part in ("NUM", "DEN"):
            numbers = known[f"{axis}_{part}_coeff".lower()]
            values |= {f"{axis}_{part}_COEFF_{i}": number for i, number in enumerate(numbers, 1)}
    lines = [
        f"{name}{separator}{value:+.15e}{unit if name in single else ''}" if names else repr(value)
        for name, value in values.items()
    ]
    path.write_text((separator if not names else "\r\n").join(lines) + "\r\n")
    return path


@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("left_RPC_ORG.TXT", {"unit": " pixels"}),
        ("a.rpc", {"separator": "  =  "}),
        ("b.dat", {"separator": " : "}),
        ("values.txt", {"names": False, "separator": ", "}),
        ("92.txt", {"names": False, "separator": "\n"}),
    ],
)
def test_read_model__reads_texts_by_what_they_hold(name, form, raw, tmp_path):
    from sat_intervals.heights.models import read_model

    place = np.array([1.4497]), np.array([43.5983]), np.array([17.0])
    file = _write_text(tmp_path / name, raw[1], **form)
    if name == "92.txt":
        file.write_text(f"0.8 0.3 {file.read_text()}")
    expected = read_model(raw[1]).inverse_loc(*place)
    assert_allclose(read_model(file).inverse_loc(*place), expected, rtol=0, atol=1e-9)


def test_models__of_a_dimap_tile_and_of_nitf_are_those_of_the_image(raw, tmp_path):
    from sat_intervals.heights.models import read_model
    from sat_intervals.raster import find_model

    place = np.array([1.451]), np.array([43.599]), np.array([30.0])
    row, column, _ = read_model(raw[0]).inverse_loc(*place)
    tile = tmp_path / "IMG_A_R1C2.TIF"  # its first column is the 301st
    _without_tags(raw[0], tile)
    _write_dimap(raw[0], tile, 300)
    assert_allclose(read_model(find_model(str(tile))).inverse_loc(*place)[:2], (row, column - 300), rtol=0, atol=1e-6)
    whole = read_model(tmp_path / "RPC_A.XML").inverse_loc(*place)[:2]
    assert_allclose(whole, (row, column), rtol=0, atol=1e-6)
    copy(str(raw[0]), str(tmp_path / "left.ntf"), driver="NITF")
    there = read_model(find_model(str(tmp_path / "left.ntf"))).inverse_loc(*place)[:2]
    assert_allclose(there, (row, column), rtol=0, atol=0.6)  # NITF has whole lines and samples


def _write_dimap(file, tile, columns):
    """Write the metadata and the model of a product whose second tile is an image; counted from 1."""
    with rasterio.open(file) as dataset:
        known = dataset.rpcs.to_dict()
    numbers = "".join(
        f"<{axis}_{what}_COEFF_{i}>{value!r}</{axis}_{what}_COEFF_{i}>"
        for axis in ("SAMP", "LINE")
        for what in ("NUM", "DEN")
        for i, value in enumerate(known[f"{axis}_{what}_coeff".lower()], 1)
    )
    names = [f"{axis}_{what}" for axis in ("line", "samp", "lat", "long", "height") for what in ("off", "scale")]
    domain = "".join(
        f"<{name.upper()}>{known[name] + (name in ('line_off', 'samp_off'))!r}</{name.upper()}>" for name in names
    )
    tile.with_name("RPC_A.XML").write_text(
        '<Dimap_Document><Metadata_Identification><METADATA_FORMAT version="2.0">DIMAP</METADATA_FORMAT>'
        f"</Metadata_Identification><Rational_Function_Model><Global_RFM><Direct_Model>{numbers}</Direct_Model>"
        f"<Inverse_Model>{numbers}</Inverse_Model><RFM_Validity>{domain}</RFM_Validity>"
        "</Global_RFM></Rational_Function_Model></Dimap_Document>"
    )
    tile.with_name("DIM_A.XML").write_text(
        "<Dimap_Document><Raster_Data><Data_Access><Data_Files>"
        '<Data_File tile_R="1" tile_C="1"><DATA_FILE_PATH href="IMG_A_R1C1.TIF"/></Data_File>'
        f'<Data_File tile_R="1" tile_C="2"><DATA_FILE_PATH href="{tile.name}"/></Data_File>'
        "</Data_Files></Data_Access><Raster_Dimensions><Tile_Set><Regular_Tiling>"
        f'<NTILES_SIZE nrows="2000" ncols="{columns}"/></Regular_Tiling></Tile_Set></Raster_Dimensions></Raster_Data>'
        "</Dimap_Document>"
    )


def _without_tags(file, path):
    with rasterio.open(file) as dataset:
        pixels, profile = dataset.read(), dataset.profile
    with rasterio.open(path, "w", **profile) as dataset:
        dataset.write(pixels)


def _write_geom(file, path):
    with rasterio.open(file) as dataset:
        known = dataset.rpcs.to_dict()
    names = [f"{axis}_{what}" for axis in ("line", "samp", "lat", "long", "height") for what in ("off", "scale")]
    lines = ["type:  ossimRpcModel", *(f"{name}:  {known[name]!r}" for name in names)]
    for name in ("line_num_coeff", "line_den_coeff", "samp_num_coeff", "samp_den_coeff"):
        lines += [f"{name}_{i:02}:  {value!r}" for i, value in enumerate(known[name])]
    path.write_text("\n".join(lines) + "\n")


def test_rectify__a_crop_has_grey_levels_where_its_geotransform_and_the_grids_say(raw, tmp_path):
    row, column = np.indices((300, 420))
    kind = {"driver": "GTiff", "height": 300, "width": 420, "count": 1, "dtype": "uint16", "nodata": 0}
    for side, pixels in (("left", 100 + 10 * column), ("right", 100 + 10 * row)):
        with rasterio.open(tmp_path / f"{side}.tif", "w", transform=Affine.translation(80, 100), **kind) as dataset:
            dataset.write(pixels.astype(np.uint16), 1)
    crops, models = (tmp_path / "left.tif", tmp_path / "right.tif"), ("--left-model", raw[0], "--right-model", raw[1])
    assert invoke("rectify", *crops, tmp_path / "out", *models).exit_code == 0
    for side, band, origin in (("left", 0, 80), ("right", 1, 100)):
        pixels = read_layers(tmp_path / "out" / f"{side}.tif")[0][::30, ::30].astype(float)
        nodes = read_layers(tmp_path / "out" / f"{side}_grid.tif")[band, 2:, 2:][: pixels.shape[0], : pixels.shape[1]]
        known = pixels > 0
        assert known.sum() > 50
        assert_allclose(pixels[known], (10 * (nodes - origin - 0.5) + 100)[known], rtol=0, atol=0.501)


def _rewritten(file, path, part=None, moved=True, rpcs=(), **profile):
    """Write a part of a raw image, row, column, height and width, with tags that are moved with it and changed."""
    with rasterio.open(file) as dataset:
        known = dataset.rpcs.to_dict() | dict(rpcs)
        row, column, height, width = part or (0, 0, *dataset.shape)
        pixels = dataset.read()[:, row : row + height, column : column + width]
        kind = {"driver": "GTiff", "height": height, "width": width, "count": 1, "dtype": pixels.dtype, "nodata": 0}
    if moved:
        known |= {"line_off": known["line_off"] - row, "samp_off": known["samp_off"] - column}
    path.parent.mkdir(exist_ok=True)
    with rasterio.open(path, "w", rpcs=rasterio.rpc.RPC(**known), **kind | profile) as dataset:
        dataset.write(pixels)
    return path


def _of_other_heights(file, middle, half):
    """Return the tags of an image with another domain of heights, in which the same model is linear, too."""
    with rasterio.open(file) as dataset:
        known = dataset.rpcs.to_dict()
    changes = {"height_off": middle, "height_scale": half}
    for name in ("line_num_coeff", "samp_num_coeff"):
        numbers = list(known[name])
        slope = numbers[3] / known["height_scale"]
        numbers[0] += slope * (middle - known["height_off"])
        changes[name] = [*numbers[:3], slope * half, *numbers[4:]]
    return changes


@pytest.mark.parametrize(("side", "part"), [(0, (180, 200, 210, 260)), (1, (150, 300, 260, 210))])
def test_surface__of_a_crop_and_an_image_that_contains_it_is_at_the_height_of_the_ground(
    side, part, raw, scene, tmp_path
):
    pair = [
        _rewritten(file, tmp_path / file.name, part if i == side else None, rpcs=_of_other_heights(file, 420, 500))
        for i, file in enumerate(raw)
    ]
    result = invoke("surface", *pair, tmp_path / "out", *SETTINGS)
    assert result.exit_code == 0, result.output
    assert read_altitude(tmp_path / "out") == pytest.approx(20.5, abs=6)
    (error, *_), _ = errors_of(tmp_path / "out" / "dsm.tif", scene)
    assert abs(np.median(error)) < 0.15
    assert error.size > 0.75 * part[2] * part[3]
    again = invoke("surface", *pair, tmp_path / "out", *SETTINGS)
    assert again.exit_code == 0
    assert "resampling" not in again.output


@pytest.mark.parametrize("moved", [(True, True), (False, False), (True, False)])
def test_read_with_ground__tags_of_a_crop_are_read_so_that_the_rows_fit(moved, raw, tmp_path, caplog):
    from sat_intervals.heights.ground import read_with_ground
    from sat_intervals.heights.models import SensorImage

    parts = (120, 90, 380, 400), (110, 130, 400, 420)
    readings = []
    for file, part, is_moved in zip(raw, parts, moved, strict=True):
        place = {"moved": is_moved, "transform": Affine.translation(part[1], part[0])}
        crop = _rewritten(file, tmp_path / file.name, part, **place)
        readings.append(SensorImage.readings(open_image(crop), None))
    left, right, ground = read_with_ground(*readings, is_needed=True)
    assert ground[0] == pytest.approx(20.5, abs=4)
    assert [left.origin, right.origin] == [
        (0, 0) if is_moved else part[:2] for part, is_moved in zip(parts, moved, strict=True)
    ]
    assert not caplog.text


def test_read_with_ground__says_how_tags_are_read_where_the_rows_do_not_tell(raw, tmp_path, caplog):
    from sat_intervals.heights.ground import read_with_ground
    from sat_intervals.heights.models import SensorImage

    near = _rewritten(raw[0], tmp_path / "near.tif", (0, 2, 400, 500), transform=Affine.translation(2, 0))
    left, right = (SensorImage.readings(open_image(file), None) for file in (near, raw[1]))
    assert read_with_ground(left, right, is_needed=False)[0].origin == (0, 0)
    assert "near.tif: its RPC tags are taken for an image where it begins at row 0, column 0; row" in caplog.text


def _as_written(kind, file, folder):
    """Write a raw image, or a link or an archive with it, in another way that says the same."""
    path = folder / kind / file.name
    with rasterio.open(file) as dataset:
        known, height = dataset.rpcs.to_dict(), dataset.height
    if kind == "scale":  # as s2p writes models of crops
        changes = {f"{axis}_scale": known[f"{axis}_scale"] / 40 for axis in ("line", "samp")}
        changes |= {name: [40 * value for value in known[name]] for name in ("line_num_coeff", "samp_num_coeff")}
        return _rewritten(file, path, rpcs=changes)
    if kind == "east":
        return _rewritten(file, path, rpcs={"long_off": known["long_off"] - 360})
    if kind == "world file":
        return _rewritten(file, path, transform=Affine(1, 0, 0, 0, -1, height))
    if kind == "degrees":  # a place that is 90 m off
        place = Affine(6.2e-6, 0, 1.4511, 0, -4.5e-6, 43.6008)
        return _rewritten(file, path, crs="EPSG:4326", transform=place)
    beside = path.with_name("target")
    beside.mkdir(parents=True, exist_ok=True)
    _without_tags(file, beside / file.name)
    _write_geom(file, (beside / file.name).with_suffix(".geom"))
    if kind == "link":
        path.symlink_to(beside / file.name)
        return path
    with ZipFile(folder / "pair.zip", "a") as archive:
        for one in (file.name, f"{file.stem}.geom"):
            archive.write(beside / one, f"in/{one}")
    return f"/vsizip/{folder / 'pair.zip'}/in/{file.name}"


@pytest.mark.parametrize("kind", ["scale", "east", "world file", "degrees", "link", "zip"])
def test_rectify__places_and_models_written_otherwise_give_the_same_images(kind, made, raw, tmp_path):
    pair, out = [_as_written(kind, file, tmp_path) for file in raw], tmp_path / "out"
    result = invoke("rectify", *pair, out, "--altitude", read_altitude(made))
    assert result.exit_code == 0, result.output
    assert ("rough place on the map (EPSG:4326) is ignored" in result.stderr) == (kind == "degrees")
    assert_array_equal(read_layers(out / "left.tif"), read_layers(made / "left.tif"))
    match = invoke("match", out / "left.tif", out / "right.tif", tmp_path / "run", "--window", 200, 200, 64, 64)
    assert match.exit_code == 0, match.output
    assert invoke("dsm", tmp_path / "run", *SETTINGS).exit_code == 0


def test_readings__refuse_a_crop_beyond_the_ground_of_its_model(raw, tmp_path):
    place = Affine.translation(5000, 0)
    crop = _rewritten(raw[0], tmp_path / "crop.tif", (0, 0, 300, 300), transform=place)
    refused(["rectify", crop, raw[1], tmp_path / "out", "--left-model", raw[0]], "crop.tif has columns 5000 to 5300")


def test_rectify__takes_the_coarser_pixels(raw, tmp_path):
    coarse = tmp_path / "right.tif"
    with rasterio.open(raw[1]) as dataset:
        pixels, rpcs = dataset.read(1).astype(float), dataset.rpcs.to_dict()
    height, width = (size // 2 for size in pixels.shape)
    pixels = pixels[: 2 * height, : 2 * width].reshape(height, 2, width, 2).mean(axis=(1, 3))
    for axis in ("line", "samp"):  # the centre of the first pixel moves from .5 to .25 of a pixel
        rpcs |= {f"{axis}_off": (rpcs[f"{axis}_off"] + 0.5) / 2 - 0.5, f"{axis}_scale": rpcs[f"{axis}_scale"] / 2}
    kind = {"height": height, "width": width, "count": 1, "dtype": "uint16", "nodata": 0}
    with rasterio.open(coarse, "w", driver="GTiff", rpcs=rasterio.rpc.RPC(**rpcs), **kind) as dataset:
        dataset.write(pixels.round().astype(np.uint16), 1)
    assert invoke("rectify", raw[0], coarse, tmp_path / "coarser").exit_code == 0
    record = json.loads((tmp_path / "coarser" / "rectify.json").read_text())
    assert record["pixel_size"] == pytest.approx(1, abs=0.01)
    assert record["rows"]["survey"]["rows"]["before"][0] < 0.1
    assert invoke("rectify", raw[0], coarse, tmp_path / "left", "--resolution-of", "left").exit_code == 0
    assert json.loads((tmp_path / "left" / "rectify.json").read_text())["pixel_size"] == pytest.approx(0.5, abs=0.005)


@pytest.mark.parametrize(("altitude", "doubts"), [(0.0, True), (706.0, False)])
def test_epipolar_geometry__doubts_an_altitude_that_loses_overlap(shared_data, caplog, altitude, doubts):
    from sat_intervals.heights.epipolar import Terrain, epipolar_geometry

    images = sensor_images(shared_data / "raw_picanteo_pre")
    epipolar_geometry(*images, Terrain(altitude=altitude), "coarser")
    assert bool(re.search(r"at 0 m the images overlap by 4\d %, at 7\d\d m by 9\d %: check", caplog.text)) == doubts


def test_rectify__a_flat_dem_is_an_altitude(raw, tmp_path):
    from surfaces import write_raster

    from sat_intervals.heights.epipolar import Terrain, epipolar_geometry

    def dem(name, west=1.42):
        heights = np.full((1, 60, 60), 20.0)
        return write_raster(tmp_path / name, heights, Affine(0.001, 0, west, 0, -0.001, 43.63), "EPSG:4326")

    flat, plane = (
        epipolar_geometry(*sensor_images(raw[0].parent), terrain, "coarser")
        for terrain in (Terrain(dem("flat.tif")), Terrain(altitude=20.0))
    )
    assert_allclose(flat.right, plane.right, rtol=0, atol=1e-6)
    refused(["rectify", *raw, tmp_path / "cut", "--dem", dem("cut.tif", 1.451)], "cut.tif does not cover the images")


def test_rectify__a_projected_dem_is_as_one_in_degrees(raw, tmp_path):
    from rasterio.warp import Resampling, calculate_default_transform, reproject
    from surfaces import write_raster

    from sat_intervals.heights.epipolar import Terrain, epipolar_geometry

    place = Affine(0.0005, 0, 1.42, 0, -0.0005, 43.63)
    slope = np.broadcast_to(0.2 * np.arange(120.0), (1, 120, 120)).copy()
    degrees = write_raster(tmp_path / "degrees.tif", slope, place, "EPSG:4326")
    with rasterio.open(degrees) as file:
        utm, width, height = calculate_default_transform(file.crs, "EPSG:32631", 120, 120, *file.bounds)
        warped = np.full((1, height, width), np.nan)
        reproject(slope, warped, src_transform=place, src_crs=file.crs, dst_transform=utm, dst_crs="EPSG:32631",
                  dst_nodata=np.nan, resampling=Resampling.bilinear)  # fmt: skip
    projected = write_raster(tmp_path / "utm.tif", warped, utm, "EPSG:32631")
    one, other = (
        epipolar_geometry(*sensor_images(raw[0].parent), Terrain(dem), "coarser") for dem in (degrees, projected)
    )
    assert np.ptp(one.right - one.left) > 1
    assert_allclose(other.right, one.right, rtol=0, atol=0.05)


def test_epipolar_geometry__names_undeclared_voids_of_a_dem_and_turns_it(raw, tmp_path, caplog):
    from surfaces import write_raster

    from sat_intervals.heights.epipolar import Terrain, epipolar_geometry

    def grid_of(value, *, up=-1):
        heights = 15 + 0.1 * np.arange(300.0) + np.zeros((1, 300, 1))
        heights[:, 154:160, 155:161] = value  # 0.04 % of the DEM, more of the images
        place = Affine(2e-4, 0, 1.42, 0, up * 2e-4, 43.63 if up < 0 else 43.57)
        dem = write_raster(tmp_path / "dem.tif", heights[:, ::-up], place, "EPSG:4326")
        caplog.clear()
        return epipolar_geometry(*sensor_images(raw[0].parent), Terrain(dem), "coarser").right

    def named(value):
        line = rf"dem.tif: \d\.\d % of its heights are exactly {value}, .* rio edit-info --nodata {value} "
        return re.search(line, caplog.text)

    expected = grid_of(np.nan)
    assert not caplog.text
    for value in (-32767, 21000):
        assert_array_equal(grid_of(value), expected)
        assert named(value)
    assert_allclose(grid_of(np.nan, up=1), expected, rtol=0, atol=1e-6)
    grid_of(-35)
    assert named(-35)


def test_rectify__a_dem_that_just_covers_is_enough_and_bad_ones_are_refused_in_one_line(made, raw, tmp_path):
    from surfaces import write_raster

    nodes = np.moveaxis(read_layers(made / "left_grid.tif"), 0, -1)[::-1, ::-1].reshape(-1, 2)
    left, _ = sensor_images(raw[0].parent)
    ground = left.model.direct_loc_h(nodes[:, 1], nodes[:, 0], 12.0)[:, :2]
    (west, south), (east, north) = ground.min(axis=0), ground.max(axis=0)

    def raster(name, heights, beyond, moved=0.0):
        size = (east - west + 2 * beyond) / 40, (north - south + 2 * beyond) / 40
        place = Affine(size[0], 0, west - beyond + moved, 0, -size[1], north + beyond)
        return write_raster(tmp_path / name, np.broadcast_to(heights, (1, 40, 40)).copy(), place, "EPSG:4326")

    slope = 0.5 * np.arange(40.0)
    assert invoke("rectify", *raw, tmp_path / "out", "--dem", raster("dem.tif", slope, 3e-4)).exit_code == 0
    record = json.loads((tmp_path / "out" / "rectify.json").read_text())
    assert record["altitude"] is None
    assert record["rows"]["survey"]["rows"]["before"][0] < 0.1
    (tmp_path / "junk.gtx").write_text("junk")
    dem, away = tmp_path / "dem.tif", raster("away.tif", slope, 1e-4, moved=1.0)
    for words, parts in (
        ((raster("feet.tif", 400 + slope, 1e-4),), ["feet.tif: median height 4", "-48 to 72 m"]),
        ((raster("empty.tif", np.nan * slope, 1e-4),), ["empty.tif has no heights at the images"]),
        ((dem, "--geoid", away), ["dem.tif with", "away.tif has no heights"]),
        ((dem, "--geoid", tmp_path / "junk.gtx"), ["as DEM", "junk.gtx"]),
    ):
        refused(["rectify", *raw, tmp_path / "bad", "--dem", *words], *parts)


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (["--altitude", 500], ["height 500 m", "-48 to 72 m"]),
        (["--altitude", 20, "--dem", "dem.tif"], ["give one"]),
        (["--geoid", "geoid.tif"], ["without a DEM"]),
        (["--left-model", "none.RPB"], ["none.RPB: no such file"]),
        (["--right-model", "map.tif"], ["map.tif", "RPC model"]),
    ],
)
def test_rectify__refuses_in_one_line(options, parts, raw, tmp_path, monkeypatch):
    from surfaces import write_raster

    monkeypatch.chdir(tmp_path)
    for name in ("dem.tif", "geoid.tif", "map.tif"):
        write_raster(tmp_path / name, np.full((1, 4, 4), 20.0))
    refused(["rectify", *raw, tmp_path / "out", *options], *parts)


def test_rectify__refuses_images_of_a_map_of_other_places_and_without_base(raw, tmp_path):
    with rasterio.open(raw[0]) as dataset:
        pixels, profile, rpcs = dataset.read(), dataset.profile, dataset.rpcs.to_dict()
    for name, changes in (
        ("map", {"crs": "EPSG:32631", "transform": Affine(0.5, 0, 370_000, 0, -0.5, 4_830_000)}),
        ("away", {"rpcs": rasterio.rpc.RPC(**rpcs | {"long_off": rpcs["long_off"] + 0.008})}),
        ("nan", {"rpcs": rasterio.rpc.RPC(**rpcs | {"line_num_coeff": [float("nan")] * 20})}),
    ):
        with rasterio.open(tmp_path / f"{name}.tif", "w", **{"rpcs": dataset.rpcs} | profile | changes) as written:
            written.write(pixels)
    on_map = tmp_path / "map.tif", raw[1], tmp_path / "out", "--left-model", raw[0]
    refused(["rectify", *on_map], "is on a map (EPSG:32631)")
    refused(["rectify", tmp_path / "away.tif", raw[1], tmp_path / "out"], "do not overlap")
    refused(["rectify", raw[0], raw[0], tmp_path / "out"], "base-to-height ratio")
    refused(["rectify", tmp_path / "nan.tif", raw[1], tmp_path / "out"], "nan.tif", "no numbers")
    assert not list((tmp_path / "out").glob("*.tif"))


def test_surface__of_raw_images_has_the_heights_of_the_scene_and_later_commands_find_the_grids(raw, scene, tmp_path):
    out = tmp_path / "out"
    result = invoke("surface", *raw, out, *SETTINGS)
    assert result.exit_code == 0, result.output
    (error, below, above), filled = errors_of(out / "dsm.tif", scene)
    assert abs(np.median(error)) < 0.1  # a pixel of disparity is 1 m
    # 0.881 and 0.898 for the epipolar images of the scene; raw ones have fewer pixels at their borders
    assert ((below <= 0) & (above >= 0)).mean() > 0.87
    assert filled > 0.86
    before = (out / "dsm.tif").read_bytes()
    again = invoke("surface", *raw, out, *SETTINGS)
    assert again.exit_code == 0
    assert "resampling" not in again.output
    assert (out / "dsm.tif").read_bytes() == before
    run = tmp_path / "run"
    assert invoke("match", out / "left.tif", out / "right.tif", run).exit_code == 0
    assert invoke("dsm", run, *SETTINGS).exit_code == 0
    assert_array_equal(read_layers(run / "dsm.tif"), read_layers(out / "dsm.tif"))
    (run / "geometry.json").unlink()
    assert invoke("rectify", *raw, out, "--altitude", 20, "--overwrite").exit_code == 0
    refused(["dsm", run, *SETTINGS], "left.tif was rectified again")


def test_plan__of_a_raw_pair_resamples_its_middle_and_counts_tiles_of_all(made, raw, tmp_path, monkeypatch):
    from sat_intervals.workflows import plan

    height, width = json.loads((made / "rectify.json").read_text())["size"]
    with rasterio.open(made / "left.tif") as dataset:
        assert dataset.shape == (height, width)
        whole = dataset.read(1)
    parts = []
    monkeypatch.setattr(plan, "_PARTS", (60, 400))
    monkeypatch.setattr(plan, "found_range", lambda left, *rest: parts.append(read_layers(left.path)[0]) or rest[1])
    result = invoke("plan", *raw, *SETTINGS, "--disparity", -45, 15, "--tile-size", 128, "--json")
    assert result.exit_code == 0, result.output
    made = json.loads(result.stdout)
    assert made["tiles"] == -(-height // 128) * -(-width // 128)
    assert made["seconds"] > 0
    row, column = (height - 390) // 2 // 30 * 30, (width - 390) // 2 // 30 * 30
    assert_array_equal(parts[0], whole[row : row + 390, column : column + 390])


def test_surface__in_a_folder_that_was_moved_serves_later_commands(made, tmp_path):
    before, out = tmp_path / "before", tmp_path / "out"
    shutil.copytree(made, before)
    result = invoke("surface", before / "left.tif", before / "right.tif", before, *SETTINGS)
    assert result.exit_code == 0, result.output
    for name in ("run.json", "geometry.json", "rectify.json"):
        assert str(before) not in (before / name).read_text()
    surface = (before / "dsm.tif").read_bytes()
    shutil.move(before, out)
    for words in (["dsm", out, *SETTINGS, "--overwrite"], ["report", out], ["project", out], ["stac", out]):
        result = invoke(*words)
        assert result.exit_code == 0, result.output
    assert (out / "dsm.tif").read_bytes() == surface
    again = invoke("surface", out / "left.tif", out / "right.tif", out, *SETTINGS)
    assert "was already complete" in again.stderr


def test_surface__a_resolution_far_below_the_pixels_is_refused_before_matching(made, raw, tmp_path):
    images = made / "left.tif", made / "right.tif"
    refused(["surface", *images, tmp_path / "run", "--resolution", 0.02], "cells of 0.02 m for each pixel", "coarser")
    row = {"name": "a", "left": str(raw[0]), "right": str(raw[1]), "resolution": 0.015}
    (tmp_path / "pairs.json").write_text(json.dumps([row]))
    assert "cells of 0.015 m" in invoke("batch", tmp_path / "pairs.json", tmp_path).stderr
    assert not list(tmp_path.rglob("intervals.tif")) + list(tmp_path.rglob("tiles"))


def test_surface__of_a_model_that_is_off_recovers_the_rows_or_ends_with_one_line(scene, tmp_path):
    from raw import TURNS, raw_pair

    near, far = raw_pair(tmp_path / "near", scene, off=3, slope=1e-4), raw_pair(tmp_path / "far", scene, off=30)
    result = invoke("surface", *near, tmp_path / "out", *SETTINGS)
    assert (result.exit_code, "lines of sight" in result.stderr) == (0, False)  # judged without the rows
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    rows = np.median([look[2] for look in report["survey"]["rows"]["samples"]])
    assert rows == pytest.approx((3 + 1e-4 * 300) * np.cos(TURNS[1]), abs=0.05)
    refusal = invoke("surface", *far, tmp_path / "far_out", *SETTINGS)
    assert refusal.exit_code == 2
    assert "no height of the ground is found" in refusal.stderr
    assert "epipolar pair" in refusal.stderr.splitlines()[-1]


def test_surface__of_real_raw_images_is_that_of_the_pair_another_program_made_of_them(shared_data, tmp_path):
    raw, epipolar, out = shared_data / "raw_picanteo_pre", shared_data / "dsm_picanteo", tmp_path / "pair"
    assert invoke("rectify", raw / "left.tif", raw / "right.tif", out, "--altitude", 706).exit_code == 0
    rows = json.loads((out / "rectify.json").read_text())["rows"]["survey"]["rows"]
    assert rows["after"][0] <= 0.05
    assert rows["after"][1] <= 0.25
    files = sensor_words(epipolar / name for name in ("left.geom", "right.geom", "left_grid.tif", "right_grid.tif"))
    settings = "--window", 400, 400, 450, 450, "--disparity", -35, 18, "--resolution", 1, "--crs", "EPSG:32637"
    for folder, words in ((out, ()), (epipolar, files)):
        run = tmp_path / f"of_{folder.name}"
        assert invoke("surface", folder / "left.tif", folder / "right.tif", run, *words, *settings).exit_code == 0
    surface = tmp_path / "of_pair" / "dsm.tif"
    heights = read_layers(surface)[0]
    shape, place = read_place(surface)
    difference = heights - read_heights(tmp_path / "of_dsm_picanteo" / "dsm.tif", place, shape, Window(0, 0, *shape))
    known = np.isfinite(difference)
    assert known.sum() > 0.9 * np.isfinite(heights).sum()
    assert (np.abs(difference[known]) <= 1).mean() >= 0.95
    assert abs(np.median(difference[known])) <= 0.05


def test_batch__makes_surfaces_of_raw_pairs(made, raw, tmp_path):
    left, right = raw
    rows = [
        {"name": "raw", "left": str(left), "right": str(right), "resolution": 0.5},
        {"name": "given", "left": str(left), "right": str(right), "resolution": 0.5}
        | {"left_model": str(left), "right_model": str(right)},
        {"name": "wrong", "left": str(left), "right": str(made / "right.tif"), "resolution": 0.5},
    ]
    (tmp_path / "pairs.json").write_text(json.dumps(rows))
    result = invoke("batch", tmp_path / "pairs.json", tmp_path / "out")
    assert result.exit_code == 1
    assert "1 of 3 pairs failed" in result.stderr
    assert "made/out/right.tif has no RPC model" in result.stderr.replace(str(made), "made/out")
    assert_array_equal(*(read_layers(tmp_path / "out" / name / "dsm.tif") for name in ("raw", "given")))
    before = contents(tmp_path / "out" / "raw")
    rerun = invoke("batch", tmp_path / "pairs.json", tmp_path / "out")
    assert "resampling" not in rerun.output
    assert contents(tmp_path / "out" / "raw") == before


def _with_undeclared_border(folder, raw, border, scale=1):
    """Write a raw pair whose empty corners have a value that nothing declares."""
    paths = [folder / f"bordered_{file.name}" for file in raw]
    for file, path in zip(raw, paths, strict=True):
        with rasterio.open(file) as dataset:
            pixels, profile, rpcs = dataset.read() * scale, dataset.profile, dataset.rpcs
        pixels[pixels == 0] = border
        with rasterio.open(path, "w", **profile | {"nodata": None, "dtype": pixels.dtype}, rpcs=rpcs) as dataset:
            dataset.write(pixels)
    return paths


@pytest.mark.parametrize(("border", "scale"), [(0, 1), (11, 1), (0, np.float32(1 / 4096))])
def test_rectify__names_undeclared_no_data_of_the_raw_images(raw, tmp_path, border, scale):
    left, right = _with_undeclared_border(tmp_path, raw, border, scale)
    result = invoke("rectify", left, right, tmp_path / "out", "--json")
    warned = json.loads(result.stdout)["warnings"]
    assert [f"warning: {line}" for line in warned] == [line for line in result.stderr.splitlines() if "exactly" in line]
    for path, line in zip((left, right), warned, strict=True):
        assert re.fullmatch(rf"{path}: \d\d % of the pixels are exactly {border}, .* give --nodata {border}", line)
    declared = invoke("rectify", left, right, tmp_path / "declared", "--nodata", border, "--json")
    assert json.loads(declared.stdout)["warnings"] == []
    twice = invoke("rectify", left, left, tmp_path / "twice", "--nodata", border, "--right-model", right)
    assert f"{left} and {left} have the same pixels: give the left and the right image" in twice.stderr


def test_surface_and_batch__are_strict_about_the_raw_images(raw, tmp_path):
    left, right = _with_undeclared_border(tmp_path, raw, 7)
    words = "--disparity", -60, 20, "--strict", "--quiet"
    result = invoke("surface", left, right, tmp_path / "out", *SETTINGS, *words)
    (tmp_path / "pairs.csv").write_text(f"name,left,right,minimum,maximum,resolution\npair,{left},{right},-60,20,0.5\n")
    of_batch = invoke("batch", tmp_path / "pairs.csv", tmp_path / "batch", "--strict", "--quiet")
    for one in (result, of_batch):
        assert one.exit_code == 1
        assert one.stderr.count("if it is no data, give --nodata 7") == 2
        assert "warnings, see above, and --strict is given" in one.stderr


def test_rectify__masks_grow_by_the_pixels_around_and_no_value_becomes_no_data(made, raw, tmp_path):
    from sat_intervals.heights.resampling import stored

    values = np.array([np.nan, -3.0, 0.4, 1.0, 254.6, 300.0])
    assert_array_equal(stored(values, "uint8", 0.0), [0, 1, 1, 1, 255, 255])
    assert_array_equal(stored(values, "uint8", 255.0), [255, 0, 0, 1, 254, 254])
    assert_array_equal(stored(values, "float32", np.nan), values.astype(np.float32))
    with rasterio.open(raw[0]) as dataset:
        mask = np.zeros(dataset.shape, np.uint8)
    mask[250:290, 250:300] = 1
    kind = {"height": mask.shape[0], "width": mask.shape[1], "count": 1, "dtype": "uint8"}
    with rasterio.open(tmp_path / "mask.tif", "w", driver="GTiff", **kind) as dataset:
        dataset.write(mask, 1)
    words = "--left-mask", tmp_path / "mask.tif", "--altitude", read_altitude(made)
    assert invoke("rectify", *raw, tmp_path / "out", *words).exit_code == 0
    before, after = (read_layers(folder / "left.tif")[0] for folder in (made, tmp_path / "out"))
    lost = int(((before > 0) & (after == 0)).sum())
    assert 43 * 53 - 60 <= lost <= 44 * 54 + 60  # a cubic needs one or two pixels on each side
    assert_array_equal(before[after > 0], after[after > 0])
