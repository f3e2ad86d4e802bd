"""Points and heights: cameras of known geometry, shareloc's own points, and a real pair with the surface of a peer."""

import csv
import json
import shutil
from contextlib import suppress
from dataclasses import asdict

import numpy as np
import pytest
import rasterio
from cameras import EAST, LATITUDE, LONGITUDE, NORTH, cameras, grid, sensor_words
from finished import FINISHED, MAXIMUM, MINIMUM, write_run
from helpers import invoke, write_pair
from pyproj import Transformer
from rasterio.transform import Affine
from rasterio.warp import reproject

from sat_intervals import SatIntervalsError, match_pair
from sat_intervals.demo import DATUM, PIXEL, VIEWS, make_scene
from sat_intervals.kernels.row_offsets import RowOffsets
from sat_intervals.products import INVALID, POINTS
from sat_intervals.raster import Projection
from sat_intervals.raster.vertical import horizontal
from sat_intervals.results import open_run
from sat_intervals.tiling import Window
from sat_intervals.workflows.dsm import make_surface

with suppress(SatIntervalsError):  # without shareloc all tests here are skipped
    from sat_intervals.heights.geometry import geometry_of, set_geometry
    from sat_intervals.heights.lattice import Extent, Ground, on_map
    from sat_intervals.heights.location import Location
    from sat_intervals.heights.sensors import Sensors, lattice_of
    from sat_intervals.heights.triangulate import triangulate

pytestmark = [
    pytest.mark.peer("shareloc"),
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),  # as epipolar images are
]

BAND = {band.name: index for index, band in enumerate(POINTS)}


def on_the_ground(row, column, height):
    """Longitude and latitude of the point that the left view shows at a pixel."""
    east = (column - VIEWS[0] * (height - DATUM)) * PIXEL
    return LONGITUDE + east / EAST, LATITUDE - row * PIXEL / NORTH


def read(path):
    with rasterio.open(path) as dataset:
        return dataset.read()


def test_triangulate__heights_of_an_exact_scene_come_back(tmp_path):
    scene = make_scene(150, 190, seed=4)
    truth = np.clip(scene.truth, MINIMUM + 3, MAXIMUM - 3)
    validity = np.where(np.isnan(truth), 1, 0).astype(np.uint16)
    bands = np.stack([truth, truth - 2.0, truth + 3.0, np.ones_like(truth)]).astype(np.float32)
    out = write_run(tmp_path, bands, validity)
    set_geometry(out, *cameras(tmp_path, *truth.shape))
    report = triangulate(out)
    points = read(out / "points.tif")
    known = validity == 0
    assert report["points"] == known.sum()
    assert report["median_residual"] < 1e-3
    assert points[BAND["residual"]][known].max() < 1e-3
    heights = {"height": truth, "height_lower": truth - 2.0, "height_upper": truth + 3.0}
    row, column = np.indices(truth.shape)
    for name, disparity in heights.items():
        height = DATUM + disparity / (VIEWS[1] - VIEWS[0])
        assert np.abs(points[BAND[name]] - height)[known].max() < 0.01, name
        longitude, latitude = on_the_ground(row, column, height)
        end = name.removeprefix("height")
        assert np.abs(points[BAND[f"longitude{end}"]] - longitude)[known].max() * EAST < 0.01
        assert np.abs(points[BAND[f"latitude{end}"]] - latitude)[known].max() * NORTH < 0.01
    assert np.isnan(points[:, ~known]).all()


@pytest.fixture
def level_run(tmp_path):
    """A run of one disparity, 1, in the interval -1.5 to 4, and its cameras."""
    bands = np.full((4, 40, 50), 1.0, np.float32)
    bands[1], bands[2] = -1.5, 4.0
    return write_run(tmp_path, bands, np.zeros((40, 50), np.uint16)), cameras(tmp_path, 40, 50)


