"""Surface models from made-up points."""

import json
import shutil
import signal
import subprocess
import time
from itertools import count

import numpy as np
import pytest
import rasterio
from cameras import cameras, sensor_words
from finished import write_run
from helpers import COMMAND, invoke, refused, wait_until
from numpy.testing import assert_allclose, assert_array_equal
from pyproj import Transformer
from rasterio.shutil import copy
from rasterio.transform import Affine
from surfaces import write_geoid, write_raster

from sat_intervals import SatIntervalsError
from sat_intervals.config import load_calibration, load_height_calibration
from sat_intervals.heights.alignment import solved
from sat_intervals.heights.choices import BOUNDS, SurfaceChoices
from sat_intervals.heights.geometry import Geometry
from sat_intervals.heights.lattice import Lattice
from sat_intervals.kernels.registration import Registration
from sat_intervals.products import OPEN_ABOVE, RANGE_INCOMPLETE, SURFACE
from sat_intervals.raster import Projection, north_up, utm_of, write_layer
from sat_intervals.raster.projection import transformed
from sat_intervals.workflows.dsm import make_surface

TO_DEGREES = Transformer.from_crs("EPSG:32631", "EPSG:4326", always_xy=True)
BAND = {band.name: index for index, band in enumerate(SURFACE)}
LEFT, TOP = 370_000.0, 4_830_000.0
MICROSECONDS = count()
PIXEL, FAR = 4.0, 64.0  # metres of height in a pixel of disparity, and pixels at the ends of the lattice


@pytest.fixture(autouse=True)
def _made_up_points(monkeypatch, request):
    """Runs have the points of `write_points`, not those of models and grids."""
    if not request.node.get_closest_marker("peer"):
        monkeypatch.setattr("sat_intervals.heights.dsm.geometry_of", made_up)


def made_up(run, progress=None):
    nodes = np.load(run.out / "nodes.npy")
    fit = {"median_residual": 0.0, "lost": 0.0, "beyond": 0.0, "grid_step": 1.0}
    return Geometry(run, [], None, Lattice(nodes, (1.0, 1.0, 2.0 * FAR), run.region, -FAR), fit)


def write_points(folder, x, y, height, lower=1.0, upper=2.0, confidence=0.5, validity=0):
    """A run whose pixels are points at map places (metres from LEFT, TOP; y upwards), NaN height for none.

    All disparities are 0, and each pixel is a node of the lattice.
    """
    x, y, height = (np.atleast_2d(np.asarray(values, np.float64)) for values in (x, y, height))
    folder.mkdir(exist_ok=True)
    nothing = 0 * height
    confidence = np.broadcast_to(confidence, height.shape)
    layers = nothing, nothing - np.asarray(lower) / PIXEL, nothing + np.asarray(upper) / PIXEL, confidence
    out = write_run(folder, np.stack(layers).astype(np.float32), np.broadcast_to(np.uint16(validity), height.shape))
    report = json.loads((out / "run.json").read_text())
    report["finished"] = f"2026-11-21T12:00:00.{next(MICROSECONDS):06d}+00:00"  # it tells runs apart
    (out / "run.json").write_text(json.dumps(report))
    place = transformed(TO_DEGREES, LEFT + x, TOP + y)
    ends = [np.stack([*place, np.nan_to_num(height) + end * PIXEL, 0 * x], axis=-1) for end in (-FAR, FAR)]
    np.save(out / "nodes.npy", np.pad(np.stack(ends, axis=2), ((0, 1), (0, 1), (0, 0), (0, 0)), mode="edge"))
    return out


def surface_of(outs, tmp_path, **options):
    report = make_surface(outs, tmp_path / "dsm.tif", **{"resolution": 1.0, "crs": "EPSG:32631"} | options)
    with rasterio.open(tmp_path / "dsm.tif") as dataset:
        return dataset.read(), dataset.transform, report


def cell_of(place, x, y):
    """Row and column of the cell in which a map place falls."""
    return np.floor((y - place.f) / place.e).astype(int), np.floor((x - place.c) / place.a).astype(int)


