"""Matches of sample blocks of a pair: noise and row offsets."""

import numpy as np
import pytest

from sat_intervals.demo import make_scene
from sat_intervals.match.sampling import block_match, noise_of, sample_blocks
from sat_intervals.match.whole import cut, whole_view
from sat_intervals.tiling import Window


@pytest.fixture(scope="module")
def scene():
    return make_scene(328, 330, seed=3)


def looks_at(left, right, scene):
    views = [whole_view(np.ma.masked_equal(image, 0).astype(np.float32)) for image in (left, right)]
    chosen = sample_blocks(views[0].window, scene.minimum, scene.maximum)
    found = (block_match(sample, *map(cut, views, sample.views)) for sample in chosen)
    return [one for one in found if one is not None]


@pytest.mark.parametrize("rows", [0, 6, -5])
def test_look__measures_the_rows_by_which_the_right_image_lies_lower(scene, rows):
    height = len(scene.left) - abs(rows)
    left = scene.left[max(0, rows) : max(0, rows) + height]
    right = scene.right[max(0, -rows) : max(0, -rows) + height]
    offsets = [one.rows for one in looks_at(left, right, scene)]
    assert len(offsets) >= 2
    assert abs(np.median(offsets) - rows) < 0.05


def test_noise_of__noise_makes_matches_differ_more(scene):
    random = np.random.default_rng(0)
    noisy = [image + random.integers(0, 60, image.shape) * (image > 0) for image in (scene.left, scene.right)]
    clean, worse = noise_of(looks_at(scene.left, scene.right, scene)), noise_of(looks_at(*noisy, scene))
    assert clean < worse < 0.9


def test_look__sees_nothing_in_empty_images(scene):
    nothing = np.zeros_like(scene.left)
    assert looks_at(nothing, nothing, scene) == []
    assert noise_of([]) is None


def test_spots__cover_a_region_and_stay_inside():
    for height, width, number in ((100, 700, 5), (256, 256, 1), (5000, 5000, 25)):
        region = Window(30, 40, height, width)
        chosen = sample_blocks(region, -5, 9)
        assert len(chosen) == number
        assert all(sample.left.clipped(region) == sample.left for sample in chosen)
        assert chosen[0].left.row == 30
        assert chosen[-1].left.column_stop == 40 + width