def test_triangulate__orders_bounds_by_height(level_run):
    # The views change places: height falls as disparity grows.
    out, (left, right, *grids) = level_run
    set_geometry(out, right, left, *grids)
    triangulate(out)
    points = read(out / "points.tif")
    assert np.abs(points[BAND["height_lower"]] - (DATUM - 4.0)).max() < 0.01
    assert np.abs(points[BAND["height_upper"]] - (DATUM + 1.5)).max() < 0.01
    assert np.abs(points[BAND["height"]] - (DATUM - 1.0)).max() < 0.01


@pytest.mark.parametrize("middle", [180.0, -180.0])
def test_triangulate__across_the_180th_meridian_is_as_elsewhere(tmp_path, middle):
    out = write_run(tmp_path, np.ones((4, 40, 50), np.float32), np.zeros((40, 50), np.uint16))
    offset = on_the_ground(20, 25, DATUM)[0] - LONGITUDE
    set_geometry(out, *cameras(tmp_path, 40, 50))
    triangulate(out)
    elsewhere = read(out / "points.tif")
    set_geometry(out, *cameras(tmp_path, 40, 50, longitude=middle - offset))
    triangulate(out)
    points = read(out / "points.tif")
    longitude = points[BAND["longitude"]]
    assert (np.abs(longitude) <= 180).all()
    assert {-1.0, 1.0} == set(np.sign(longitude.ravel()))
    east = (longitude - middle + 180) % 360 - 180
    assert np.abs(east - (elsewhere[BAND["longitude"]] - LONGITUDE - offset)).max() < 1e-8
    for name in ("latitude", "height", "height_lower", "residual"):
        assert np.abs(points[BAND[name]] - elsewhere[BAND[name]]).max() < 1e-5


@pytest.fixture(scope="module")
def matched_scene(tmp_path_factory):
    """A procedural scene, matched and triangulated: the scene and the folder of the run."""
    folder = tmp_path_factory.mktemp("scene")
    scene = make_scene(260, 300, seed=2)
    match_pair(folder / "left.tif", folder / "right.tif", folder / "out", write_pair(folder, scene))
    set_geometry(folder / "out", *cameras(folder, 260, 300))
    triangulate(folder / "out")
    return scene, folder / "out"


def test_triangulate__as_many_true_heights_are_inside_as_disparities(matched_scene):
    scene, out = matched_scene
    (disparity, lower, upper, _), validity = read(out / "intervals.tif"), read(out / "validity.tif")[0]
    points = read(out / "points.tif")
    judged = (validity & INVALID == 0) & np.isfinite(scene.truth)
    inside = ((lower <= scene.truth) & (scene.truth <= upper))[judged]
    height = DATUM + scene.truth / (VIEWS[1] - VIEWS[0])
    low, high = points[BAND["height_lower"]], points[BAND["height_upper"]]
    assert 0.8 < inside.mean() < 1
    assert ((low - 1e-3 <= height) & (height <= high + 1e-3))[judged].mean() >= inside.mean()
    assert np.nanmax(np.abs(points[BAND["height"]] - (DATUM + disparity))) < 0.01


def test_make_surface__as_many_true_heights_are_inside_cells_as_disparities(matched_scene, tmp_path):
    scene, out = matched_scene
    make_surface([out], tmp_path / "dsm.tif", resolution=PIXEL)
    with rasterio.open(tmp_path / "dsm.tif") as dataset:
        surface, place, crs = dataset.read(), dataset.transform, dataset.crs
    assert horizontal(crs) == "EPSG:32631"
    # The true ground under every cell: the points of the visible truth, each in the cell it falls in.
    row, column = np.nonzero(scene.visible)
    height = DATUM + scene.truth[row, column]
    x, y = rasterio.warp.transform("EPSG:4326", crs, *on_the_ground(row, column, height))
    i = np.floor((np.array(y) - place.f) / place.e).astype(int)
    j = np.floor((np.array(x) - place.c) / place.a).astype(int)
    inner = (i >= 0) & (j >= 0) & (i < surface.shape[1]) & (j < surface.shape[2])
    _, low, high = surface[:3, i[inner], j[inner]]
    filled = np.isfinite(low)
    inside = (low - 1e-3 <= height[inner]) & (height[inner] <= high + 1e-3)
    (_, lower, upper, _), validity = read(out / "intervals.tif"), read(out / "validity.tif")[0]
    judged = (validity & INVALID == 0) & scene.visible
    held = ((lower <= scene.truth) & (scene.truth <= upper))[judged].mean()
    assert filled.mean() > 0.9
    assert inside[filled].mean() >= held


