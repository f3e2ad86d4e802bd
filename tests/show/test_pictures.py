"""Pictures are written for any results: of the right size, not blank, with the right content."""

import re
import shutil
import sys

import numpy as np
import pytest
from finished import PLACE, no_bands, random_bands, without_intervals, write_file, write_run, write_surface
from helpers import invoke, write_pair
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

import sat_intervals
from sat_intervals import match_pair
from sat_intervals.demo import make_scene
from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.statistics import Tally
from sat_intervals.products import (
    FLAGS,
    INVALID,
    LEFT_WINDOW,
    MISMATCH,
    NOT_REFINED,
    OCCLUSION,
    RANGE_END,
    RANGE_INCOMPLETE,
    REGULARIZED,
    Bands,
)
from sat_intervals.raster import RUN_FILES, OutputWriter, read_layers, surface_file, write_layer
from sat_intervals.results import open_results
from sat_intervals.show import maps
from sat_intervals.show.cost_curve import read_curve
from sat_intervals.show.legend import ORANGE, PIXEL_CLASSES, SKY, VERMILION, class_counts, classify
from sat_intervals.show.maps import draw_errors, draw_overview
from sat_intervals.show.preparation import draw_rows
from sat_intervals.show.profile import draw_curve, draw_profile
from sat_intervals.show.relief import relief
from sat_intervals.show.surface_map import draw_surface
from sat_intervals.tiling import Window

WHITE, GREY = (255, 255, 255), (222, 222, 222)


@pytest.fixture(scope="module")
def scene():
    return make_scene(130, 170, seed=2)


@pytest.fixture(scope="module")
def run(scene, tmp_path_factory):
    """A matched procedural pair of 130 x 170 pixels, with its truth; settings without whole-image steps."""
    return matched(scene, tmp_path_factory.mktemp("run"), {"cross_check": None, "median": None, "regularization": None})


def matched(scene, folder, settings, window=None):
    settings = write_pair(folder, scene, **settings)
    match_pair(folder / "left.tif", folder / "right.tif", folder / "out", settings, window=window)
    return folder / "out"


def pixels_of(path):
    """A PNG file as ``(rows, columns, 3)``."""
    with Image.open(path) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB"))


def share_of(picture, colour):
    """Share of the pixels of a picture that have a colour, ``#rrggbb`` or three numbers."""
    if isinstance(colour, str):
        colour = tuple(bytes.fromhex(colour[1:]))
    return (picture == colour).all(axis=-1).mean()


def test_plot__makes_every_picture_and_names_it(run):
    arguments = ["plot", str(run), "--row", "60", "--columns", "20", "150", "--pixel", "60", "90", "--dpi", "50"]
    done = invoke(*arguments)
    assert done.exit_code == 0, done.output
    names = ["overview.png", "errors.png", "profile.png", "curve.png"]
    assert done.output.split() == [str(run / name) for name in names]
    for name in names:
        picture = pixels_of(run / name)
        assert picture.shape[0] > 200
        assert share_of(picture, WHITE) < 0.95
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def test_plot__without_truth_or_options_makes_the_overview_alone(tmp_path, unrendered):
    out = write_run(tmp_path, *random_bands(40, 50)[:2])
    done = invoke("plot", out)
    assert done.exit_code == 0, done.output
    assert sorted(path.name for path in out.glob("*.png")) == ["overview.png"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--columns", "1", "5"], "give --row too"),
        (["--row", "99"], "row 99, column 0 is outside the results in .*: rows are 0 to 39, columns 0 to 49"),
        (["--row", "3", "--columns", "7", "4"], "columns 7 to 4 are in the wrong order"),
        (["--row", "3", "--columns", "7", "50"], "column 50 is outside"),
        (["--pixel", "0", "-1"], "column -1 is outside"),
        (["--truth", "nowhere.tif"], "nowhere.tif cannot be read"),
    ],
)
def test_plot__says_in_one_line_what_is_wrong(tmp_path, arguments, message):
    out = write_run(tmp_path, *random_bands(40, 50)[:2])
    done = invoke("plot", out, *arguments)
    assert done.exit_code == 2
    assert re.fullmatch(f"sat-intervals: .*{message}.*\n", done.output)
    assert list(out.glob("*.png")) == []  # nothing is drawn before


