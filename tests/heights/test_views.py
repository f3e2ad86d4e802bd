"""Where views of a known scene show the ground; common ground; pairs to compare."""

from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from types import SimpleNamespace

import numpy as np
import pytest
from sweeps import COLUMNS, ROWS

from sat_intervals.demo import DATUM, PIXEL
from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.point_cloud import Cells
from sat_intervals.match.ground import BLOCK
from sat_intervals.raster import Projection, open_image
from sat_intervals.tiling import Window
from sat_intervals.workflows import demo

with suppress(SatIntervalsError):  # without shareloc all tests here are skipped
    from sat_intervals.heights.views import common_cells, middle_of, sensors_of, towards, views_of, with_pairs

pytestmark = pytest.mark.peer("shareloc")

COUNT, HEIGHTS = 5, (0.0, 60.0)
CELLS = Cells(demo.LEFT - 20, demo.TOP + 10, 1.0, 130, 140)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("views")
    return [open_image(path) for path in demo.write_views(folder, ROWS, COLUMNS, COUNT, 1)[0]]


@pytest.fixture(scope="module")
def sensors(images):
    return sensors_of(images, [])


def camera(n, x, y, height):
    """Row and column of a point of the map in view ``n`` by its model, which is off."""
    row, column = (demo.TOP - y) / PIXEL - 0.5, (x - demo.LEFT) / PIXEL - 0.5
    column = column + demo.slants_of(COUNT)[n] * (height - DATUM)
    return np.stack([row, column], axis=-1) + demo.errors_of(COUNT, 1)[n]


def test_views_of__are_those_of_the_cameras_with_shifts(sensors):
    shifts = np.random.default_rng(0).normal(0, 1, (COUNT, 2))
    ground = views_of(sensors, Projection(demo.CRS), CELLS, HEIGHTS, shifts)
    ground = replace(ground, base=20.0, step=0.25)
    assert (ground.shape, ground.reductions) == ((130, 140), (2,) * COUNT)
    window = Window(11, 30, 100, 90)
    disparity = np.random.default_rng(1).integers(-80, 160, (100, 90)).astype(float)
    x, y = np.meshgrid(CELLS.left + np.arange(30, 120) + 0.5, CELLS.top - np.arange(11, 111) - 0.5)
    for n in range(COUNT):
        expected = (camera(n, x, y, 20 + 0.25 * disparity) + shifts[n] - 0.5) / 2
        np.testing.assert_allclose(ground.positions(n, window, disparity), expected, atol=1e-3)


def test_common_cells__hold_what_two_images_see_and_refuse_other_places_by_name(sensors, tmp_path, monkeypatch):
    found, edge = common_cells(sensors, Projection(demo.CRS), HEIGHTS, PIXEL), 2 + COLUMNS / 32 * PIXEL
    assert abs(found.top - demo.TOP) < edge
    assert abs(found.rows - ROWS) < 2 * edge / PIXEL
    assert found.left < demo.LEFT
    assert found.left + found.columns * PIXEL > demo.LEFT + COLUMNS * PIXEL
    monkeypatch.setattr(demo, "LEFT", demo.LEFT + 5000)
    strange = sensors_of([open_image(path) for path in demo.write_views(tmp_path, 80, 90, 2, 1)[0]], [])
    with pytest.raises(SatIntervalsError, match=r"2\.tif sees no ground that another image sees: leave it out"):
        common_cells([*sensors, strange[1]], Projection(demo.CRS), HEIGHTS, PIXEL)
    with pytest.raises(SatIntervalsError, match="no two images see the same ground: give images of one place"):
        common_cells([sensors[0], strange[0]], Projection(demo.CRS), HEIGHTS, PIXEL)


def test_common_cells__are_all_that_a_small_image_shows_of_a_large_one_and_blocks_of_a_grid_there(sensors):
    large = replace(sensors[0], image=replace(sensors[0].image, height=40 * ROWS, width=40 * COLUMNS))
    for images in ([large, sensors[1]], [sensors[1], large]):
        found = common_cells(images, Projection(demo.CRS), HEIGHTS, PIXEL)
        assert abs(found.top - demo.TOP) < 2
        assert 0 <= found.rows - ROWS < 8
        assert 0 <= found.columns - COLUMNS < 40
    grid = Cells(found.left - 9990, found.top + 9990, PIXEL, 50_000, 50_000)
    part = common_cells(sensors, Projection(demo.CRS), HEIGHTS, PIXEL, grid)
    assert (grid.top - part.top) % (BLOCK * PIXEL) == (part.left - grid.left) % (BLOCK * PIXEL) == 0
    assert found.top <= part.top < found.top + BLOCK * PIXEL
    assert part.rows % BLOCK == part.columns % BLOCK == 0
    assert part.rows < ROWS + 2 * BLOCK
    with pytest.raises(SatIntervalsError, match="on the grid that is given no two images see the same ground"):
        common_cells(sensors, Projection(demo.CRS), HEIGHTS, PIXEL, replace(grid, left=found.left + 9990))


def test_middle_of__is_that_of_all_models_on_both_sides_of_180_degrees(sensors):
    assert middle_of(sensors) == pytest.approx(middle_of(sensors[::-1]), abs=1e-9)
    models = [SimpleNamespace(offset_x=x, offset_y=10.0) for x in (179.9, -179.8)]
    assert middle_of([replace(sensors[0], model=model) for model in models]) == pytest.approx((180.05, 10))


def test_with_pairs__every_image_has_one_and_ratios_are_those_of_the_views(sensors, images):
    ground = views_of(sensors, Projection(demo.CRS), CELLS, HEIGHTS, np.zeros((COUNT, 2)))
    east = -demo.slants_of(COUNT) * PIXEL
    np.testing.assert_allclose(np.abs(towards(ground, 1.0)), np.abs(np.stack([0 * east, east], axis=1)), atol=1e-4)
    paths = [image.path for image in images]
    for count in (1, 2, 3):
        found, widest = with_pairs(ground, paths, CELLS.resolution, count)
        assert set(found.pairs.ravel()) == set(range(COUNT))
        ratios = np.abs(np.diff(east[found.pairs], axis=1))
        assert widest == pytest.approx(ratios.max(), abs=1e-4)
        assert (ratios > 0.15).all()
        assert len(found.pairs) <= count * COUNT


def test_with_pairs__near_dates_come_first(sensors, images, monkeypatch):
    dates = [datetime(2020, month, 1) for month in (1, 6, 1, 6, 1)]
    monkeypatch.setattr("sat_intervals.heights.views.acquired", lambda path: dates[int(path[-5]) - 1])
    ground = views_of(sensors, Projection(demo.CRS), CELLS, HEIGHTS, np.zeros((COUNT, 2)))
    pairs = with_pairs(ground, [image.path for image in images], 1.0, 1)[0].pairs.tolist()
    assert [0, 2] in pairs
    assert [1, 3] in pairs