REGION = Window(0, 0, 1216, 1262)


@pytest.fixture(scope="module")
def real(shared_data):
    """Models and grids of a real pair, and its lattice."""
    sensors = Sensors.load(*(shared_data / "dsm_picanteo" / name for name in FILES))
    return sensors, lattice_of(sensors, REGION, -35, 18)


def test_lattice__gives_points_that_were_checked(shared_data, real):
    with (shared_data / "dsm_picanteo" / "triangulation_check.csv").open() as stream:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(stream)]
    assert len(rows) == 200
    for point in rows:
        window = Window(int(point["row"]), int(point["col"]), 1, 1)
        longitude, latitude, height, _ = real[1].points(window, np.array([[point["disparity"]]]))
        assert abs(height - point["height"]) < 1e-3
        assert abs(longitude - point["lon"]) * 88_000 < 1e-3
        assert abs(latitude - point["lat"]) * 111_000 < 1e-3


def test_on_map__places_are_those_of_shareloc_and_pyproj(real):
    sensors, lattice = real
    random = np.random.default_rng(0)
    row, column = (random.integers(0, size, 300) for size in (REGION.height, REGION.width))
    disparity = random.uniform(-35, 18, 300)
    longitude, latitude, height, _ = sensors.triangulate(row, column, disparity).T
    for crs in ("EPSG:32631", "EPSG:2154", "EPSG:32632"):
        x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
        on_ground = on_map(lattice, Projection(crs), "run")
        for n in range(300):
            found = on_ground.points(Window(row[n], column[n], 1, 1), disparity[n : n + 1, None])
            assert np.hypot(*(found.ravel() - (x[n], y[n], height[n]))[:2]) < 1e-3
            assert abs(found.ravel()[2] - height[n]) < 1e-3


def test_ground__windows_hold_every_point_of_an_extent(real, monkeypatch):
    monkeypatch.setattr("sat_intervals.heights.lattice.WINDOW", 300)
    ground = Ground(on_map(real[1], Projection("EPSG:32631"), "run"))
    disparity = np.random.default_rng(1).uniform(-35, 18, (REGION.height, REGION.width))
    x, y, _ = ground.lattice.points(REGION, disparity)
    for left, right, low, high in ((0.3, 0.4, 0.1, 0.7), (0.0, 1.0, 0.0, 0.2), (0.5, 0.5, 0.5, 0.5)):
        ends = np.quantile(x, (left, right)), np.quantile(y, (low, high))
        extent = Extent(ends[0][0], ends[1][0], ends[0][1], ends[1][1])
        inside = (x >= extent.left) & (x <= extent.right) & (y >= extent.bottom) & (y <= extent.top)
        for window in ground.windows(extent):
            inside[window.slices] = False
        assert not inside.any()


FILES = ("left.geom", "right.geom", "left_grid.tif", "right_grid.tif")