def test_plot__without_matplotlib_says_what_to_install(tmp_path, monkeypatch):
    out = write_run(tmp_path, *random_bands(40, 50)[:2])
    monkeypatch.setattr(sat_intervals, "show", sat_intervals.show)  # restored, as its modules are
    for name in [name for name in sys.modules if name.startswith("sat_intervals.show")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    done = invoke("plot", out)
    assert done.exit_code == 2
    assert done.output == "sat-intervals: pictures need matplotlib: pip install 'sat-intervals[plot]'\n"


@pytest.mark.parametrize(
    ("bands", "shape"),
    [(random_bands, (1, 1)), (no_bands, (2, 300))],
)
def test_pictures__of_any_size_and_of_no_valid_pixel(tmp_path, bands, shape):
    made = bands(*shape)
    results = open_results(write_run(tmp_path, *made[:2], truth=np.full(shape, -3.0)))
    draw_overview(results, tmp_path / "overview.png", dpi=40)
    draw_errors(results, tmp_path / "errors.png", dpi=40)
    draw_profile(results, tmp_path / "profile.png", shape[0] // 2, dpi=40)
    for name in ("overview.png", "errors.png", "profile.png"):
        picture = pixels_of(tmp_path / name)
        assert min(picture.shape[:2]) >= 40 * 3
        assert max(picture.shape[:2]) <= 40 * 30
        assert 0.1 < share_of(picture, WHITE) < 0.97
    if bands is no_bands:
        assert share_of(pixels_of(tmp_path / "overview.png"), GREY) > 0.1
        assert share_of(pixels_of(tmp_path / "overview.png"), PIXEL_CLASSES[6].colour) > 0.03


def test_draw_overview__reads_no_more_than_it_draws(tmp_path, monkeypatch, unrendered):
    results = open_results(write_run(tmp_path, *random_bands(750, 450)[:2]))
    read, shapes = type(results).read_small, []

    def noting(self, shape):
        shapes.append(shape)
        return read(self, shape)

    monkeypatch.setattr(type(results), "read_small", noting)
    monkeypatch.setattr(type(results), "read", None)
    draw_overview(results, tmp_path / "overview.png", dpi=100)
    assert shapes == [(420, 252)]


def test_draw_overview__shows_every_kind_in_its_colour(tmp_path):
    validity = np.array([[kind.flag for kind in PIXEL_CLASSES]], np.uint16).repeat(40, axis=0).repeat(5, axis=1)
    bands = no_bands(*validity.shape)[0]
    draw_overview(open_results(write_run(tmp_path, bands, validity)), tmp_path / "overview.png", dpi=50)
    picture = pixels_of(tmp_path / "overview.png")
    shares = [share_of(picture, kind.colour) for kind in PIXEL_CLASSES if kind.colour != "#000000"]
    assert min(shares) > 0.005


def test_class_counts__agree_with_the_map():
    bands, validity, _ = random_bands(70, 90)
    validity |= np.random.default_rng(1).choice([0, *(flag.value for flag in FLAGS)], validity.shape).astype(np.uint16)
    bands[:3, validity & INVALID != 0] = np.nan
    tally = Tally(31)
    tally.add(Bands(*bands, validity))
    counts = tally.report()
    assert class_counts(counts) == np.bincount(classify(validity).ravel(), minlength=len(PIXEL_CLASSES)).tolist()
    assert counts["valid"] + sum(counts["causes"].values()) == validity.size < sum(counts["flags"].values())


def test_tally__winners_beside_missing_data_are_not_at_an_end_of_the_range():
    tally = Tally(31)
    flags = np.array([[RANGE_END, RANGE_END | RANGE_INCOMPLETE, RANGE_INCOMPLETE, 0]], np.uint16)
    tally.add(Bands(*np.zeros((4, 1, 4), np.float32), flags))
    assert tally.report()["range_ends"] == {"minimum": 1, "maximum": 0}


def test_draw_errors__colours_the_misses(tmp_path):
    bands, validity = no_bands(100, 100)
    bands[:3], validity[:] = np.array([0, -1, 1]).reshape(3, 1, 1), 0
    truth = np.zeros((100, 100))
    truth[10:20, 10:30] = 5  # 2 % above the interval
    truth[50:60, 50:60] = -5  # 1 % below it
    truth[80:, 80:] = np.nan
    results = open_results(write_run(tmp_path, bands, validity, truth))
    draw_errors(results, tmp_path / "errors.png")
    picture = pixels_of(tmp_path / "errors.png")[:-60]  # without its legend
    above, below = share_of(picture, VERMILION), share_of(picture, SKY)
    assert above / below == pytest.approx(2, rel=0.05)
    assert 0.015 < above < 0.02  # of a picture that is mostly map


def test_draw_profile__shows_a_pixel_that_stands_alone(tmp_path):
    bands, validity = no_bands(9, 60)
    bands[:, 4, 30], validity[4, 30] = (0, -4, 4, 1), 0
    results = open_results(write_run(tmp_path, bands, validity))
    pictures = []
    for row in (4, 5):
        draw_profile(results, tmp_path / "profile.png", row, (20, 40))
        pictures.append(pixels_of(tmp_path / "profile.png"))
    difference = (pictures[0] != pictures[1]).any(axis=-1).mean()
    assert 1 / 21 / 3 < difference < 0.4


@pytest.fixture
def words(monkeypatch):
    """Labels of legends, titles of pages and maps, and names of axes, as they are given."""
    texts = []

    def noting(thing, name):
        original = getattr(thing, name)
        monkeypatch.setattr(thing, name, lambda self, *a, **more: texts.append(str(a[0])) or original(self, *a, **more))

    for thing, name in (
        (Artist, "set_label"),
        (Figure, "suptitle"),
        *((Axes, name) for name in ("set_title", "set_xlabel", "set_ylabel")),
    ):
        noting(thing, name)
    return texts


def test_plot__without_intervals_claims_none(tmp_path, words, unrendered):
    out = without_intervals(tmp_path)
    done = invoke("plot", out, "--row", "20")
    assert done.output.split() == [str(out / "overview.png"), str(out / "profile.png")]
    assert {"truth", "disparity"} < set(words)
    assert "interval" not in words
    assert "Row 20, columns 0 to 49; gaps: invalid pixels" in words


@pytest.mark.parametrize(
    ("shape", "agreement", "last"),
    [((40, 60), np.nan, "Confidence"), ((1, 5), 1.0, "Agreement of runs")],
)
def test_plot__draws_the_surface_of_a_run(tmp_path, monkeypatch, words, shape, agreement, last):
    monkeypatch.setattr(maps, "draw_overview", lambda results, path, dpi: path.write_bytes(b"drawn"))
    out = write_run(tmp_path, *random_bands(20, 20)[:2])
    height = np.add.outer(np.arange(shape[0]), np.arange(shape[1])) / 10
    height[:, 3] = np.nan
    write_surface(out, height, agreement)
    done = invoke("plot", out, "--dpi", "40")
    assert done.output.split() == [str(out / "overview.png"), str(out / "dsm.png")]
    titles = ["Hillshade, sun in the north-west; hatched: no data", "Height", "Half width of the interval", last]
    assert [word for word in words if word in titles][-4:] == titles
    assert len(np.unique(pixels_of(out / "dsm.png").reshape(-1, 3), axis=0)) > 20


def test_plot__draws_no_surface_of_an_earlier_run_and_none_that_is_no_surface(tmp_path, unrendered):
    out = write_run(tmp_path, *random_bands(20, 20)[:2])
    write_surface(out, np.ones((20, 20)), runs="earlier")
    done = invoke("plot", out, "--dpi", "40")
    assert done.exit_code == 0, done.output
    said = f"{out / 'dsm.tif'} is of another run and is left out: rerun sat-intervals dsm\n"
    assert done.stderr == f"warning: {said}"
    assert not (out / "dsm.png").exists()
    shutil.copy(out / "validity.tif", tmp_path / "dsm.tif")
    with pytest.raises(SatIntervalsError, match=r"dsm\.tif is not a surface model of sat-intervals dsm"):
        draw_surface(tmp_path / "dsm.tif", tmp_path / "dsm.png")


@pytest.mark.parametrize("name", ["overview.png", "errors.png"])
def test_plot__keeps_the_mask_that_it_is_given(run, name):
    (run / name).write_text("mine")
    done = invoke("plot", run, "--mask", run / name)
    assert (done.exit_code, f"{name} is an input" in done.stderr) == (2, True)
    assert (run / name).read_text() == "mine"


def test_draw_surface__without_bounds(tmp_path, words, unrendered):
    height = np.add.outer(np.arange(20.0), np.arange(30.0))
    bands = np.stack([height, *[np.full(height.shape, np.nan)] * 2, *[np.ones(height.shape)] * 3]).astype(np.float32)
    write_file(tmp_path / "dsm.tif", surface_file("dsm.tif"), bands, PLACE)
    draw_surface(tmp_path / "dsm.tif", tmp_path / "dsm.png", dpi=40)
    assert "Height" in words


@pytest.mark.parametrize("shape", [(1300, 300), (300, 1300), (1300, 1300)])
def test_draw_surface__has_a_pixel_a_cell_and_no_data_is_white(tmp_path, monkeypatch, shape):
    found = []

    def measured(figure, file, dpi, **options):
        figure.set_dpi(dpi)
        figure.draw_without_rendering()
        box = figure.axes[0].get_window_extent()
        found.append(((box.height, box.width), [axes.patch for axes in figure.axes[:4]]))

    monkeypatch.setattr(Figure, "savefig", measured)
    height = np.add.outer(np.arange(shape[0]), np.arange(shape[1])).astype(np.float32)
    bands = np.stack([height, height - 1, height + 1, *[height * 0 + 0.5] * 3])
    write_file(tmp_path / "dsm.tif", surface_file("dsm.tif"), bands, PLACE)
    draw_surface(tmp_path / "dsm.tif", tmp_path / "dsm.png", dpi=30)
    ((size, patches),) = found
    assert (np.array(size) >= shape).all()
    assert all(patch.get_facecolor() == (1, 1, 1, 1) and patch.get_hatch() for patch in patches)


def test_relief__is_bright_where_it_faces_the_sun():
    rows, columns = np.indices((9, 9)) - 4.0
    pyramid = 4 - np.maximum(abs(rows), abs(columns))
    shade = relief(pyramid, 1.0, 1.0)
    north_west, south_east = shade[[1, 4], [4, 1]], shade[[7, 4], [4, 7]]
    flat = relief(np.zeros((9, 9)), 1.0, 1.0)
    assert np.allclose(flat, np.sqrt(0.5))
    assert (north_west > flat[0, 0]).all()
    assert (south_east < flat[0, 0]).all()
    pyramid[2, 2] = np.nan
    with_hole = relief(pyramid, 1.0, 1.0)
    assert (np.isnan(with_hole) == np.isnan(pyramid)).all()  # cells beside it have a shade


def test_draw_curve__tells_of_what_lies_outside_and_shows_what_has_no_width(run, tmp_path, words):
    out = shutil.copytree(run, tmp_path / "out")
    bands = read_layers(out / "intervals.tif")
    bands[1:3, 60, 90] = 1.0
    with OutputWriter(out, RUN_FILES, 130, 170, PLACE, {}) as writer:
        writer.write(0, bands, read_layers(out / "validity.tif")[0])
        writer.publish()
    write_layer(tmp_path / "far.tif", np.full((130, 170), 999.5, np.float32), np.nan, PLACE)
    draw_curve(open_results(out, tmp_path / "far.tif"), tmp_path / "curve.png", 60, 90)
    assert "truth 999.50 px, outside the range shown" in words
    assert "interval written, 1 to 1 px" in words
    orange = (pixels_of(tmp_path / "curve.png") == tuple(bytes.fromhex(ORANGE[1:]))).all(axis=-1)
    assert orange[400:].sum() > 5  # in the lower chart, not only in its legend


def test_draw_overview__scales_widths_to_a_percentile_beside_their_histogram(tmp_path, monkeypatch, words, unrendered):
    bands, validity = no_bands(100, 100)
    bands[:3], validity[:] = np.array([0, -1, 1]).reshape(3, 1, 1), 0
    bands[2, 60:85], bands[2, 95:] = 3, 10  # 70 % 2 px wide, 25 % 4 px, 5 % 11 px
    drawn = []
    stairs = Axes.stairs
    monkeypatch.setattr(Axes, "stairs", lambda self, *a, **more: drawn.append(a) or stairs(self, *a, **more))
    draw_overview(open_results(write_run(tmp_path, bands, validity)), tmp_path / "overview.png", dpi=50)
    assert {"px, square-root scale", "row", "column"} < set(words)
    ((shares, edges),) = drawn
    np.testing.assert_allclose(shares, [0.001, 0.001, 0.7, 0.001, 0.25])  # 0 to 1 px, 1 to 2 px and so on
    np.testing.assert_allclose(edges[:5], np.sqrt(np.arange(5) / 4))  # of the colours of the map: 4 px is the brightest


def test_draw_curve__says_why_the_interval_is_wider_than_the_cut(run, tmp_path, words, unrendered):
    curve = read_curve(open_results(run), 60, 90)
    inside = curve.disparities[curve.cut]
    assert (curve.lower, curve.upper) != (inside.min(), inside.max())
    draw_curve(open_results(run), tmp_path / "curve.png", 60, 90)
    assert f"interval, {curve.lower:g} to {curve.upper:g} px:\ncut pushed out by refinement" in words


def test_read_curve__is_the_curve_of_the_run(run):
    results = open_results(run)
    bands = results.read(Window(0, 0, *results.shape))
    # the overlap of 100 pixels around these holds the whole image, as the run's one tile did
    for row, column in [(60, 90), (30, 80), (99, 71), (64, 100)]:
        curve = read_curve(results, row, column)
        assert curve.lower == bands.lower[row, column]
        assert curve.upper == bands.upper[row, column]
        assert np.float32(curve.disparity) == bands.disparity[row, column]
        assert np.nanmax(curve.possibilities) == 1
        inside = (curve.disparities >= curve.lower) & (curve.disparities <= curve.upper)
        assert curve.cut.any()
        assert inside[curve.cut].all()


def test_read_curve__of_a_window_of_the_images(scene, tmp_path, run):
    window = Window(20, 30, 100, 120)
    part = open_results(matched(scene, tmp_path, {"median": None, "regularization": None}, window))
    whole = read_curve(open_results(run), 64, 90)
    curve = read_curve(part, 64 - window.row, 90 - window.column)
    np.testing.assert_array_equal(curve.costs, whole.costs)
    pixel, same = part.read_pixel(44, 60), open_results(run).read_pixel(64, 90)
    assert (pixel.image, pixel.truth) == (same.image, same.truth)


def test_draw_curve__without_sgm_interval_and_truth(scene, tmp_path):
    settings = {"sgm": None, "interval": None, "regularization": None, "ambiguity": None}
    out = matched(scene, tmp_path, settings)
    (tmp_path / "truth.tif").unlink()
    draw_curve(open_results(out), tmp_path / "curve.png", 60, 90, dpi=50)
    assert share_of(pixels_of(tmp_path / "curve.png"), WHITE) < 0.99


def test_draw_curve__of_a_pixel_without_candidate_says_why(run, tmp_path):
    with pytest.raises(SatIntervalsError, match=r"row 0, column 0 has no cost curve: .*border.*: choose a pixel"):
        draw_curve(open_results(run), tmp_path / "curve.png", 0, 0)


def test_draw_rows__colours_are_those_of_most_places(tmp_path, monkeypatch, unrendered):
    random, limits = np.random.default_rng(0), []
    offsets = np.append(random.normal(1.2, 0.1, 20), [15.1, -14.7])
    places = np.stack([random.uniform(0, 60, 22), random.uniform(0, 80, 22), offsets, offsets - 1.2], axis=1)
    out = write_run(tmp_path, *random_bands(60, 80))
    rows = {"before": [1.2, 1.4], "after": [0.1, 13.0], "samples": places.tolist()}
    results = open_results(out)
    results.report["survey"] = {"rows": rows}
    scatter = Axes.scatter
    monkeypatch.setattr(Axes, "scatter", lambda *all_, **how: limits.append(how["vmax"]) or scatter(*all_, **how))
    draw_rows(results, tmp_path / "rows.png")
    assert limits[0] == pytest.approx(1.3, abs=0.15)
    assert limits[1] == 0.5


def test_classify__takes_the_first_reason():
    validity = np.array([0, NOT_REFINED, REGULARIZED, MISMATCH | REGULARIZED, LEFT_WINDOW | OCCLUSION], np.uint16)
    meanings = [PIXEL_CLASSES[place].meaning for place in classify(validity)]
    assert meanings[:2] == ["valid, high confidence"] * 2
    assert meanings[2:] == ["valid, low confidence", FLAGS[7].meaning, FLAGS[0].meaning]


@pytest.mark.peer("shareloc")
def test_plot__of_many_images_draws_heights_only(swept, words):
    done = invoke("plot", swept)
    assert (done.exit_code, done.output.split()) == (0, [str(swept / "dsm.png")]), done.output
    assert "Height" in words
    assert not any(re.search(r"px|[Dd]isparit", text) for text in words)
    for option in (["--row", 3], ["--pixel", 3, 4], ["--beside", swept], ["--truth", swept / "dsm.tif"]):
        done = invoke("plot", swept, *option)
        assert done.exit_code == 2
        assert done.output.count("\n") == 1
        assert "3 images" in done.output
