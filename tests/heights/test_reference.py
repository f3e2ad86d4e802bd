"""Reference heights to true disparities: analytic scenes, registration, files of points, inputs that do not fit."""

import csv
import json
import shutil
from contextlib import suppress

import numpy as np
import pytest
import rasterio
from cameras import EAST, LATITUDE, LONGITUDE, NORTH, cameras, sensor_words
from finished import write_run
from helpers import invoke
from rasterio.transform import Affine
from surfaces import write_geoid

from sat_intervals import SatIntervalsError
from sat_intervals.demo import DATUM, PIXEL, VIEWS
from sat_intervals.raster import Projection, Vertical

with suppress(SatIntervalsError):  # without shareloc all tests here are skipped
    from sat_intervals.heights.geometry import set_geometry
    from sat_intervals.heights.reference import Reference, make_truth

pytestmark = [
    pytest.mark.peer("shareloc", "pyarrow"),
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),  # as epipolar images are
]

ROWS, COLUMNS, AROUND = 150, 190, 60
MAP = Projection("EPSG:32631")


def write_heights(path, heights, finer=1, crs="EPSG:4326"):
    """Write heights known at ``finer`` cells a pixel, from AROUND pixels outside the image on."""
    place = Affine(PIXEL / EAST / finer, 0, LONGITUDE - AROUND * PIXEL / EAST,
                   0, -PIXEL / NORTH / finer, LATITUDE + AROUND * PIXEL / NORTH)  # fmt: skip
    kind = {"height": heights.shape[0], "width": heights.shape[1], "count": 1, "dtype": "float32", "nodata": np.nan}
    with rasterio.open(path, "w", driver="GTiff", crs=crs, transform=place, **kind) as dataset:
        dataset.write(heights.astype(np.float32), 1)
    return path


def on_ground(heights_at, finer=1):
    """Heights of a function of rows and ground columns at the centres of cells."""
    row, column = (np.arange(-AROUND, size + AROUND, 1 / finer) + 0.5 / finer for size in (ROWS, COLUMNS))
    return heights_at(row[:, None], column[None, :])


class Town:
    """Boxes on level ground."""

    def __init__(self, seed=0, count=40):
        random = np.random.default_rng(seed)
        row, column = random.uniform(0, ROWS, count), random.uniform(-20, COLUMNS + 20, count)
        sides = random.uniform(8, 30, (2, count))
        self.boxes = np.stack([row, row + sides[0], column, column + sides[1], random.uniform(2, 22, count)]).T

    def heights(self, row, column):
        height = np.full(np.broadcast_shapes(row.shape, column.shape), DATUM)
        for first, last, left, right, top in self.boxes:
            inside = (row >= first) & (row < last) & (column >= left) & (column < right)
            height = np.where(inside, np.maximum(height, DATUM + top), height)
        return height

    def seen(self, view):
        """The height that a view shows at each pixel, and whether it is a roof or the ground, not a wall."""
        row, column = np.indices((ROWS, COLUMNS)).astype(np.float64)
        level, wall = (np.full((ROWS, COLUMNS), -np.inf) for _ in range(2))
        for height in {DATUM, *(DATUM + self.boxes[:, 4])}:
            there = self.heights(row, column - view * (height - DATUM)) == height
            level = np.where(there, np.maximum(level, height), level)
        for first, last, left, right, top in self.boxes:
            for edge in (left, right):
                height = DATUM + (column - edge) / view
                meets = (row >= first) & (row < last) & (height > DATUM) & (height < DATUM + top)
                wall = np.where(meets, np.maximum(wall, height), wall)
        return np.maximum(level, wall), level >= wall


def hills(row, column):
    """Smooth relief of 12 m in all directions."""
    waves = ((3.0, 0.055, 0.3), (2.0, 0.09, 1.9), (1.0, 0.15, 1.2))
    return DATUM + sum(size * np.sin(rate * (np.cos(way) * column + np.sin(way) * row)) for size, rate, way in waves)