def test_commands__a_real_pair_to_a_surface_like_that_of_a_peer(shared_data, tmp_path):
    folder, out = shared_data / "dsm_picanteo", tmp_path / "out"
    pair, settings = (folder / "left.tif", folder / "right.tif"), ("--preset", "paper", "--disparity", -35, 18)
    for step in (
        ("match", *pair, out, *settings, "--quiet"),
        ("dsm", out, "--resolution", 1, *sensor_words(folder / name for name in FILES)),
    ):
        result = invoke(*step)
        assert result.exit_code == 0, result.output
    with rasterio.open(folder / "peer_dsm_mean_1m.tif") as peer, rasterio.open(out / "dsm.tif") as ours:
        expected, surface = peer.read(1), np.full(peer.shape, np.nan, np.float32)
        assert horizontal(ours.crs) == peer.crs
        reproject(ours.read(1), surface, src_transform=ours.transform, src_crs=ours.crs, dst_transform=peer.transform,
                  dst_crs=peer.crs, src_nodata=np.nan, dst_nodata=np.nan)  # fmt: skip
    both = np.isfinite(surface) & np.isfinite(expected)
    difference = (surface - expected)[both]
    assert both.sum() > 0.99 * np.isfinite(expected).sum()
    assert abs(np.median(difference)) < 0.2
    assert (np.abs(difference) <= 1.0).mean() > 0.9


def test_triangulate__a_region_of_the_image_gives_the_same_points(shared_data, tmp_path):
    folder = shared_data / "dsm_picanteo"
    pair = folder / "left.tif", folder / "right.tif"
    search = {"disparity": {"minimum": -35, "maximum": 18}}
    config = {"preset": "paper", **search, "regularization": None, "median": None}
    for name, window in (("whole", Window(500, 400, 200, 240)), ("part", Window(560, 470, 80, 90))):
        match_pair(*pair, tmp_path / name, config, window=window)
        set_geometry(tmp_path / name, *(folder / file for file in FILES))
        triangulate(tmp_path / name)
    part = read(tmp_path / "part" / "points.tif")
    whole = read(tmp_path / "whole" / "points.tif")[:, 60:140, 70:160]
    same = read(tmp_path / "part" / "intervals.tif")[0] == read(tmp_path / "whole" / "intervals.tif")[0, 60:140, 70:160]
    assert same.mean() > 0.3
    for band, allowed in (("longitude", 1e-8), ("latitude", 1e-8), ("height", 2e-3)):
        assert np.abs(part - whole)[BAND[band]][same].max() < allowed


def test_triangulate_command__what_it_cannot_use_gets_one_line(level_run, tmp_path):
    out, files = level_run
    short = grid(tmp_path / "short.tif", 10, 10, step=10)
    descending = tmp_path / "descending.tif"
    with rasterio.open(files[3]) as file, rasterio.open(descending, "w", **upside_down(file)) as other:
        other.write(file.read()[:, ::-1])
    (tmp_path / "model.geom").write_text("no model\n")
    cases = [
        ({0: tmp_path / "missing.geom"}, "missing.geom: no such file: give the RPC model of the image"),
        ({1: tmp_path / "model.geom"}, "model.geom as RPC model: "),
        ({2: tmp_path / "model.geom"}, "model.geom as epipolar grid: "),
        ({3: short}, "columns -20 to 30 of the right epipolar image, the run needs rows 0 to 39"),
        ({3: grid(tmp_path / "far.tif", 40, 50, offset=9000.0)}, "the models do not fit these images"),
        ({3: descending}, "rows of {descending} are in descending order: give a grid in ascending order"),
    ]
    for changed, message in cases:
        result = invoke("triangulate", out, *sensor_words(changed.get(place, file) for place, file in enumerate(files)))
        assert result.exit_code == 2, result.output
        assert message.format(descending=descending) in result.output
        assert result.output.count("\n") == 1
        assert not {"points.tif", "geometry.json"} & {file.name for file in out.iterdir()}


def upside_down(file):
    """The profile of a grid whose rows are in the opposite order."""
    place = file.transform
    return file.profile | {"transform": Affine(place.a, 0, place.c, 0, -place.e, place.f + file.height * place.e)}


