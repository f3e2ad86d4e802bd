"""Intervals around the disparities of another matcher, in memory and of files: ranges, agreement, what is refused."""

import json

import numpy as np
import pytest
import rasterio
import xarray as xr
from helpers import PLACE, invoke, write_pair

from sat_intervals import SatIntervalsError, intervals_around, match_arrays, match_pair, open
from sat_intervals.demo import make_scene
from sat_intervals.match.around import CELL, ranges_around
from sat_intervals.raster import write_layer

MARGIN = 5


def test_ranges_around__are_the_hull_of_a_cell_with_its_margin() -> None:
    random = np.random.default_rng(0)
    given = random.uniform(-20, 30, (150, 200)).astype(np.float32)
    given[random.random(given.shape) < 0.5] = np.nan
    given[:CELL, CELL : 2 * CELL] = np.inf
    found = ranges_around((given[row : row + CELL] for row in range(0, 150, CELL)), MARGIN)
    for i in range(3):
        for j in range(4):
            cell = given[i * CELL : (i + 1) * CELL, j * CELL : (j + 1) * CELL]
            known = cell[np.isfinite(cell)]
            ends = (np.floor(known.min()) - MARGIN, np.ceil(known.max()) + MARGIN) if known.size else (1, 0)
            assert (found.minimum[i, j], found.maximum[i, j]) == ends


@pytest.fixture(scope="module")
def scene():
    return make_scene(200, 260, seed=4)


@pytest.fixture(scope="module")
def given(scene):
    """The truth as another matcher's disparities: 10 % are wrong by 6 px or more, 5 % missing."""
    random = np.random.default_rng(1)
    found = scene.truth.astype(np.float32)
    wrong = random.random(found.shape) < 0.1
    found[wrong] += (random.choice([-1, 1], found.shape) * random.uniform(6, 9, found.shape))[wrong]
    found[random.random(found.shape) < 0.05] = np.nan
    return found


@pytest.fixture(scope="module")
def settings(scene):
    return {"preset": "paper", "disparity": {"minimum": scene.minimum, "maximum": scene.maximum, "margin": MARGIN}}


@pytest.fixture(scope="module")
def audited(scene, given, settings):
    images = (np.ma.masked_equal(image, 0) for image in (scene.left, scene.right))
    return intervals_around(*images, given, settings)


def test_intervals_around__finds_wrong_disparities(audited, scene, given) -> None:
    known = np.isfinite(given) & np.isfinite(scene.truth)
    agreement = audited["agreement"].data
    np.testing.assert_array_equal(np.isnan(agreement), np.isnan(given) | np.isnan(audited["lower"].data))
    inside = (audited["lower"].data <= given) & (given <= audited["upper"].data)
    np.testing.assert_array_equal(agreement == 1, inside)
    wrong = known & (abs(given - scene.truth) > 3)
    judged = np.isfinite(agreement)
    assert (agreement == 0)[wrong & judged].mean() > 0.75  # others are in wide intervals of low confidence
    assert (agreement == 0)[known & ~wrong & judged].mean() < 0.05


def test_intervals_around__searches_the_hull_of_the_disparities_by_default(scene, given) -> None:
    images = [np.ma.masked_equal(image, 0) for image in (scene.left, scene.right)]
    hull = np.floor(np.nanmin(given) - MARGIN), np.ceil(np.nanmax(given) + MARGIN)
    search = {"minimum": int(hull[0]), "maximum": int(hull[1]), "margin": MARGIN}
    found = intervals_around(*images, given, {"preset": "paper", "disparity": {"margin": MARGIN}})
    xr.testing.assert_identical(found, intervals_around(*images, given, {"preset": "paper", "disparity": search}))
    assert "agreement" not in match_arrays(*images, {"preset": "paper", "disparity": search})