def test_make_surface__fills_voids_flattens_and_masks(tmp_path):
    row, column = np.indices((40, 40))
    height = np.where((row % 9 > 5) & (column % 9 > 5), np.nan, 50.0)
    out = write_points(tmp_path / "a", column + 0.5, -row - 0.5, height)
    cells = write_raster(tmp_path / "lake.tif", (row // 10 == 1)[np.newaxis], Affine(1, 0, LEFT, 0, -1, TOP))
    plain, _, report = surface_of([out], tmp_path, radius=0.5)
    assert report["completed"] is None
    choices = SurfaceChoices(fill=9.0, flatten=cells, mask=cells)
    completed = surface_of([out], tmp_path, radius=0.5, choices=choices)[2]["completed"]
    assert {"masked": 400, "flattened": 0, "without_rim": 0}.items() <= completed.items()
    bands, _, report = surface_of([out], tmp_path, radius=0.5, choices=SurfaceChoices(fill=9.0, flatten=cells))
    inner = np.s_[:, 1:-5, 1:-5]
    assert np.isnan(plain[0][inner[1:]]).any()
    assert (bands[0][inner[1:]] == 50).all()
    assert set(np.unique(bands[BAND["count"]][inner[1:]])) == {0, 1}
    assert report["completed"]["flattened"] == 400
    assert report["completed"]["filled"] > 50
    with rasterio.open(tmp_path / "dsm.tif") as dataset:
        assert {"FILLED": "voids up to 9 m from their rims", "FLATTENED": "lake.tif"}.items() <= dataset.tags().items()
    result = invoke("dsm", out, "--resolution", 1, "--fill", "--fill-distance", 9, "--output", tmp_path / "new.tif")
    assert "cells filled from their rims: " in result.stdout
    refused(["dsm", out, "--resolution", 1, "--fill", "--fill-distance", 0], "fill is 0 m: give one above 0")
    refused(["dsm", out, "--resolution", 1, "--mask", cells, "--output", cells], "lake.tif")


def test_make_surface__worked_example(tmp_path):
    # Cells of 1 m, radius 0.6 m. Points at (0.5, -0.5) and (0.5, -0.9), heights 10 and 14: the first reaches cell
    # (0, 0) alone, from its centre; the second lies 0.4 m below that centre and 0.6 m above that of cell (1, 0).
    # Cell (0, 0): weights 1 and exp(-.08) = .92312; height (10 + .92312 x 14) / 1.92312 = 11.9200; bounds 9 and 16.
    # Cell (1, 0): the second point alone: 14, 13 to 16. Nothing reaches the point at (3.5, -0.5) but its own cell: 20.
    out = write_points(tmp_path / "a", [0.5, 0.5, 3.5, 9], [-0.5, -0.9, -0.5, 0], [10, 14, 20, np.nan])
    surface, place, report = surface_of([out], tmp_path, radius=0.6001)
    i, j = cell_of(place, LEFT, TOP)
    expected = {(0, 0): (11.92, 9, 16, 2), (1, 0): (14, 13, 16, 1), (0, 3): (20, 19, 22, 1), (1, 3): (np.nan,) * 4}
    for (row, column), values in expected.items():
        assert_allclose(surface[:4, i + row, j + column], values, atol=1e-4)
    assert_allclose(surface[BAND["confidence"], i, j], 0.5)
    assert np.isnan(surface[BAND["agreement"]]).all()
    assert (place.a, place.e, place.c % 1, place.f % 1) == (1, -1, 0, 0)
    assert report["points"] == 3
    assert report["filled"] == np.isfinite(surface[0]).mean()
    assert report["disagreeing"] is None


def test_make_surface__the_envelope_holds_every_point(tmp_path):
    random = np.random.default_rng(1)
    x, y = random.uniform(0, 9, (2, 20, 20))
    height = random.normal(100, 5, x.shape)
    out = write_points(tmp_path / "a", x, -y, height)
    wide, place, _ = surface_of([out], tmp_path, radius=1.0)
    row, column = cell_of(place, LEFT + x, TOP - y)
    assert (wide[1, row, column].astype(np.float64) <= height - 1).all()
    assert (wide[2, row, column].astype(np.float64) >= height + 2).all()
    filled = np.isfinite(wide[0])
    assert (wide[1] <= wide[0])[filled].all()
    assert (wide[0] <= wide[2])[filled].all()


def test_make_surface__a_point_reaches_the_cell_it_falls_in_at_any_radius(tmp_path):
    out = write_points(tmp_path / "a", [0.05, 5.9], [-0.05, -5.95], [10.0, 20.0], confidence=np.nan)
    surface, place, _ = surface_of([out], tmp_path, radius=0.1)
    row, column = cell_of(place, LEFT + np.array([0.05, 5.9]), TOP - np.array([0.05, 5.95]))
    assert_allclose(surface[0, row, column], [10, 20], atol=1e-4)
    assert np.isfinite(surface[0]).sum() == 2
    assert np.isnan(surface[BAND["confidence"]]).all()  # of a run without confidence


def test_make_surface__a_point_far_from_its_neighbours_does_not_stretch_it(tmp_path):
    x, y = np.meshgrid(np.arange(0.5, 40), -np.arange(0.5, 60))
    height = np.full(x.shape, 50.0)
    plain, place, _ = surface_of([write_points(tmp_path / "a", x, y, height)], tmp_path)
    height[11:15, 6:11], x[11:15, 6:11] = 150.0, -370.0  # wrong matches come in blobs
    wrong, moved, report = surface_of([write_points(tmp_path / "b", x, y, height)], tmp_path)
    assert (moved, wrong.shape) == (place, plain.shape)
    assert report["points"] == x.size - 20


def test_make_surface__leaves_out_points_beside_missing_data_without_confidence(tmp_path):
    x, y = np.meshgrid(np.arange(0.5, 12), -np.arange(0.5, 10))
    confidence, validity = np.full(x.shape, 0.5), np.zeros(x.shape, np.uint16)
    validity[7:], confidence[8], confidence[2, 4] = RANGE_INCOMPLETE, 0.0, 0.0
    out = write_points(tmp_path / "a", x, y, 0 * x + 30, confidence=confidence, validity=validity)
    surface, place, report = surface_of([out], tmp_path, radius=0.1)
    kept = np.arange(10) != 8
    row, column = cell_of(place, LEFT + x[kept], TOP + y[kept])
    assert np.isfinite(surface[0, row, column]).all()
    assert np.isfinite(surface[0]).sum() == row.size
    assert (report["border"], report["points"]) == (12, x.size - 12)


def test_make_surface__keeps_the_surface_whose_grid_it_takes(tmp_path):
    out = write_points(tmp_path / "a", [0.5, 3.5], [-0.5, -0.9], [10, 14])
    surface_of([out], tmp_path)
    with pytest.raises(SatIntervalsError, match=r"dsm.tif is an input, and .*dsm.tif would be written"):
        surface_of([out], tmp_path, resolution=tmp_path / "dsm.tif", crs=None)
    copy(tmp_path / "dsm.tif", tmp_path / "like.vrt", driver="VRT")
    with pytest.raises(SatIntervalsError, match=r"dsm.tif is an input, and .*dsm.tif would be written"):
        surface_of([out], tmp_path, resolution=tmp_path / "like.vrt", crs=None)


def test_make_surface__of_several_runs_is_their_mean_where_they_meet(tmp_path):
    # Three cells 10 m apart. One run says 9 to 12 in each, the other 10 to 13, 29.5 to 32, and nothing.
    one = write_points(tmp_path / "a", [0.5, 10.5, 20.5], [-0.5] * 3, [10.0] * 3, confidence=1.0)
    two = write_points(tmp_path / "b", [0.5, 10.5, 20.5], [-0.5] * 3, [11.0, 30.0, np.nan], [1, 0.5, 1], confidence=0.0)
    for outs in ([one, two], [two, one]):
        surface, place, report = surface_of(outs, tmp_path, radius=0.6)
        i, j = cell_of(place, LEFT, TOP)
        cells = surface[:, i, [j, j + 10, j + 20]]
        assert_allclose(cells[BAND["height_lower"]], [9.5, 9, 9], atol=1e-4)
        assert_allclose(cells[BAND["height_upper"]], [12.5, 32, 12], atol=1e-4)
        assert_allclose(cells[BAND["height"]], [10.5, 10, 10], atol=1e-4)
        assert_allclose(cells[BAND["confidence"]], [0.5, 0.5, 1.0], atol=1e-4)
        assert_array_equal(cells[BAND["count"]], [2, 2, 1])
        assert_array_equal(cells[BAND["agreement"]], [1, 0, np.nan])
        assert report["disagreeing"] == 0.5


def test_make_surface__of_several_runs_follows_the_narrow_intervals(tmp_path):
    # 9 to 12 around 10, weight 1 / 9; 10.5 to 11.5 around 11, weight 1. Middle (10.5 / 9 + 11) / (10 / 9) = 10.95;
    # width sqrt(2 / (10 / 9)) = 1.3416; height (10 / 9 + 11) / (10 / 9) = 10.9.
    one = write_points(tmp_path / "a", [0.5], [-0.5], [10.0])
    two = write_points(tmp_path / "b", [0.5], [-0.5], [11.0], lower=0.5, upper=0.5)
    surface, place, _ = surface_of([one, two], tmp_path, radius=0.6)
    i, j = cell_of(place, LEFT, TOP)
    assert_allclose(surface[:3, i, j], [10.9, 10.95 - 1.3416 / 2, 10.95 + 1.3416 / 2], atol=1e-4)


def test_make_surface__of_runs_that_are_apart_has_the_height_with_a_third_of_the_weights_below(tmp_path):
    random = np.random.default_rng(4)
    x, y = np.meshgrid(np.arange(0.5, 30), -np.arange(0.5, 20))
    heights, halves = random.uniform(0, 60, (3, *x.shape)), random.uniform(0.5, 4, (3, *x.shape))
    given = zip(heights, halves, halves, strict=True)
    runs = [write_points(tmp_path / str(number), x, y, *one) for number, one in enumerate(given)]
    surface, place, report = surface_of(runs, tmp_path, radius=0.1, choices=SurfaceChoices(aligns=False))
    i, j = cell_of(place, LEFT + x, TOP + y)
    apart = np.ptp(heights, axis=0) > 2
    order = heights.argsort(axis=0)
    upto = np.take_along_axis(1 / halves, order, axis=0).cumsum(axis=0)
    lowest = np.take_along_axis(heights, order, axis=0)
    expected = np.where(upto[0] >= upto[2] / 3, lowest[0], np.where(upto[1] >= upto[2] / 3, lowest[1], lowest[2]))
    assert apart.mean() > 0.9
    assert_allclose(surface[BAND["height"], i, j][apart], expected[apart], atol=1e-3)
    assert report["shifts"] == []


def test_make_surface__of_heights_apart_whose_intervals_meet_contains_the_one_that_is_taken(tmp_path):
    # 2 to 18 around 10, and 16 to 24 around 20: the low one has 1/16 of 3/16 of the weights, a third.
    one = write_points(tmp_path / "a", [0.5], [-0.5], [10.0], lower=8, upper=8)
    two = write_points(tmp_path / "b", [0.5], [-0.5], [20.0], lower=4, upper=4)
    surface, place, _ = surface_of([one, two], tmp_path, radius=0.6)
    i, j = cell_of(place, LEFT, TOP)
    middle, half = (10 / 16**2 + 20 / 8**2) / (1 / 16**2 + 1 / 8**2), (2 / (1 / 16**2 + 1 / 8**2)) ** 0.5 / 2
    assert_allclose(surface[:3, i, j], [10, min(10, middle - half), middle + half], atol=1e-4)


def registration(shift, deviation):
    return Registration(np.array(shift), np.array(deviation), True, 99, np.zeros(1), np.zeros(1))


def test_solved__shifts_of_a_chain_and_what_is_not_linked():
    step = registration([1.0, 0, 2], [0.1, np.nan, 0.0])
    shifts, deviations = solved({(0, 1): step, (1, 2): step}, 3, has_reference=False)
    assert_allclose(shifts, [[-1, 0, -2], [0, 0, 0], [1, 0, 2]], atol=1e-6)
    assert np.isfinite(deviations[:, [0, 2]]).all()
    assert np.isnan(deviations[:, 1]).all()
    shifts, deviations = solved({(0, 1): step, (1, 2): step}, 3, has_reference=True)
    assert_allclose(shifts, [[-2, 0, -4], [-1, 0, -2], [0, 0, 0]], atol=1e-6)
    apart = {(0, 1): step, (2, 3): step}
    shifts, deviations = solved(apart, 4, has_reference=False)
    assert_allclose(shifts[:, 0], [-0.5, 0.5, -0.5, 0.5], atol=1e-6)
    assert np.isnan(deviations).all()  # nobody knows how far the two are from the others
    assert np.isfinite(solved(apart, 4, has_reference=True)[1][:, 0]).tolist() == [False, False, True, True]


def test_make_surface__refuses_a_reference_that_says_nothing(tmp_path):
    x, y = np.meshgrid(np.arange(0.5, 40), -np.arange(0.5, 40))
    out = write_points(tmp_path / "a", x, y, 500 + 3 * np.sin(0.3 * x) + 2 * np.cos(0.4 * y))
    _, place, _ = surface_of([out], tmp_path)

    def reference(name, heights, left=place.c, crs="EPSG:32631"):
        write_layer(tmp_path / name, heights, np.nan, north_up(crs, left, place.f, 1.0))
        return SurfaceChoices(reference=tmp_path / name)

    for choices, message in (
        (reference("elsewhere.tif", np.full((40, 40), 500.0), left=place.c + 9000), "has no ground with .*elsewhere"),
        (reference("feet.tif", np.full((60, 60), 1640.0)), "differ by 114. m in height: check that both are metres"),
        (SurfaceChoices(reference=tmp_path / "none.tif"), "none.tif"),
    ):
        with pytest.raises(SatIntervalsError, match=message):
            surface_of([out], tmp_path / "new", choices=choices)
    with pytest.raises(SatIntervalsError, match="runs are moved onto a reference"):
        SurfaceChoices(aligns=False, reference=tmp_path / "elsewhere.tif")


def test_make_surface__moves_runs_onto_each_other_or_a_reference(tmp_path):
    x, y = np.meshgrid(np.arange(0.5, 90, 0.5), -np.arange(0.5, 80, 0.5))

    def ground(x, y):
        hills = 6 * np.sin(0.11 * x + 0.03 * y) + 5 * np.cos(0.08 * y - 0.02 * x)
        return 500 + hills + 4 * np.sin(0.23 * x - 0.17 * y) + 3 * np.cos(0.29 * y + 0.07 * x)

    # where the runs say that a place is, and what is there
    off = np.array([[0.9, -1.2, 0.4], [-0.3, 0.6, -1.0], [-0.6, 0.6, 0.6]])
    random = np.random.default_rng(1)
    runs = [
        write_points(tmp_path / name, x + east, y + north, ground(x, y) + up + random.normal(0, 0.1, x.shape))
        for name, (east, north, up) in zip("abc", off, strict=True)
    ]
    surface, place, report = surface_of(runs, tmp_path, radius=0.8)
    found = np.array([one["shift"] for one in report["shifts"]])
    assert_allclose(found, -off, atol=0.15)
    assert all(0 < deviation < 0.1 for one in report["shifts"] for deviation in one["deviation"])
    assert report["disagreeing"] < 0.01
    _, _, plain = surface_of(runs, tmp_path, radius=0.8, choices=SurfaceChoices(aligns=False))
    assert plain["shifts"] == []
    assert plain["disagreeing"] > 0.02
    with rasterio.open(tmp_path / "dsm.tif") as dataset:
        assert dataset.tags()["ALIGNED"] == "no"
    row, column = np.indices(surface.shape[1:]) + 0.5
    heights = ground(place.c + column - LEFT, place.f - row - TOP) + 3
    write_layer(tmp_path / "reference.tif", heights, np.nan, north_up("EPSG:32631", place.c, place.f, 1.0))
    choices = SurfaceChoices(reference=tmp_path / "reference.tif")
    _, _, moved = surface_of(runs, tmp_path, radius=0.8, choices=choices)
    assert_allclose([one["shift"] for one in moved["shifts"]], -off + [0, 0, 3], atol=0.15)


def test_make_surface__does_not_depend_on_its_tiles(tmp_path, monkeypatch):
    random = np.random.default_rng(2)
    x, y = random.uniform(0, 40, (2, 12, 12))
    out = write_points(tmp_path / "a", x, -y, random.normal(100, 5, x.shape))
    (tmp_path / "heights.yaml").write_text(CALIBRATION.replace("0.6 m", "1 m"))
    choices = SurfaceChoices(calibration=load_height_calibration(tmp_path / "heights.yaml"))
    whole, place, _ = surface_of([with_coverage(out)], tmp_path, choices=choices)
    assert np.unique(np.round(whole[2] - whole[0], 2)).size > 3  # margins of all classes
    monkeypatch.setattr("sat_intervals.heights.lattice.WINDOW", 7)
    monkeypatch.setattr("sat_intervals.heights.point_cloud.WINDOW", 5)
    monkeypatch.setattr("sat_intervals.heights.cells._TILE", 20)
    for name in ("run.parts", "raster.blocks", "raster.cog"):
        monkeypatch.setattr(f"sat_intervals.{name}.BLOCK", 16)
    tiled, same_place, _ = surface_of([out], tmp_path, choices=choices)
    assert place == same_place
    assert_allclose(tiled, whole, atol=1e-4)
    assert_array_equal(tiled[3], whole[3])


def with_settings(out, **settings):
    """Change settings in the report of a run."""
    report = json.loads((out / "run.json").read_text())
    report["settings"] |= settings
    (out / "run.json").write_text(json.dumps(report))
    return out


def with_coverage(out, calibration=None):
    interval = {"alpha": None, "coverage": 0.9, "calibration": calibration}
    return with_settings(out, interval=interval)


@pytest.mark.parametrize(("bounds", "expected"), [("envelope", (0, 40)), ("quantiles", (0.9, 16.15))])
def test_make_surface__bounds_of_a_cell_worked_example(tmp_path, bounds, expected):
    # Four points at the centre of a cell, of height 10, 11, 11 and 12 (mean 11): 0 to 40, 9.5 to 12.5, 9 to 11, 1 to
    # 13.5. Sorted lower bounds 0, 1, 9, 9.5; upper bounds 11, 12.5, 13.5, 40.
    height = np.array([10.0, 11, 11, 12])
    lower, upper = height - [0, 9.5, 9, 1], np.array([40, 12.5, 11, 13.5]) - height
    out = write_points(tmp_path / "a", [0.5] * 4, [-0.5] * 4, height, lower=[lower], upper=[upper])
    surface, place, _ = surface_of([out], tmp_path, radius=0.6, choices=SurfaceChoices(bounds=bounds))
    i, j = cell_of(place, LEFT, TOP)
    assert_allclose(surface[:3, i, j], (11, *expected), atol=1e-4)


def test_make_surface__heights_do_not_depend_on_the_bounds(tmp_path, monkeypatch):
    random = np.random.default_rng(1)
    x, y = random.uniform(0, 6, (2, 14, 14))
    out = write_points(tmp_path / "a", x, -y, random.normal(100, 5, x.shape))
    wide, _, _ = surface_of([out], tmp_path)
    narrow, _, _ = surface_of([out], tmp_path, choices=SurfaceChoices(bounds="quantiles"))
    assert_array_equal(narrow[0], wide[0])
    filled = np.isfinite(wide[0])
    for smaller, larger in ((wide[1], narrow[1]), (narrow[1], narrow[0]), (narrow[0], narrow[2]), (narrow[2], wide[2])):
        assert (smaller <= larger)[filled].all()
    monkeypatch.setattr("sat_intervals.heights.cells._LISTED", 100)  # small tiles
    tiled, _, _ = surface_of([out], tmp_path, choices=SurfaceChoices(bounds="quantiles"))
    assert_allclose(tiled, narrow, atol=1e-4)


def test_make_surface__a_coverage_means_quantiles_without_open_points(tmp_path):
    validity = [[0, 0, OPEN_ABOVE]]
    out = write_points(tmp_path / "a", [0.5] * 3, [-0.5] * 3, [10.0, 14.0, 30.0], validity=validity)
    before, place, report = surface_of([out], tmp_path, radius=0.6)
    i, j = cell_of(place, LEFT, TOP)
    assert_allclose(before[:4, i, j], [18, 9, 32, 3])
    assert (report["bounds"], report["open"]) == ("envelope", 0)
    surface, _, report = surface_of([with_coverage(out)], tmp_path, radius=0.6)
    assert_allclose(surface[:4, i, j], [12, 10.2, 14.8, 2])
    assert (report["bounds"], report["open"], report["median_half_width"]) == ("quantiles", 1, pytest.approx(2.3))


def test_make_surface__outliers_are_left_out_and_counted(tmp_path):
    x, y = np.meshgrid(np.arange(9) + 0.5, np.arange(9) + 0.5)
    height = 10 + x
    height[4, 4] = 60
    out = write_points(tmp_path / "a", x, -y, height)
    surface, place, report = surface_of([out], tmp_path, radius=0.6, choices=SurfaceChoices(outliers=20))
    assert (report["outliers"], report["points"]) == (1, 80)
    i, j = cell_of(place, LEFT, TOP)
    assert np.isnan(surface[0, i + 4, j + 4])
    assert_allclose(surface[0, i + 4, j + 5], 15.5)


def test_make_surface__poor_cells_are_no_data(tmp_path):
    given = {"upper": [[2, 9, 2]], "confidence": [[0.9, 0.9, 0.2]]}
    out = write_points(tmp_path / "a", [0.5, 5.5, 9.5], [-0.5] * 3, [10.0] * 3, **given)
    choices = SurfaceChoices(max_width=5, min_confidence=0.5)
    surface, place, report = surface_of([out], tmp_path, radius=0.6, choices=choices)
    i, j = cell_of(place, LEFT, TOP)
    assert_array_equal(np.isfinite(surface[0, i, [j, j + 5, j + 9]]), [True, False, False])
    assert report["poor_cells"] == 2
    assert np.isfinite(surface[3]).sum() == 1


CALIBRATION = """\
version: 2
name: city
coverage: 0.8
registered: true
surface: {CELL: 1 m, PAIRS: '1', INTERVAL: quantiles, RADIUS: 0.6 m, COVERAGE: '0.9', OPEN_POINTS: left out}
classes:
- {relief_below: 5.0, half_width_below: 2.5, margin: 0.75, cells: 100}
- {relief_below: 5.0, half_width_below: null, margin: -4.0, cells: 100}
- {relief_below: null, half_width_below: null, margin: 1.0, cells: 100}
"""


def test_dsm_command__a_calibration_moves_the_bounds_and_is_named_in_the_file(tmp_path):
    # Heights 10, bounds 1 below and 2, 9 above: 8.25 to 12.75; 10 (not past the height) to 15.
    out = write_points(tmp_path / "a", [0.5, 4.5], [-0.5] * 2, [10.0] * 2, upper=[[2, 9]])
    file = tmp_path / "heights.yaml"
    file.write_text(CALIBRATION)
    words = ["dsm", str(with_coverage(out)), "--resolution", "1", "--radius", "0.6", "--calibration", str(file)]
    result = invoke(*words, "--max-width", "6")
    assert result.exit_code == 0, result.stderr
    assert "by --bounds quantiles, calibration city" in result.stdout
    with rasterio.open(out / "dsm.tif") as dataset:
        (surface, place), tags = (dataset.read(), dataset.transform), dataset.tags()
    i, j = cell_of(place, LEFT, TOP)
    assert_allclose(surface[:3, i, [j, j + 4]].T, [(10, 8.25, 12.75), (10, 10, 15)], atol=1e-5)
    assert (tags["COVERAGE"], tags["HEIGHTS"]) == ("0.8", "above the WGS 84 ellipsoid")
    assert tags["CALIBRATION"] == f"city {load_height_calibration(file).sha256}"
    assert tags["REGISTERED"] == "yes"
    file.write_text(CALIBRATION.replace("registered: true", "registered: false"))
    assert invoke(*words).exit_code == 0
    with rasterio.open(out / "dsm.tif") as dataset:
        assert dataset.tags()["REGISTERED"] == "no"
        assert dataset.tags()["CALIBRATION"] != tags["CALIBRATION"]
    for changes, message in (
        (["--resolution", "2"], "other surfaces, CELL is 1 m in the calibration and 2 m in the surface: make one with"),
        (["--bounds", "envelope"], "INTERVAL is quantiles in the calibration and envelope in the surface"),
        (["--radius", "1"], "RADIUS is 0.6 m in the calibration and 1 m in the surface"),
        (["--outliers", "9"], "OUTLIERS is null in the calibration and 9 m in the surface"),
        (["--calibration", str(tmp_path / "none.yaml")], "No such file or directory: make one with"),
    ):
        result = invoke(*words, *changes)
        assert result.exit_code == 2, result.output
        assert message in result.stderr
        assert result.stderr.count("\n") == 1


def test_dsm_command__a_calibration_belongs_to_the_calibration_of_the_disparities(tmp_path):
    out = write_points(tmp_path / "a", [0.5, 4.5], [-0.5] * 2, [10.0] * 2)
    with_coverage(out, load_calibration("satellite").model_dump(mode="json"))
    file = tmp_path / "heights.yaml"
    words = ["dsm", str(out), "--resolution", "1", "--radius", "0.6", "--calibration", str(file)]
    file.write_text(CALIBRATION)
    assert "DISPARITY_CALIBRATION is null in the calibration and satellite" in invoke(*words).stderr
    of_runs = f"satellite {load_calibration('satellite').sha256}"
    file.write_text(CALIBRATION.replace("{CELL", f"{{DISPARITY_CALIBRATION: {of_runs}, CELL"))
    assert invoke(*words).exit_code == 0


def test_make_surface__takes_the_grid_of_a_raster(tmp_path):
    out = write_points(tmp_path / "a", [0.5, 4.5], [-0.5, -0.5], [10.0, 20.0])
    like = tmp_path / "like.tif"
    write_layer(like, np.zeros((5, 7), np.float32), 0, north_up(32631, x=LEFT - 0.3, y=TOP + 1.3, pixel=2.0))
    surface, place, report = surface_of([out], tmp_path, resolution=like, crs=None)
    assert (place.c, place.f, place.a, surface.shape[1:]) == (LEFT - 0.3, TOP + 1.3, 2, (5, 7))
    assert report["crs"] == "EPSG:32631"
    assert_allclose(surface[0, 0, [0, 2]], [10, 20])
    write_layer(like, np.zeros((5, 7), np.float32), 0, north_up(32631, x=LEFT + 900, y=TOP, pixel=2.0))
    with pytest.raises(SatIntervalsError, match="no point reaches the grid"):
        surface_of([out], tmp_path, resolution=like, crs=None)


@pytest.mark.parametrize("bounds", BOUNDS)
def test_make_surface__of_a_run_without_intervals_has_heights_alone(tmp_path, bounds):
    plain = write_points(tmp_path / "a", [0.5, 4.5], [-0.5, -0.5], [10.0, 20.0], lower=np.nan, upper=np.nan)
    with_settings(plain, interval=None, regularization=None)
    surface, place, report = surface_of([plain], tmp_path, radius=0.6, choices=SurfaceChoices(bounds=bounds))
    i, j = cell_of(place, LEFT, TOP)
    assert_allclose(surface[0, i, [j, j + 4]], [10, 20])
    assert np.isnan(surface[1:3]).all()
    assert report["without_intervals"] == [str(plain)]
    other = write_points(tmp_path / "b", [0.5], [-0.5], [11.0])
    surface, place, _ = surface_of([plain, other], tmp_path, radius=0.6, choices=SurfaceChoices(bounds=bounds))
    assert_allclose(surface[:4, i, j], [11, 10, 13, 2])
    assert np.isnan(surface[1:3, i, j + 4]).all()
    assert np.isnan(surface[BAND["agreement"]]).all()


@pytest.mark.parametrize("bounds", BOUNDS)
def test_make_surface__a_point_without_bounds_counts_for_the_height_alone(tmp_path, bounds):
    lower = np.array([[1.0, np.nan]])
    out = write_points(tmp_path / "a", [0.5, 0.5], [-0.5, -0.5], [10.0, 10.0], lower=lower, upper=2 * lower)
    surface, place, _ = surface_of([out], tmp_path, radius=0.6, choices=SurfaceChoices(bounds=bounds))
    i, j = cell_of(place, LEFT, TOP)
    assert_allclose(surface[:4, i, j], [10, 9, 12, 2])


@pytest.mark.process
@pytest.mark.peer("shareloc")
def test_dsm__ends_within_seconds_of_an_interrupt(tmp_path):
    out = write_run(tmp_path, np.ones((4, 1000, 1000), np.float32), np.zeros((1000, 1000), np.uint16))
    files = sensor_words(cameras(tmp_path, 1000, 1000))
    before = sorted(path.name for path in tmp_path.iterdir())
    # 16 million cells of 250 points each take a quarter of a minute
    command = [COMMAND, "dsm", out, *files, "--output", tmp_path / "dsm.tif", "--resolution", "0.125", "--radius", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_until(lambda: list(tmp_path.glob(".*")), "a temporary file")
            time.sleep(0.5)  # it is there an instant before it would be removed
            process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=20)[1]
        finally:
            process.kill()
    assert (process.returncode, said.splitlines()[-1].split(";")[0]) == (130, "sat-intervals: interrupted")
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_make_surface__a_wide_radius_leaves_no_cell_without_height(tmp_path):
    out = write_points(tmp_path / "a", [0.5] * 20, [-0.5] * 20, [10.0] * 20)
    surface, _, _ = surface_of([out], tmp_path, radius=32.0)
    reached = surface[BAND["count"]] > 0
    assert reached.sum() > 3000
    assert_allclose(surface[0][reached], 10.0, atol=1e-4)


def test_make_surface__zone_is_that_of_the_middle(tmp_path):
    # The first pixel alone lies beyond the border of zones 31 and 32 at 6 degrees, 503 km east of the corner.
    x = np.full((9, 1100), 503_000.0) + np.linspace(0, 30_000, 1100)
    x[:, 0] = 300_000.0
    out = write_points(tmp_path / "a", x, np.zeros_like(x), np.full_like(x, 10.0))
    assert make_surface([out], tmp_path / "dsm.tif", resolution=1000.0)["crs"] == "EPSG:32632"


def test_make_surface__file_says_what_it_is(tmp_path):
    out = write_points(tmp_path / "a", [0.5, 1.5], [-0.5, -0.5], [10.0, 11.0])
    make_surface([out], tmp_path / "new" / "model.tif", resolution=1.0)
    with rasterio.open(tmp_path / "new" / "model.tif") as dataset:
        assert dataset.crs.to_string().startswith('PROJCRS["WGS 84 / UTM zone 31N"')  # the zone of the points
        assert dataset.descriptions == tuple(band.name for band in SURFACE)
        assert dataset.units == ("m", "m", "m", "1", "1", "1")
        assert np.isnan(dataset.nodata)
        tags = dataset.tags()
    assert (tags["INTERVAL"], tags["RADIUS"]) == ("envelope", "1 m")
    assert tags["HEIGHTS"] == "above the WGS 84 ellipsoid"


def test_make_surface__heights_count_from_a_geoid(tmp_path):
    out = write_points(tmp_path / "a", [0.5], [-0.5], [100.0])
    surface, _, _ = surface_of([out], tmp_path, geoid=write_geoid(tmp_path / "geoid.tif", 49.5), radius=0.6)
    filled = np.isfinite(surface[0])
    assert_allclose(surface[:3, filled].T, [[50.5, 49.5, 52.5]], atol=1e-3)


def test_make_surface__refuses_a_geoid_that_ends_before_the_points(tmp_path):
    out = write_points(tmp_path / "a", [0.5, 0.6, 0.7, 200_000], [-0.5] * 4, [100.0] * 4)
    with pytest.raises(SatIntervalsError, match=r"does not cover the region of .*: give one that covers them"):
        surface_of([out], tmp_path, geoid=write_geoid(tmp_path / "geoid.tif", 49.5))


def test_utm_of__numbers_zones_from_the_date_line_and_leaves_poles_to_ups():
    places = (-180, 1), (7.2, 43.6), (151.2, -33.9), (179.9, -1), (367.2, 43.6), (10, 85), (10, -81)
    codes = 32601, 32632, 32756, 32760, 32632, 32661, 32761
    assert [utm_of(*place) for place in places] == [f"EPSG:{code}" for code in codes]


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ("EPSG:4326", "EPSG:32637"),
        ("EPSG:2274", "EPSG:32637"),
        ("nonsense", "EPSG:32637"),
        ("EPSG:32637+5773", "a horizontal CRS, and the geoid apart"),
    ],
)
def test_projection__refuses_what_is_no_map_in_metres(crs, message):
    assert Projection("32637").crs == "EPSG:32637"
    with pytest.raises(SatIntervalsError, match=message):
        Projection(crs)