def test_triangulate_command__warns_of_models_that_nearly_fit(level_run, tmp_path):
    out, files = level_run
    shifted = grid(tmp_path / "shifted.tif", 40, 50, offset=1.5)
    result = invoke("triangulate", out, *sensor_words([*files[:3], shifted]), "--quiet")
    assert result.exit_code == 0, result.output
    assert f"warning: {out}: lines of sight miss each other by 0." in result.stderr
    assert result.stdout == ""
    assert invoke("triangulate", out, *sensor_words(files)).stderr == ""


@pytest.mark.parametrize("hole", [np.nan, -9999.0])
def test_triangulate_command__a_hole_in_a_grid_loses_the_points_around_it(level_run, tmp_path, hole):
    out, files = level_run
    set_geometry(out, *files)
    triangulate(out)
    whole = read(out / "points.tif")[BAND["height"]]
    files = [*files[:2], grid(tmp_path / "holed.tif", 40, 50, step=4), files[3]]
    with rasterio.open(files[2], "r+") as file:
        positions = file.read()
        positions[:, 2, 2] = hole  # of epipolar row and column 0, one of nine nodes of the lattice
        file.write(positions)
        file.nodata = None if np.isnan(hole) else hole
    result = invoke("triangulate", out, *sensor_words(files))
    assert result.exit_code == 0, result.output
    points = read(out / "points.tif")[BAND["height"]]
    lost = np.isnan(points)
    assert 0 < lost.sum() < lost.size
    assert f"{out}: no points in 25 %: grids or models have no values there" in result.stderr
    assert abs(lost.mean() - 0.25) < 0.02
    np.testing.assert_allclose(points[~lost], whole[~lost], atol=1e-3)


def test_surface_command__is_match_and_dsm_and_resumes(tmp_path, monkeypatch):
    scene = make_scene(120, 150, seed=4)
    write_pair(tmp_path, scene)
    files = cameras(tmp_path, *scene.truth.shape)
    sensors = list(map(str, sensor_words(files)))
    images = [str(tmp_path / name) for name in ("left.tif", "right.tif")]
    search = ["--disparity", str(scene.minimum), str(scene.maximum)]
    out, steps = tmp_path / "one", tmp_path / "steps"
    command = ["surface", *images, str(out), *sensors, *search, "--resolution", "1"]
    (tmp_path / "heights.yaml").write_text(
        "{version: 2, name: city, coverage: 0.9, registered: true, surface: {CELL: 9 m}, "
        "classes: [{relief_below: null, half_width_below: null, margin: 1.0, cells: 99}]}"
    )
    for option, value, message in (
        ("--crs", "4326", "is not a map in metres"),
        ("--geoid", "no.gtx", "no.gtx: no such file"),
        ("--height-calibration", tmp_path / "heights.yaml", "CELL is 9 m in the calibration and 1 m in the surface"),
    ):
        wrong = invoke(*command, option, value)
        assert (wrong.exit_code, message in wrong.stderr, out.exists()) == (2, True, False)
    monkeypatch.setattr("sat_intervals.heights.dsm.PointCloud", None)  # an error of the last step
    assert invoke(*command).exit_code == 1
    monkeypatch.undo()
    before = (out / "run.json").read_bytes()
    result = invoke(*command)
    assert result.exit_code == 0, result.stderr
    assert (out / "run.json").read_bytes() == before
    assert "% with a height" in result.stdout
    assert "median half width +-" in result.stdout
    figures = json.loads(invoke(*command, "--json").stdout)
    assert figures["run"] == open_run(out).report
    assert figures["surface"]["points"] > 0
    assert 0 < figures["surface"]["filled"] <= 1
    assert invoke("match", *images, str(steps), *search, "--quiet").exit_code == 0
    assert invoke("dsm", str(steps), *sensors, "--resolution", "1", "--quiet").exit_code == 0
    assert np.array_equal(read(out / "dsm.tif"), read(steps / "dsm.tif"), equal_nan=True)
    other = invoke(*command, "--preset", "paper")
    assert (other.exit_code, "already holds another run" in other.stderr) == (2, True)