def plane(row, column):
    return DATUM + 0.02 * column + 0.05 * row


def seen_of(heights_at, view):
    """The height that a view shows of gentle ground at each pixel."""
    row, column = np.indices((ROWS, COLUMNS)).astype(np.float64)
    height = np.full(row.shape, DATUM)
    for _ in range(60):
        height = heights_at(row, column - view * (height - DATUM))
    return height


def run_of(folder, height, views=VIEWS):
    """A run that shows true heights, and the files of its cameras."""
    disparity = (views[1] - views[0]) * (height - DATUM)
    bands = np.stack([disparity, disparity - 1, disparity + 1, np.ones_like(disparity)]).astype(np.float32)
    out = write_run(folder, bands, np.zeros(disparity.shape, np.uint16))
    files = cameras(folder, ROWS, COLUMNS, views=views)
    return out, files, disparity


def truth_of(out, files, path, is_points=False, vertical=None, crs=None, **options):
    given = Reference(path, is_points, vertical or Vertical(ellipsoid=True), crs)
    set_geometry(out, *files)
    report = make_truth(out, given, **options)
    with rasterio.open(out / "truth.tif") as dataset:
        return dataset.read(1), report


@pytest.mark.parametrize("views", [VIEWS, (-0.15, 0.15), (0.2, 1.4)])
def test_make_truth__of_a_town_is_exact_where_it_is_seen(tmp_path, views):
    town, finer = Town(), 8
    height, is_level = town.seen(views[0])
    out, files, disparity = run_of(tmp_path, height, views)
    reference = write_heights(tmp_path / "reference.tif", on_ground(town.heights, finer), finer)
    truth, report = truth_of(out, files, reference, registers=False)
    known = np.isfinite(truth)
    error = np.abs(truth - disparity)
    assert known[is_level].mean() > 0.98  # beside edges, a cell of the reference is a wall
    assert known[~is_level].mean() < 0.05
    assert (error[known & is_level] > 0.02).mean() < 0.001
    assert np.median(error[known & is_level]) < 1e-3
    assert report["pixels"] == known.sum()
    assert report["row_misfit"][1] < 1e-3
    # Hidden ground: cells whose line of sight to the left view meets a higher roof or wall on its way.
    row, column = np.indices((ROWS, COLUMNS)).astype(np.float64)
    ground = town.heights(row, column)
    place = np.rint(column + views[0] * (ground - DATUM)).astype(int)
    inside = (place >= 0) & (place < COLUMNS)
    row, place, ground = row[inside].astype(int), place[inside], ground[inside]
    hidden = height[row, place] > ground + 0.5
    there = truth[row, place]
    taken = np.abs(there - (views[1] - views[0]) * (ground - DATUM)) < 0.1
    assert hidden.sum() > 500
    assert taken[hidden].mean() <= 0.002


@pytest.mark.parametrize("views", [VIEWS, (-0.15, 0.15), (0.2, 1.4)])
def test_make_truth__of_relief_is_exact(tmp_path, views):
    out, files, disparity = run_of(tmp_path, seen_of(hills, views[0]), views)
    truth, report = truth_of(out, files, write_heights(tmp_path / "hills.tif", on_ground(hills, 2), 2), registers=False)
    assert np.isfinite(truth).all()
    assert np.abs(truth - disparity).max() < 0.02
    assert report["correlation"] > 0.999


def moved(folder, shift, heights_at, name="moved.tif"):
    """Heights that have to be moved by a shift in metres (easting, northing, height) to be where they belong."""
    row, column = shift[1] / PIXEL, -shift[0] / PIXEL
    return write_heights(folder / name, on_ground(lambda r, c: heights_at(r - row, c - column) - shift[2], 2), 2)


