import dataclasses

import numpy as np
import pytest

from sat_intervals.demo import DATUM, GAIN, OFFSET, VIEWS, Scene, look, make_scene, make_views, profiles

ROWS, COLUMNS = 300, 320  # with a river, houses, blocks, wood and fields


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(ROWS, COLUMNS)


def equal(one: Scene, other: Scene) -> bool:
    names = [field.name for field in dataclasses.fields(Scene)]
    return all(np.array_equal(getattr(one, n), getattr(other, n), equal_nan=n == "truth") for n in names)


def warp_errors(scene: Scene) -> np.ndarray:
    """Differences of the left image and the right one sampled linearly at x + truth, on visible pixels.

    They are shares of the left's dynamic range, after the radiometry of both views is undone.
    """
    left, right = ((image - o) / g for image, o, g in zip((scene.left, scene.right), OFFSET, GAIN, strict=True))
    x = np.arange(scene.left.shape[1])
    warped = np.stack([np.interp(x + d, x, line) for d, line in zip(scene.truth, right, strict=True)])
    low, high = np.percentile(left[scene.left > 0], [1, 99])
    return np.abs(warped - left)[scene.visible] / (high - low)


def test_look__shows_the_highest_of_all_crossings():
    x = np.arange(40, 90) + 0.3
    for profile in list(profiles(60, 120))[::15]:
        _, u, height, _ = profile
        for view, a in enumerate(VIEWS):
            nodes = u + a * (height - DATUM)
            start, stop, h0, h1 = nodes[:-1], nodes[1:], height[:-1], height[1:]
            shown = look(profile, view, x)[0]
            for column, high in zip(x, shown, strict=True):
                k = np.flatnonzero((start - column) * (stop - column) <= 0)
                crossings = h0[k] + (column - start[k]) / (stop[k] - start[k]) * (h1[k] - h0[k])
                assert high == pytest.approx(crossings.max(), abs=1e-9)


def test_look__the_other_view_shows_the_same_point_or_a_higher_one():
    x, hidden = np.arange(COLUMNS), 0
    for profile in list(profiles(ROWS // 2, COLUMNS))[::5]:
        for view in (0, 1):
            height, radiance, seen = look(profile, view, x)
            partner = x + (VIEWS[1 - view] - VIEWS[view]) * (height - DATUM)
            there, other_radiance, seen_back = look(profile, 1 - view, partner)
            np.testing.assert_allclose(there[seen], height[seen], atol=1e-5)
            np.testing.assert_allclose(other_radiance[seen], radiance[seen], atol=1e-4)
            assert seen_back[seen].all()
            assert (there[~seen] > height[~seen]).all()
            hidden += np.count_nonzero(~seen)
    assert hidden > 1000


def test_make_scene__truth_warps_the_right_image_onto_the_left():
    # the rest is what linear interpolation of point samples costs in texture
    errors = warp_errors(make_scene(ROWS, COLUMNS, psf=0, snr=np.inf))
    assert errors.mean() < 0.01
    assert np.median(errors) < 0.004


def test_make_scene__truth_is_right_beyond_a_tenth_of_a_pixel(scene):
    errors = {}
    for shift in (-0.1, 0.0, 0.1):
        moved = dataclasses.replace(scene, truth=scene.truth + np.float32(shift))
        errors[shift] = np.square(warp_errors(moved)).mean()
    assert errors[0.0] < min(errors[-0.1], errors[0.1])


def test_make_scene__relief_adds_a_mountain_of_that_height(scene):
    mountain = make_scene(ROWS, COLUMNS, relief=150)
    assert scene.maximum + 130 <= mountain.maximum <= scene.maximum + 155
    assert mountain.minimum < 0  # the river


def test_make_scene__the_empty_corner_has_no_truth(scene):
    empty = scene.left == 0
    assert 0.01 < empty.mean() < 0.04
    assert empty[0, 0]
    np.testing.assert_array_equal(np.isnan(scene.truth), empty)
    np.testing.assert_array_equal(scene.right == 0, empty)
    assert not scene.visible[empty].any()


def test_make_scene__visible_pixels_have_a_partner_with_data(scene):
    row, x = np.nonzero(scene.visible)
    partner = x + scene.truth[row, x]
    assert partner.min() >= 0
    assert partner.max() <= COLUMNS - 1
    assert (scene.right[row, np.floor(partner).astype(int)] > 0).all()
    assert (scene.right[row, np.ceil(partner).astype(int)] > 0).all()


def test_make_scene__does_not_depend_on_the_block():
    assert equal(make_scene(50, 90, block=7), make_scene(50, 90))


def test_make_scene__seed_decides():
    first, again, second = (make_scene(50, 90, seed) for seed in (1, 1, 2))
    assert equal(first, again)
    assert not np.array_equal(first.left, second.left)
    assert not np.array_equal(first.truth, second.truth, equal_nan=True)


def test_make_views__do_not_depend_on_the_block():
    images, again = (make_views(90, 110, [-0.7, 0.5], seed=5, block=block) for block in (64, 17))
    np.testing.assert_array_equal(images[0], again[0])
    np.testing.assert_array_equal(images[1], again[1])


@pytest.mark.parametrize("slant", [-0.3, 0.3])
def test_make_views__show_the_ground_at_the_columns_of_its_heights(slant):
    images, heights = make_views(120, 260, [0.0, slant], seed=5, snr=np.inf, change=0.0)
    columns, alike = np.arange(260.0), []
    for nadir, slanted, high in zip(*images.astype(float), heights, strict=True):
        there = columns + slant * (high - DATUM)
        is_flat = np.convolve(np.abs(np.gradient(high)) >= 0.05, np.ones(15), "same") == 0
        inside = (there > 3) & (there < 256) & is_flat  # far from walls, which hide ground
        alike.append((nadir[inside], np.interp(there, columns, slanted)[inside]))
    assert np.corrcoef(*np.concatenate(alike, axis=1))[0, 1] > 0.99


def test_make_views__a_later_date_has_other_noise_and_its_blocks():
    (images, heights), (again, raised) = (
        make_views(60, 90, [-0.3, 0.3], seed=5, date=date, blocks=blocks)
        for date, blocks in ((0, ()), (1, [(30, 40, 5, 6.0)]))
    )
    rise = np.zeros_like(heights)
    rise[25:35, 35:45] = 6
    np.testing.assert_allclose(raised - heights, rise, atol=1e-5)
    assert not np.array_equal(images[:, :10], again[:, :10])