def test_batch_command__rows_with_models_and_grids_go_on_to_a_surface(tmp_path):
    scene = make_scene(120, 150, seed=4)
    write_pair(tmp_path, scene)
    files = cameras(tmp_path, *scene.truth.shape)
    columns = "name,left,right,minimum,maximum,left_model,right_model,left_grid,right_grid,resolution"
    images = f"left.tif,right.tif,{scene.minimum},{scene.maximum}"
    sensors = ",".join(file.name for file in files)
    pairs, out = tmp_path / "pairs.csv", tmp_path / "out"

    def batch(*rows):
        pairs.write_text("\n".join([columns, *rows]) + "\n")
        return invoke("batch", pairs, out, "--quiet")

    for row, message in (
        (f"a,{images},{sensors},", "row 1 lacks resolution: a surface needs left_model"),
        (f"a,{images},,,{files[2].name},,1", "row 1 lacks left_model and right_model and right_grid: a surface needs"),
        (f"a,{images},{sensors},wide", "row 1: resolution is 'wide'"),
    ):
        result = batch(row)
        assert (result.exit_code, result.stderr.count("\n"), out.exists()) == (2, 1, False), result.output
        assert message in result.stderr
    both = f"a,{images},{sensors},1", f"b,{images},,,,,"
    assert batch(*both).exit_code == 0
    report = json.loads((out / "batch.json").read_text())
    assert report["a"]["surface"]["crs"] == "EPSG:32631"
    assert "surface" not in report["b"]
    assert not (out / "b" / "dsm.tif").exists()
    result = batch(both[0], "b,out/a/dsm.tif,right.tif,0,9,,,,,")
    assert (result.exit_code, "dsm.tif would be written" in result.stderr) == (2, True)
    assert batch(f"a,{images},{sensors},2").exit_code == 0
    assert read(out / "a" / "dsm.tif").shape[1] < 60  # made again
    assert batch(f"a,{images},{sensors},1", f"b,{images},{sensors},1").exit_code == 0
    assert (out / "b" / "dsm.tif").exists()
    assert invoke("dsm", out, "--resolution", 1).exit_code == 0
    with rasterio.open(out / "dsm.tif") as fused:
        assert len(fused.tags()["RUNS"].split()) == 2
    for command, name in (("report", "report.html"), ("project", "project.qgz")):
        made = invoke(command, out)
        assert made.exit_code == 0, made.output
        assert {str(out / pair / name) for pair in "ab"} <= set(made.stdout.split("\n"))
    (out / "batch.json").write_text(json.dumps({"a": {"state": "failed", "error": "x"}}))
    refused = invoke("report", out)
    assert refused.exit_code == 2
    assert f"{out} is a batch, and none of its pairs is done: a: see status {out}" in refused.stderr


def test_surface_command__refuses_an_image_that_its_surface_would_replace(tmp_path):
    write_pair(tmp_path, make_scene(60, 80, seed=4))
    files, surface = cameras(tmp_path, 60, 80), tmp_path / "out" / "dsm.tif"
    surface.parent.mkdir()
    shutil.copy(tmp_path / "left.tif", surface)
    images = surface, tmp_path / "right.tif"
    result = invoke("surface", *images, tmp_path / "out", *sensor_words(files), "--disparity", 0, 9, "--resolution", 1)
    assert (result.exit_code, "dsm.tif would be written" in result.stderr) == (2, True)
    assert [file.name for file in surface.parent.iterdir()] == ["dsm.tif"]