def test_make_truth__finds_and_removes_a_shift_on_relief(tmp_path):
    shift = (3.0, -2.0, 5.0)
    out, files, disparity = run_of(tmp_path, seen_of(hills, VIEWS[0]))
    truth, report = truth_of(out, files, moved(tmp_path, shift, hills))
    found = report["registration"]
    assert found["is_horizontal"]
    # the map is UTM, whose north is 1.1 degrees from that of the cameras here
    np.testing.assert_allclose(found["shift"], shift, atol=0.1)
    assert max(found["deviation"]) < 0.2
    assert found["before"]["median"] == pytest.approx(5, abs=0.5)
    assert found["after"]["nmad"] < 0.05 < found["before"]["nmad"]
    assert np.nanpercentile(np.abs(truth - disparity), 99) < 0.05


def test_make_truth__on_a_plane_moves_the_height_alone(tmp_path):
    out, files, disparity = run_of(tmp_path, seen_of(plane, VIEWS[0]))
    truth, report = truth_of(out, files, moved(tmp_path, (0.0, 0.0, 5.0), plane))
    found = report["registration"]
    assert not found["is_horizontal"]
    assert found["shift"][:2] == [0, 0]
    assert found["shift"][2] == pytest.approx(5, abs=0.02)
    assert np.nanmax(np.abs(truth - disparity)) < 0.05


def test_make_truth__does_not_depend_on_tiles_or_the_search_range(tmp_path, monkeypatch):
    height = seen_of(lambda row, column: hills(row, column) + 40, VIEWS[0])  # far outside the range of the run
    out, files, _ = run_of(tmp_path, height)
    reference = write_heights(tmp_path / "high.tif", on_ground(lambda row, column: hills(row, column) + 40))
    whole, report = truth_of(out, files, reference, registers=False)
    assert report["outside_range"] == 1
    monkeypatch.setattr("sat_intervals.heights.raster_visibility._TILE", 32)
    monkeypatch.setattr("sat_intervals.raster.heightfield._BLOCK", 37)
    tiled, _ = truth_of(out, files, reference, registers=False)
    np.testing.assert_allclose(tiled, whole, atol=1e-4)
    assert np.isfinite(whole).mean() > 0.9


def test_make_truth__adds_the_geoid(tmp_path):
    out, files, disparity = run_of(tmp_path, seen_of(hills, VIEWS[0]))
    reference = write_heights(tmp_path / "above.tif", on_ground(lambda r, c: hills(r, c) - 47.5, 2), 2)
    vertical = Vertical(geoid=write_geoid(tmp_path / "geoid.tif", 47.5))
    truth, _ = truth_of(out, files, reference, vertical=vertical, registers=False)
    assert np.abs(truth - disparity).max() < 0.02


def places(heights_at, count, seed=0):
    """Longitude, latitude and height of random points of the ground."""
    random = np.random.default_rng(seed)
    row, column = random.uniform(0, ROWS, count), random.uniform(0, COLUMNS, count)
    return np.column_stack([LONGITUDE + column * PIXEL / EAST, LATITUDE - row * PIXEL / NORTH, heights_at(row, column)])


def write_csv(path, points, names=("Longitude", "latitude", "h_mean")):
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows([names, *points.tolist()])
    return path


def write_las(path, points):
    import laspy
    import pyproj

    x, y = MAP.place(points[:, 0], points[:, 1])
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = [np.floor(x.min()), np.floor(y.min()), 0], [1e-3] * 3
    header.add_crs(pyproj.CRS("EPSG:32631"))
    file = laspy.LasData(header)
    noise = [x[:1], y[:1], points[:1, 2] + 500]  # of class 7, to be left out
    file.x, file.y, file.z = (np.append(axis, more) for axis, more in zip((x, y, points[:, 2]), noise, strict=True))
    file.classification = np.append(np.full(len(points), 2), 7)
    file.write(path)
    return path


def write_vectors(path, points):
    import pyogrio
    import shapely

    geometry = shapely.to_wkb(shapely.points(points))
    pyogrio.raw.write(path, geometry, [], [], geometry_type="Point Z", crs="EPSG:4326", driver="GPKG")
    return path


