"""The matching cost of many images: costs in blocks, ranges of blocks, and cells that too few images see."""

import numpy as np
from match.test_ground import CONFIG, views

from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.matching_cost import Area, Given
from sat_intervals.match.sweep import SweepCost
from sat_intervals.products import NO_DATA
from sat_intervals.tiling import View, Window

WINDOW, COUNT = Window(50, 40, 40, 60), 13


def made(ranges=None, hidden=()):
    """Costs of a window; no image sees anything of those that are ``hidden``."""
    cost, area = SweepCost(CONFIG, Given(ground=views(), ranges=ranges)), Area.of(WINDOW, CONFIG)
    seen = []
    for n, window in enumerate(cost.windows([area])):
        pixels = np.random.default_rng(n).uniform(1, 1000, (window.height, window.width)).astype(np.float32)
        seen.append(View(window, np.where(n in hidden, np.float32(np.nan), pixels), np.zeros(pixels.shape, np.uint8)))
    return cost.of_areas(seen, [area])[0]


def test_of_areas__candidates_outside_the_range_of_a_block_get_the_largest_cost():
    first, last = np.full((3, 3), -6, np.int16), np.full((3, 3), 6, np.int16)
    first[1, 0], last[1, 0] = -2, 3
    whole, narrow = made().costs.left, made(LocalRanges(first, last, 64, 64)).costs.left
    inside, block = slice(4, 10), (slice(14, 40), slice(0, 24))
    assert (narrow[(*block, inside)] < CONFIG.numbers.largest).all()
    assert (np.delete(narrow[(*block, slice(0, COUNT))], inside, axis=-1) == CONFIG.numbers.largest).all()
    rest = np.ones((40, 60), bool)
    rest[block] = False
    np.testing.assert_array_equal(narrow[rest][:, :COUNT], whole[rest][:, :COUNT])


def test_of_areas__cells_of_blocks_without_places_are_no_data():
    ground = views().within(Window(128, 128, 1, 1))
    cost, area = SweepCost(CONFIG, Given(ground=ground)), Area.of(WINDOW, CONFIG)
    nothing = tuple(View(window, *np.zeros((2, 0, 0))) for window in cost.windows([area]))
    found = cost.of_areas(nothing, [area])[0]
    assert (found.state == NO_DATA).all()
    assert (found.costs.left == CONFIG.numbers.largest).all()
    again = cost.of_areas((), [area], [found.costs.left, found.seen])[0]
    np.testing.assert_array_equal(again.state, found.state)


def test_of_areas__cells_that_fewer_than_two_images_see_are_no_data():
    three, two, one = made(), made(hidden=[1]), made(hidden=[0, 1])
    assert (three.seen == 3).all()
    assert not three.state.any()
    assert (two.seen == 2).all()
    assert not two.state.any()
    assert not one.seen.any()
    assert (one.state == NO_DATA).all()
    assert (one.costs.left[..., :COUNT] == CONFIG.numbers.largest).all()
