"""The search range from the images: it holds the truth, and images that do not match are refused."""

import numpy as np
import pytest

from sat_intervals import load_config, match_arrays
from sat_intervals.demo import make_scene
from sat_intervals.kernels.resampling import Step, reduced
from sat_intervals.match.coarse import (
    Found,
    NoRangeError,
    find_range,
    finest_step,
    undeclared_border,
    with_range,
)


@pytest.fixture(scope="module")
def scene():
    return make_scene(200, 700, seed=7)


def small(image, step):
    return reduced(image.astype(np.float32), (image == 0).view(np.uint8), step)


def searched(left, right):
    step = finest_step(left.shape[0], max(left.shape[1], right.shape[1]))
    return find_range(small(left, step), small(right, step), step, left.shape)[0]


def test_find_range__holds_the_truth_and_is_narrow(scene):
    found = searched(scene.left, scene.right)
    truth = scene.truth[np.isfinite(scene.truth)]
    assert np.mean((found.minimum <= truth) & (truth <= found.maximum)) > 0.999
    assert found.maximum - found.minimum < 1.8 * (truth.max() - truth.min())
    assert found.matched > 0.7
    assert sum(found.histogram["counts"]) > 0


def test_find_range__swapped_images_have_the_range_of_the_other_sign(scene):
    there, back = searched(scene.left, scene.right), searched(scene.right, scene.left)
    assert abs(there.minimum + back.maximum) <= 4
    assert abs(there.maximum + back.minimum) <= 4


def test_find_range__searches_further_where_the_range_is_far_from_zero(scene):
    near = searched(scene.left, scene.right)
    far = searched(scene.left[:, :400], scene.right[:, 300:])
    assert abs(far.minimum + 300 - near.minimum) <= 25
    assert abs(far.maximum + 300 - near.maximum) <= 25
    assert len({(level.minimum, level.maximum) for level in far.levels}) == len(far.levels)


def test_find_range__refuses_images_without_consistent_matches(scene):
    with pytest.raises(
        NoRangeError, match=r"only \d % of the pixels have a consistent match between disparities -69\d"
    ):
        searched(scene.left, scene.right[::-1])
    with pytest.raises(NoRangeError, match="only 0 %"):
        searched(np.full((200, 500), 7), np.full((200, 500), 7))


def test_find_range__few_rows_are_averaged_less():
    assert finest_step(400, 30_000) == Step(4, 8)
    assert finest_step(12, 3000) == Step(1, 8)
    assert finest_step(3000, 500) == Step(1, 1)
    assert finest_step(3000, 1900) == Step(4, 4)


def test_undeclared_border__reaches_the_border():
    image = np.ones((5, 6), np.float32)
    image[:, 0] = image[2, 3] = image[4, 3:] = 0
    found = undeclared_border(image, 0.0)
    assert found.sum() == 8
    assert not found[2, 3]
    assert not undeclared_border(image, np.inf).any()


def test_fitted__has_no_more_disparities_than_the_right_image_has_columns(scene):
    found = searched(scene.left, scene.right)
    count = found.maximum - found.minimum + 1
    assert found.fitted(count) == found
    cut = found.fitted(count - 3)
    assert (cut.minimum, cut.maximum) == (found.minimum + 1, found.maximum - 2)


def test_find_range__of_a_pair_that_shares_little_keeps_the_end_with_the_matches():
    """15 % overlap: disparities near -530, and stray matches near 300, together beyond the columns of the image."""
    wide = make_scene(160, 1187, seed=3)
    left, right = wide.left[:, :620], wide.right[:, 527:1147]
    truth = wide.truth[:, 527:620] - 527
    found = searched(left, right).fitted(620)
    assert found.maximum - found.minimum < 620
    assert np.nanmean((found.minimum <= truth) & (truth <= found.maximum)) > 0.99
    matched = match_arrays(left, right, {"disparity": {"minimum": found.minimum, "maximum": found.minimum + 90}})
    assert "rows" not in matched.attrs


def test_found__survives_its_report(scene):
    found = searched(scene.left, scene.right)
    assert Found.of_report(found.report()) == found


def test_match_arrays__finds_the_range_that_is_not_given(scene):
    left, right = (np.ma.masked_equal(image[:120], 0) for image in (scene.left, scene.right))
    found = searched(left.filled(0), right.filled(0))
    search = {"minimum": found.minimum, "maximum": found.maximum, "open_ends": True}
    assert match_arrays(left, right, {}).identical(match_arrays(left, right, {"disparity": search}))


@pytest.mark.parametrize("ends", [(-17_100, -16_900), (15_990, 16_010)])
def test_fitted__refuses_a_range_that_no_settings_hold(ends):
    with pytest.raises(NoRangeError, match="beyond 16000: crop or shift the images"):
        Found(*ends, matched=0.5, levels=()).fitted(40_000)
    found = Found(-16_000, -15_900, 0.5, (), {"edges": [-15_990, -15_910], "counts": [9]})
    kept = with_range(load_config(), found.fitted(40_000))
    assert load_config(kept.model_dump()).disparity.minimum == -16_000