@pytest.mark.peer("laspy", "pyogrio", "shapely")
def test_make_truth__points_of_all_files_give_their_disparities(tmp_path):
    out, files, disparity = run_of(tmp_path, seen_of(hills, VIEWS[0]))
    points = places(hills, 1500)
    truths = {}
    for path in (
        write_csv(tmp_path / "p.csv", points), write_las(tmp_path / "p.las", points),
        write_las(tmp_path / "p.laz", points), write_vectors(tmp_path / "p.gpkg", points),
    ):  # fmt: skip
        truth, report = truth_of(out, files, path, is_points=True, registers=False)
        known = np.isfinite(truth)
        assert 1300 < known.sum() <= 1500, path
        # the ground of a point is up to half a pixel from that of the pixel's centre
        assert np.abs(truth - disparity)[known].max() < 0.25
        assert np.median(np.abs(truth - disparity)[known]) < 0.05
        assert report["correlation"] > 0.99
        truths[path.suffix] = truth
    for truth in truths.values():
        assert np.nanmax(np.abs(truth - truths[".csv"])) < 0.01


def test_make_truth__leaves_out_points_that_are_not_on_the_ground(tmp_path):
    out, files, _ = run_of(tmp_path, seen_of(hills, VIEWS[0]))
    points = places(hills, 200)
    truth, _ = truth_of(out, files, write_csv(tmp_path / "p.csv", points), is_points=True, registers=False)
    for height in (-9999.0, -32767.0, 99999.0, 3.4e38):
        points = np.vstack([points, [*(points[0, :2] + 1e-6), height]])
    again, _ = truth_of(out, files, write_csv(tmp_path / "q.csv", points), is_points=True, registers=False)
    np.testing.assert_array_equal(again, truth)


def test_make_truth__points_on_pixel_centres_are_exact_and_hidden_ones_are_left_out(tmp_path):
    town = Town()
    height, is_level = town.seen(VIEWS[0])
    out, files, disparity = run_of(tmp_path, height)
    row, column = np.indices((ROWS, COLUMNS)).astype(np.float64)
    ground = town.heights(row, column)  # of every column, seen or hidden
    points = np.stack([LONGITUDE + column * PIXEL / EAST, LATITUDE - row * PIXEL / NORTH, ground], axis=-1)
    file = write_csv(tmp_path / "p.csv", points.reshape(-1, 3))
    truth, _ = truth_of(out, files, file, is_points=True, registers=False)
    seen = np.isfinite(truth) & is_level
    assert np.isfinite(truth).mean() > 0.7
    # a point at an edge may fall in the pixel beyond it
    assert (np.abs(truth - disparity)[seen] > 0.1).mean() <= 0.003


def test_make_truth__registers_points(tmp_path):
    out, files, _ = run_of(tmp_path, seen_of(hills, VIEWS[0]))
    points = places(hills, 4000)
    points -= np.array([3 / EAST, -2 / NORTH, 5.0])
    _, report = truth_of(out, files, write_csv(tmp_path / "p.csv", points), is_points=True)
    found = report["registration"]
    assert found["is_horizontal"]
    np.testing.assert_allclose(found["shift"], (3, -2, 5), atol=0.1)


@pytest.fixture(scope="module")
def relief(tmp_path_factory):
    """A run on relief whose images lie in its folder, as those of `surface`, the files of its cameras, a reference."""
    folder = tmp_path_factory.mktemp("relief")
    out, files, _ = run_of(folder, seen_of(hills, VIEWS[0]))
    report = json.loads((out / "run.json").read_text())
    report["inputs"]["left"]["path"] = str(out / "left.tif")
    report["inputs"]["left"]["sha256"] = 64 * "0"
    (out / "run.json").write_text(json.dumps(report))
    return out, files, write_heights(folder / "hills.tif", on_ground(hills))