@pytest.mark.parametrize("tile", [64, 512])
def test_match__around_a_raster_is_that_of_arrays(tile, scene, given, settings, audited, tmp_path) -> None:
    write_pair(tmp_path, scene)
    write_layer(tmp_path / "given.tif", given, np.nan, PLACE)
    images = [str(tmp_path / f"{side}.tif") for side in ("left", "right")]
    search = "--disparity", scene.minimum, scene.maximum, "--around", tmp_path / "given.tif", "--margin", MARGIN
    result = invoke("match", *images, tmp_path / "out", "--preset", "paper", *search, "--tile-size", tile, "--quiet")
    assert result.exit_code == 0, result.output
    with rasterio.open(tmp_path / "out" / "intervals.tif") as file:
        assert file.descriptions == ("disparity", "lower", "upper", "confidence", "agreement")
        for number, name in enumerate(file.descriptions, start=1):
            np.testing.assert_array_equal(file.read(number), audited[name].data, err_msg=name)
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert report["inputs"]["around"]["sha256"]
    xr.testing.assert_equal(
        open(tmp_path / "out")["agreement"].load().drop_vars(["x", "y", "spatial_ref"]),
        audited["agreement"].rename(dict(zip(audited["agreement"].dims, "yx", strict=True))),
    )


def test_match__around_another_raster_is_another_run(scene, given, settings, tmp_path) -> None:
    write_pair(tmp_path, scene)
    write_layer(tmp_path / "given.tif", given, np.nan, PLACE)
    around = settings | {"disparity": settings["disparity"] | {"around": str(tmp_path / "given.tif")}}
    run = tmp_path / "left.tif", tmp_path / "right.tif", tmp_path / "out", around
    match_pair(*run)
    given = np.where(given < 2, given, given + 1e-3)  # the same ranges
    write_layer(tmp_path / "given.tif", given, np.nan, PLACE)
    with pytest.raises(SatIntervalsError, match=r"holds another run: inputs\.around"):
        match_pair(*run)


def test_around__is_refused_in_one_line(scene, given, settings, tmp_path) -> None:
    write_pair(tmp_path, scene)
    write_layer(tmp_path / "given.tif", given[:-1], np.nan, PLACE)
    write_layer(tmp_path / "none.tif", np.full_like(given, np.nan), np.nan, PLACE)
    images = [tmp_path / f"{side}.tif" for side in ("left", "right")]
    for name, message in (("given", "give the disparity of each pixel"), ("none", "has no data")):
        result = invoke("match", *images, tmp_path / "out", "--around", tmp_path / f"{name}.tif", "--quiet")
        assert (result.exit_code, message in result.output) == (2, True), result.output
        assert len(result.output.strip().splitlines()) == 1
    with pytest.raises(SatIntervalsError, match="the disparities are \\(199, 260\\), the left array \\(200, 260\\)"):
        intervals_around(scene.left, scene.right, given[:-1], settings)
    with pytest.raises(SatIntervalsError, match="around gives local ranges of its own"):
        match_pair(*images, tmp_path / "out", {"disparity": {"local": True, "around": "given.tif"}})


def test_match__around_says_how_many_disparities_are_inside(scene, given, tmp_path) -> None:
    write_pair(tmp_path, scene)
    write_layer(tmp_path / "given.tif", given, np.nan, PLACE)
    write_layer(tmp_path / "negative.tif", -given, np.nan, PLACE)
    images = tmp_path / "left.tif", tmp_path / "right.tif"
    right = invoke("match", *images, tmp_path / "right", "--around", tmp_path / "given.tif", "--preset", "paper")
    counts = json.loads((tmp_path / "right" / "run.json").read_text())["counts"]["agreement"]
    share = 100 * counts["inside"] / sum(counts.values())
    assert 80 < share < 95
    assert "given disparities inside" in right.stdout
    assert f"{share:.1f} %" in right.stdout
    assert right.stderr == ""
    wrong = invoke("match", *images, tmp_path / "wrong", "--around", tmp_path / "negative.tif", "--disparity", -30, 30)
    assert "disparities are outside the intervals: check that x_right = x_left + disparity" in wrong.stderr
    refused = invoke("match", *images, tmp_path / "no", "--margin", 4)
    assert (refused.exit_code, "--margin is for --around: give both" in refused.stderr) == (2, True)
