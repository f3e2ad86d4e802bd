"""Where images show ground cells, and their costs in blocks: cameras whose positions are known, random images."""

import numpy as np
import pytest

from sat_intervals.config import load_config
from sat_intervals.match.ground import BLOCK, GroundViews
from sat_intervals.tiling import View, Window

SHAPE = 150, 180
CONFIG = load_config({"preset": "many", "disparity": {"minimum": -6, "maximum": 6}})
# Of three images: rows and columns of pixels for a row and a column of cells, for a metre of height, and their origin.
CELLS = np.array([[[1.0, 0.02], [-0.03, 1.1]], [[0.99, -0.05], [0.04, 1.0]], [[2.1, 0.0], [0.1, 2.05]]])
SLANTS = np.array([[0.02, 0.7], [-0.05, -0.6], [0.1, 0.4]])
ORIGINS = np.array([[5.3, 40.2], [-3.1, 11.7], [8.0, 9.5]])


def there(image, y, x, height):
    """Row and column in an image, not reduced, of a point of the ground in cells and metres."""
    cells = np.stack(np.broadcast_arrays(y, x), axis=-1) @ CELLS[image].T
    return ORIGINS[image] + cells + np.multiply.outer(height, SLANTS[image])


def views():
    """Ground views of the three cameras; the third image is reduced."""
    rows, columns = (BLOCK * np.arange(-(-size // BLOCK) + 1.0) for size in SHAPE)
    y, x = np.meshgrid(rows, columns, indexing="ij")
    levels = 10 + 20.0 * np.arange(4)
    places = np.array([[there(n, y, x, np.full(y.shape, level)) for level in levels] for n in range(3)])
    pairs = np.array([[0, 1], [0, 2], [1, 2]])
    return GroundViews(places, 10.0, 20.0, (1, 1, 2), pairs, 35.0, 0.5, SHAPE)


def reduced(image, places):
    return (places - 0.5) / 2 if image == 2 else places


def image_views(ground, windows, *, more=0):
    """Random images, and what windows, which may be grown, show of them."""
    found = []
    for n, window in enumerate(windows):
        side = 1200  # around all positions
        whole = np.random.default_rng(n).uniform(1, 1000, (side, side)).astype(np.float32)
        grown = window.grown(more, more)
        pixels = whole[200 + grown.row : 200 + grown.row_stop, 400 + grown.column : 400 + grown.column_stop]
        assert pixels.shape == (grown.height, grown.width)
        found.append(View(grown, pixels, np.zeros(pixels.shape, np.uint8)))
    return found


@pytest.mark.parametrize("image", range(3))
def test_positions__and_corners_are_those_of_the_camera(image):
    disparities = np.array([-40.0, 0.0, 3.5, 70.0])
    y, x = np.meshgrid([64.0, 128.0], [128.0, 192.0], indexing="ij")
    places = np.array([there(image, y, x, np.full((2, 2), 35 + 0.5 * one)) for one in disparities])
    np.testing.assert_allclose(views().corners((1, 2), disparities)[image], reduced(image, places), atol=1e-9)
    window = Window(37, 90, 60, 70)
    disparity = np.random.default_rng(0).uniform(-45, 60, (60, 70))
    y, x = np.mgrid[37:97, 90:160] + 0.5
    places = there(image, y, x, 35.0 + 0.5 * disparity)
    np.testing.assert_allclose(views().positions(image, window, disparity), reduced(image, places), atol=1e-9)


def test_windows__contain_all_that_is_read():
    ground, window, ends = views(), Window(50, 40, 70, 100), (-6, 6)
    windows = ground.windows(window, *ends)
    disparities = np.arange(ends[0], ends[1] + 1.0)
    near, far = (image_views(ground, windows, more=more) for more in (0, 40))
    for block, part in ground.blocks(window):
        costs, seen = ground.costs(near, block, part, disparities, CONFIG)
        expected, all_seen = ground.costs(far, block, part, disparities, CONFIG)
        np.testing.assert_array_equal(costs, expected)
        np.testing.assert_array_equal(seen, all_seen)
        assert seen.all()


def test_within__views_of_a_window_have_its_costs_and_no_others():
    ground, inner = views(), Window(70, 70, 50, 60)
    part = ground.within(inner)
    assert part.places.shape[2:4] == (2, 3)
    assert part.windows(inner, -6, 6) == ground.windows(inner, -6, 6)
    assert list(part.blocks(Window(0, 0, *SHAPE))) == list(ground.blocks(Window(64, 64, 64, 116)))
    assert part.windows(Window(0, 0, 64, 64), -6, 6) == (Window(0, 0, 0, 0),) * 3
    images, disparities = image_views(ground, ground.windows(inner, -6, 6)), np.arange(-6.0, 7.0)
    for block, there in part.blocks(inner):
        costs, expected = (one.costs(images, block, there, disparities, CONFIG)[0] for one in (part, ground))
        np.testing.assert_array_equal(costs, expected)
    disparity = np.zeros((inner.height, inner.width))
    np.testing.assert_allclose(part.positions(2, inner, disparity), ground.positions(2, inner, disparity), atol=1e-9)


def test_shown__blocks_are_those_that_two_images_may_show():
    ground = views()
    assert ground.shown([(999, 999)] * 3).all()
    found = ground.shown([(999, 999), (60, 90), (1, 1)])
    assert found[0, 0]
    assert not found[2].any()
    assert not ground.within(Window(70, 70, 50, 60)).shown([(999, 999)] * 3)[0].any()


@pytest.mark.parametrize("part", [Window(10, 21, 30, 25), Window(0, 0, 1, 64), Window(63, 63, 1, 1)])
def test_costs__of_a_part_are_those_of_the_whole_block(part):
    ground, disparities = views(), np.arange(-6.0, 7.0)
    whole = Window(0, 0, BLOCK, BLOCK)
    images = image_views(ground, ground.windows(Window(64, 64, BLOCK, BLOCK), -6, 6))
    images[1].pixels[40:50, 60:70] = np.nan
    costs, seen = ground.costs(images, (1, 1), whole, disparities, CONFIG)
    of_part, seen_too = ground.costs(images, (1, 1), part, disparities, CONFIG)
    np.testing.assert_array_equal(of_part, costs[part.slices])
    np.testing.assert_array_equal(seen_too, seen[(slice(None), *part.slices)])
    assert 0 < seen[1].mean() < 1