def test_reference_command__writes_a_truth_for_evaluate_and_calibrate(relief):
    out, files, reference = relief
    words = "reference", out, "--heights", reference, "--ellipsoid", *sensor_words(files)
    result = invoke(*words)
    assert result.exit_code == 0, result.output
    assert "reference not moved: its shift is less than two standard deviations" in result.output
    assert f"{ROWS * COLUMNS} pixels with a true disparity (100.0 %), 0.0 % of them outside" in result.output
    assert result.output.splitlines()[-1] == str(out / "truth.tif")
    figures = json.loads(invoke(*words, "--json").stdout)
    assert (figures["pixels"], figures["share"], figures["outside_range"]) == (ROWS * COLUMNS, 1.0, 0.0)
    assert max(map(abs, figures["registration"]["shift"])) < 0.1
    with rasterio.open(out / "truth.tif") as truth:
        assert truth.tags()["LEFT_SHA256"] == 64 * "0"
    judged = invoke("evaluate", out, "--truth", out / "truth.tif")
    assert judged.exit_code == 0, judged.output
    assert judged.stdout.splitlines()[2].split()[2:4] == [str(ROWS * COLUMNS), "1.000"]


def test_reference_command__a_truth_of_another_window_is_refused(relief, tmp_path):
    out, files, reference = relief
    assert invoke("reference", out, "--heights", reference, "--ellipsoid", *sensor_words(files)).exit_code == 0
    other = tmp_path / "other"
    shutil.copytree(out, other)
    report = json.loads((other / "run.json").read_text())
    for side in report["inputs"].values():
        side["height"] += 10
    report["tiles"]["region"]["row"] += 10
    (other / "run.json").write_text(json.dumps(report))
    result = invoke("evaluate", other, "--truth", out / "truth.tif")
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert f"truth.tif is of rows 0 to {ROWS - 1}, columns 0 to {COLUMNS - 1}, {other} of rows 10 to" in result.stderr


def test_reference_command__what_it_cannot_use_gets_one_line(relief, tmp_path):
    out, files, reference = relief
    points = places(hills, 10)
    nothing = write_heights(tmp_path / "nothing.tif", on_ground(lambda r, c: hills(r, c) * np.nan))
    no_crs = write_heights(tmp_path / "no_crs.tif", on_ground(hills), crs=None)
    feet = write_heights(tmp_path / "lambert.tif", on_ground(hills), crs="EPSG:2154")
    geoid = write_heights(tmp_path / "geoid.tif", on_ground(hills), crs="EPSG:4326+5773")
    town = write_csv(tmp_path / "town.csv", points + np.array([5.0, 0, 0]))
    few = write_csv(tmp_path / "few.csv", points)
    broken = tmp_path / "broken.csv"
    broken.write_text("longitude,latitude,height\n1.45,43.6,north\n")
    nameless = write_csv(tmp_path / "nameless.csv", points, ("a", "b", "c"))
    metres = write_csv(tmp_path / "metres.csv", points, ("x", "y", "z"))
    ones = ["--heights", reference, "--ellipsoid"]
    swapped = [files[1], files[0], files[3], files[2]]
    for words, cameras_given, message in (
        ([], files, "give either --heights or --points"),
        ([*ones, "--geoid", reference], files, "--ellipsoid and --geoid exclude each other"),
        (["--heights", reference], files, "does not say what its heights refer to: give --ellipsoid, or the grid"),
        (["--heights", geoid], files, "has heights of EGM96 height: give the grid of this geoid with --geoid"),
        (["--heights", reference, "--geoid", tmp_path / "none.gtx"], files, "none.gtx: no such file"),
        (["--heights", no_crs, "--ellipsoid"], files, "no_crs.tif has no CRS: give it with --crs"),
        ([*ones, "--crs", "nonsense"], files, "nonsense is not a CRS known to PROJ"),
        (["--heights", feet, "--ellipsoid"], files, "give a reference of the same place"),
        (["--heights", feet, "--ellipsoid", "--no-register"], files, "no pixel of"),
        (["--heights", nothing, "--ellipsoid"], files, "give a reference of the same place"),
        (["--points", town, "--ellipsoid"], files, "give a reference of the same place"),
        (["--points", town, "--ellipsoid", "--no-register"], files, "no pixel of"),
        (["--points", few, "--ellipsoid"], files, "has fewer than 30 heights where"),
        (["--points", broken, "--ellipsoid"], files, "cannot be read as points: In CSV column #2: Row #2: CSV conv"),
        (["--points", nameless, "--ellipsoid"], files, "has the columns a, b, c: name them longitude, latitude, heig"),
        (["--points", metres, "--ellipsoid"], files, "metres.csv has no CRS: give it with --crs"),
        (["--points", tmp_path / "none.las", "--ellipsoid"], files, "none.las: no such file"),
        ([*ones, "--no-register"], swapped, "models and grids of left and right are swapped"),
        ([*ones, "--output", reference, "--overwrite"], files, "is an input"),
    ):
        result = invoke("reference", out, *words, *sensor_words(cameras_given))
        assert result.exit_code == 2, result.output
        assert message in result.stderr, (words, result.stderr)
        assert result.stderr.count("\n") == 1
    result = invoke("reference", out, "--points", few, "--ellipsoid", "--no-register", *sensor_words(files))
    assert result.exit_code == 0, result.output
    assert "10 pixels with a true disparity" in result.output


