"""What is found before the tiles of a sweep: errors of models, heights, and images that are not of the place."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import invoke, refused
from sweeps import WORDS, left_by_heights, with_other

from sat_intervals.demo import PIXEL, make_views
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.tiling import Window
from sat_intervals.workflows.demo import slants_of

pytestmark = pytest.mark.peer("shareloc")

# Cells of two pixels and given heights take less time.
COARSE = "--resolution", 2 * PIXEL, *WORDS[2:], "--heights", 0, 50


def noise(shape):
    return np.random.default_rng(9).integers(100, 1000, shape)


def elsewhere(shape):
    return make_views(*shape, [slants_of(5)[-1]], seed=77)[0][0]


def test_found_ground__takes_out_the_errors_of_models(sweep):
    shifts = np.array([one["shift"] for one in sweep.report["sweep"]["images"]])
    np.testing.assert_allclose(shifts.mean(axis=0), 0, atol=2e-3)
    assert np.abs(left_by_heights(shifts)).max() < 0.15
    assert all(one["alike"] > 0.8 for one in sweep.report["sweep"]["images"])


def test_found_ground__heights_and_ranges_contain_the_ground(sweep):
    found, known = sweep.report["sweep"], np.isfinite(sweep.truth)
    assert found["heights"][0] < np.nanmin(sweep.truth)
    assert found["heights"][1] > np.nanmax(sweep.truth)
    base = found["heights"][0] - found["step"] * found["disparities"][0]
    least, most = LocalRanges.of_report(found["ranges"]).at(Window(0, 0, *sweep.truth.shape))
    lowest, highest = (base + found["step"] * end for end in (least, most))
    assert ((lowest <= sweep.truth) & (sweep.truth <= highest))[known].mean() > 0.98
    assert (most - least).mean() < 0.8 * (found["disparities"][1] - found["disparities"][0])


def test_heights_of__stray_winners_do_not_widen_the_range():
    from sat_intervals.heights.stack import Surface
    from sat_intervals.workflows.ground import _heights_of

    random = np.random.default_rng(5)
    disparity = np.broadcast_to(np.linspace(-5, 5, 60, dtype=np.float32), (60, 60)).copy()
    disparity[20:28, 20:28] = 40  # a tower
    rows, columns = np.meshgrid(range(5, 60, 7), range(2, 60, 7))
    disparity[rows, columns] = random.uniform(-300, 300, rows.shape)  # 2 % of the cells, in twos
    surface = Surface(disparity.repeat(2, axis=0), np.zeros((120, 60), np.float32))
    stack = SimpleNamespace(ground=SimpleNamespace(base=10.0, step=0.5))
    low, high = _heights_of(surface, stack, (-500, 500))
    assert 0 < low < 7.5
    assert 30 < high < 40


@pytest.mark.parametrize("pixels", [noise, elsewhere])
def test_found_ground__leaves_out_an_image_of_noise_or_another_place(sweep, tmp_path, pixels):
    images = with_other(tmp_path / "images", sweep.images, pixels((200, 220)))
    result = invoke("surface", *images, tmp_path / "out", *COARSE, "--strict")
    assert result.exit_code == 1, result.output
    assert "1 warning, see above, and --strict is given; the files are written" in result.stderr
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert report["sweep"]["left_out"] == [str(images[-1])]
    assert report["sweep"]["used"] == [f"image_{n}" for n in (1, 2, 3, 4)]
    assert report["warnings"][0].startswith(f"{images[-1]}: left out, since it is not like the other images")
    assert "left out" in result.stderr


def test_found_ground__refuses_what_leaves_two_images(sweep, tmp_path):
    images = with_other(tmp_path / "images", sweep.images[1:4], noise((200, 220)))
    refused(
        ("surface", *images, tmp_path / "out", *COARSE),
        f"{images[-1]}: not like the others on the ground",
        "2 images are left",
    )
    assert not (tmp_path / "out" / "dsm.tif").exists()
