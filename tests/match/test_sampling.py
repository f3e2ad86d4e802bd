"""Noise and row offset of a pair, measured in sample windows."""

import numpy as np
import pytest

from sat_intervals.demo import make_scene
from sat_intervals.match.sampling import coarse_rows, look_in_tile, summary
from sat_intervals.match.search_range import Step, find_range, reduced
from sat_intervals.tiling import View, Window


@pytest.fixture(scope="module")
def scene():
    return make_scene(260, 360, seed=3)


def view(image):
    return View(Window(0, 0, *image.shape), image.astype(np.float32), (image == 0).view(np.uint8))


def quality(left, right, scene):
    core = Window(0, 0, *left.shape)
    return summary(look_in_tile((view(left), view(right)), core, scene.minimum, scene.maximum))


def test_look_in_tile__measures_the_rows_by_which_the_right_image_lies_lower(scene):
    assert abs(quality(scene.left, scene.right, scene)["row_offset"]) < 0.2
    assert quality(scene.left[2:], scene.right[:-2], scene)["row_offset"] == pytest.approx(2, abs=0.2)
    assert quality(scene.left[:-2], scene.right[2:], scene)["row_offset"] == pytest.approx(-2, abs=0.2)


def test_look_in_tile__noise_makes_matches_differ_more(scene):
    random = np.random.default_rng(0)
    noisy = [image + random.integers(0, 60, image.shape) * (image > 0) for image in (scene.left, scene.right)]
    clean, worse = quality(scene.left, scene.right, scene)["noise"], quality(*noisy, scene)["noise"]
    assert clean < worse < 0.9


def test_look_in_tile__tells_nothing_of_empty_images(scene):
    nothing = np.zeros_like(scene.left)
    assert quality(nothing, nothing, scene) == {"noise": None, "row_offset": None}


def test_coarse_rows__sees_an_offset_of_a_coarse_pixel(scene):
    step = Step(2, 2)
    left, right = (reduced(v.pixels, v.state, step) for v in map(view, (scene.left[2:], scene.right[:-2])))
    matches = find_range(left, right, step, (258, 360))[1]
    assert coarse_rows(left, right, matches) == pytest.approx(2, abs=0.6)