def test_reference_command__replaces_a_named_file_with_overwrite_only(relief, tmp_path):
    out, files, reference = relief
    mine = tmp_path / "mine.tif"
    mine.write_text("mine")
    given = ["--heights", reference, "--ellipsoid", "--no-register", "--output", mine, *sensor_words(files)]
    refused = invoke("reference", out, *given)
    assert (refused.exit_code, mine.read_text()) == (2, "mine")
    assert "mine.tif exists: choose another name or --overwrite" in refused.stderr
    assert invoke("reference", out, *given, "--overwrite").exit_code == 0


def test_reference_command__warns_of_another_datum(relief, tmp_path):
    out, files, _ = relief
    low = write_heights(tmp_path / "low.tif", on_ground(lambda row, column: hills(row, column) - 25))
    given = "--heights", low, "--ellipsoid", "--output", tmp_path / "t.tif", *sensor_words(files)
    result = invoke("reference", out, *given)
    assert result.exit_code == 0, result.stderr
    assert "differ by 25.0 m in the median, as heights above a geoid and heights above the elli" in result.stderr


def test_reference_command__a_surface_gives_the_disparities_of_its_run_back(shared_data, tmp_path):
    # a surface of the run itself is no truth, but must come back
    folder, out = shared_data / "dsm_picanteo", tmp_path / "out"
    files = sensor_words(folder / name for name in ("left.geom", "right.geom", "left_grid.tif", "right_grid.tif"))
    pair = folder / "left.tif", folder / "right.tif"
    for step in (
        ("match", *pair, out, "--disparity", -35, 18, "--quiet"),
        ("dsm", out, "--resolution", 0.5, *files),
        ("reference", out, "--heights", out / "dsm.tif"),
    ):
        result = invoke(*step)
        assert result.exit_code == 0, result.output
    with rasterio.open(out / "truth.tif") as truth, rasterio.open(out / "intervals.tif") as intervals:
        difference = truth.read(1) - intervals.read(1)
    assert np.isfinite(difference).mean() > 0.4
    assert abs(np.nanmedian(difference)) < 0.05
    assert np.nanmedian(np.abs(difference)) < 0.05
    # walls of surfaces of stereo stand too far to one side: they must not move the surface of another matcher
    compared = invoke("evaluate", "--dsm", out / "dsm.tif", "--reference", folder / "peer_dsm_mean_1m.tif", "--json")
    assert np.abs(json.loads(compared.stdout)["registration"]["shift"][:2]).max() < 0.2