def test_dsm_command__remembers_models_and_grids_in_the_folder(level_run, tmp_path):
    out, files = level_run
    plain = invoke("dsm", out, "--resolution", 1)
    assert (plain.exit_code, plain.stderr.count("\n")) == (2, 1)
    assert f"{out} has no sensor models and grids yet: give left and right models and grids" in plain.stderr
    assert invoke("dsm", out, "--resolution", 1, *sensor_words(files)).exit_code == 0
    expected = read(out / "dsm.tif")
    assert invoke("dsm", out, "--resolution", 1).exit_code == 0
    np.testing.assert_array_equal(read(out / "dsm.tif"), expected)
    assert invoke("triangulate", out).exit_code == 0
    grid(files[3], 40, 50, offset=0.75)
    changed = invoke("dsm", out, "--resolution", 1)
    assert (changed.exit_code, f"{files[3]} has changed since" in changed.stderr) == (2, True)
    assert invoke("dsm", out, "--resolution", 1, *sensor_words(files)).exit_code == 0
    report = json.loads((out / "run.json").read_text())
    report["inputs"]["left"]["sha256"] = 64 * "0"
    (out / "run.json").write_text(json.dumps(report))
    other = invoke("dsm", out, "--resolution", 1)
    assert (other.exit_code, "geometry.json is of other images" in other.stderr) == (2, True)


def test_dsm_command__points_are_those_of_the_rows_that_were_matched(level_run, tmp_path):
    out, files = level_run
    expected = [tmp_path / "expected.tif", tmp_path / "found.tif"]
    assert invoke("triangulate", out, *sensor_words(files), "--output", expected[0]).exit_code == 0
    # the right grid lies lower by a plane, and the run took its rows out
    lower = RowOffsets((0.6, 0.3, -0.2), 40, 50)
    moved = tmp_path / "moved.tif"
    with rasterio.open(files[3]) as file, rasterio.open(moved, "w", **file.profile) as other:
        positions, place = file.read(), file.transform
        column, row = np.meshgrid(*(place.c + place.a * (np.arange(size) + 0.5) for size in (file.width, file.height)))
        positions[1] -= lower.at(row, column)
        other.write(positions)
    report = json.loads((out / "run.json").read_text())
    words = sensor_words([*files[:3], moved])
    wrong = invoke("triangulate", out, *words, "--output", tmp_path / "wrong.tif")
    assert "warning" in wrong.stderr
    (out / "run.json").write_text(json.dumps(report | {"rows": asdict(lower)}))
    result = invoke("triangulate", out, *words, "--output", expected[1])
    assert result.exit_code == 0
    assert "check that the grids were made with these models" in result.stderr  # this one was not
    one, other = map(read, expected)
    misfit = Location(sensors := geometry_of(open_run(out)).sensors)
    row, column, disparity = np.array([5, 30]), np.array([7, 40]), np.array([1.0, 2.0])
    seen = misfit.positions(*sensors.triangulate(row, column, disparity)[:, :3].T)
    np.testing.assert_allclose(seen[:, 2] - row, lower.at(row, column + disparity), atol=0.01)
    pixel = 0.02 * PIXEL
    assert np.abs(one[2:5] - other[2:5]).max() < pixel
    assert (np.abs(one[0] - other[0]) * EAST).max() < pixel
    assert (np.abs(one[1] - other[1]) * NORTH).max() < pixel


def test_dsm_command__of_two_runs_takes_the_models_and_grids_of_each(level_run, tmp_path):
    out, files = level_run
    (tmp_path / "b").mkdir()
    other = shutil.copytree(out, tmp_path / "b" / "out")
    report = (other / "run.json").read_text()
    (other / "run.json").write_text(report.replace(FINISHED, "2026-11-22T12:00:00+00:00"))
    swapped = [files[1], files[0], files[3], files[2]]  # heights then fall with the disparity
    words = [*sensor_words(files), *sensor_words(swapped)]
    result = invoke("dsm", out, other, "--resolution", 1, *words)
    assert result.exit_code == 0, result.stderr
    for folder, height in ((out, DATUM + 1), (other, DATUM - 1)):
        assert invoke("dsm", folder, "--resolution", 1, "--output", tmp_path / "one.tif", "--overwrite").exit_code == 0
        assert abs(np.nanmedian(read(tmp_path / "one.tif")[0]) - height) < 0.01