@pytest.mark.parametrize("crs", ["EPSG:32601", "EPSG:27700", "EPSG:3031", "EPSG:32732"])
def test_projection__refuses_a_map_of_another_place(crs):
    Projection("EPSG:32632").check(7.2, 43.6)
    Projection("EPSG:32631").check(7.2, 43.6)
    with pytest.raises(SatIntervalsError, match=r"longitudes .* the points are at longitude 7\.20, latitude 43\.60"):
        Projection(crs).check(7.2, 43.6)


def test_make_surface__what_it_cannot_use_gets_one_line(tmp_path):
    empty = write_points(tmp_path / "empty", [0.5], [-0.5], [np.nan])
    far = [write_points(tmp_path / f"far{x}", [x], [-0.5], [1.0]) for x in (0, 200_000)]
    (tmp_path / "geoid.txt").write_text("no grid")
    bare = write_raster(tmp_path / "bare.tif", np.full((1, 4, 4), 49.5), rasterio.Affine(1, 0, 0, 0, -1, 46), None)
    cases = [
        ([empty], [], "no valid pixel"),
        (far, [], "choose a coarser resolution, or runs of one place"),
        ([far[0]], ["--resolution", "-1"], "resolution is -1 m: give one above 0, up to 10000"),
        ([far[0]], ["--grid-like", "x.tif"], "give either --resolution or --grid-like"),
        ([far[0]], ["--max-width", "-2"], "max_width is -2 m: give one above 0, or leave it out"),
        ([far[0]], ["--min-confidence", "3"], "min_confidence is 3: give one from 0 to 1"),
        ([far[0]], ["--radius", "1e9"], "radius is 1e+09 m: give one above 0"),
        ([far[0]], ["--radius", "500"], "radius is 500 m, 500 cells of 1 m: choose at most 32 m, or a coarser"),
        ([far[0], shutil.copytree(far[0], tmp_path / "copy")], [], "are the same run: give each run once"),
        ([far[0]], ["--output", str(far[0] / "run.json")], "run.json exists: choose another name or --overwrite"),
        ([far[0]], ["--output", str(far[0] / "run.json"), "--overwrite"], "run.json is an input"),
        ([far[0]], ["--left-model", "a.tif"], "--right-grid go together: give all four"),
        (far, sensor_words(["a.tif", "b.tif", "c.tif", "d.tif"]), "models and grids are given 1 times for 2 OUT"),
        ([far[0]], ["--output", str(tmp_path)], "is a folder: choose another name"),
        ([far[0]], ["--geoid", str(write_geoid(tmp_path / "wild.tif", -9999.0))], "has -9999 m at longitude 1.39"),
        ([far[0]], ["--geoid", str(write_geoid(tmp_path / "a,@b.tif", 9.0))], "a,@b.tif: PROJ reads no file with a co"),
        ([far[0]], ["--geoid", str(bare)], "bare.tif has no CRS: declare it"),
        ([far[0]], ["--crs", "EPSG:4326"], "is not a map in metres"),
        ([tmp_path / "nowhere"], [], "give the folder of a finished run"),
    ]
    for outs, options, message in cases:
        words = ["dsm", *map(str, outs), "--resolution", "1", *options]
        result = invoke(*words)
        assert result.exit_code == 2, result.output
        assert message in result.stderr
        assert result.stderr.count("\n") == 1
        assert not (outs[0] / "dsm.tif").exists()