@pytest.mark.peer("laspy")
@pytest.mark.parametrize("name", ["points.laz", "points.las"])
def test_triangulate_command__writes_a_point_cloud(matched_scene, tmp_path, name):
    import laspy

    scene, out = matched_scene
    result = invoke("triangulate", out, "--output", tmp_path / name)
    assert result.exit_code == 0, result.stderr
    bands = read(out / "points.tif")
    cloud = laspy.read(tmp_path / name)
    known = np.isfinite(bands[0])
    assert cloud.header.parse_crs().to_2d().to_epsg() == 32631
    assert cloud.header.parse_crs().axis_info[2].name == "Ellipsoidal height"
    assert len(cloud.points) == known.sum()
    x, y = Transformer.from_crs(4326, 32631, always_xy=True).transform(*bands[:2, known])
    expected = np.stack([x, y, *bands[[2, 3, 4]][:, known]])
    found = np.stack([cloud.x, cloud.y, cloud.z, cloud["lower"], cloud["upper"]])
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3, equal_nan=True)
    np.testing.assert_array_equal(cloud.intensity, scene.left[known])
    np.testing.assert_array_equal(cloud["confidence"], read(out / "intervals.tif")[3][known])
    again = invoke("triangulate", out, "--output", tmp_path / name)
    assert invoke("triangulate", out, "--output", tmp_path / "points.csv").exit_code == 2
    assert (again.exit_code, f"{name} exists: choose another name or --overwrite" in again.stderr) == (2, True)


def test_triangulate_command__warns_of_grids_that_reach_far_beyond_the_image(tmp_path):
    out = write_run(tmp_path, np.full((4, 60, 80), 5, np.float32), np.zeros((60, 80), np.uint16))
    result = invoke("triangulate", out, *sensor_words(cameras(tmp_path, 60, 80)))
    assert (result.exit_code, result.stderr) == (0, "")
    result = invoke("triangulate", out, *sensor_words(cameras(tmp_path, 60, 140)))  # nodes -40, -20, ... 180
    assert result.exit_code == 0
    assert f"warning: {out}: the left grid reaches 101 px beyond the left image, more than 4 of its" in result.stderr


def test_batch_command__a_bad_model_fails_its_pair_only(tmp_path):
    scene = make_scene(60, 80, seed=4)
    write_pair(tmp_path, scene)
    cameras(tmp_path, 60, 80)
    grid(tmp_path / "shifted.tif", 60, 80, offset=1.5)
    images = f"left.tif,right.tif,{scene.minimum},{scene.maximum}"
    (tmp_path / "pairs.csv").write_text(
        "name,left,right,minimum,maximum,left_model,right_model,left_grid,right_grid,resolution\n"
        f"good,{images},left_model.tif,right_model.tif,left_grid.tif,right_grid.tif,1\n"
        f"near,{images},left_model.tif,right_model.tif,left_grid.tif,shifted.tif,1\n"
        f"bad,{images},no.tif,right_model.tif,left_grid.tif,right_grid.tif,1\n"
    )
    result = invoke("batch", tmp_path / "pairs.csv", tmp_path / "out")
    assert result.exit_code == 1
    assert result.stderr.startswith(f"warning: bad: there will be no surface: {tmp_path / 'no.tif'}: no such file")
    assert "1 of 3 pairs failed" in result.stderr
    assert f"warning: {tmp_path / 'out' / 'near'}: lines of sight miss each other by 0." in result.stderr
    assert f"warning: {tmp_path / 'out' / 'good'}" not in result.stderr
    report = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert [end["state"] for end in report.values()] == ["done", "done", "failed"]
    assert report["bad"]["counts"] == report["good"]["counts"]
    assert "no.tif: no such file" in report["bad"]["error"]
    assert report["good"]["surface"]["points"] > 0
    assert (tmp_path / "out" / "near" / "dsm.tif").exists()
