"""What is odd about a pair: each cause is named once, the likeliest first."""

import re
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from helpers import PLACE, invoke, write_pair

from sat_intervals import SatIntervalsError, load_config, match_arrays, match_pair
from sat_intervals.demo import make_scene
from sat_intervals.raster import open_image, write_layer
from sat_intervals.run.quality import doubts_of_images, verdict_of


@pytest.fixture(scope="module")
def wide():
    return make_scene(300, 460, seed=4)


@pytest.fixture(scope="module")
def scene(wide):
    """A part of it."""
    return replace(wide, **{name: getattr(wide, name)[:180, :240] for name in ("left", "right", "truth")})


def lows(scene, folder, side):
    """A side of the pair whose smallest value is that of its undeclared_border."""
    pixels = getattr(scene, side).astype(np.uint16) + 2000
    pixels[:, :40] = 777
    write_layer(folder / f"{side}.tif", pixels, None, PLACE)
    return folder / f"{side}.tif"


def test_warnings_of__no_data_is_the_one_diagnosis(scene, tmp_path):
    images = [lows(scene, tmp_path, side) for side in ("left", "right")]
    report = match_pair(*images, tmp_path / "out")
    assert [line.split(": ")[1][:30] for line in report["warnings"]] == [
        "17 % of the pixels are exactly", "17 % of the pixels are exactly",
    ]  # fmt: skip
    assert all(line.endswith("if it is no data, give --nodata 777") for line in report["warnings"])
    assert "but see the warnings, the first one first" in report["verdict"]
    given = match_pair(*[open_image(image, nodata=777) for image in images], tmp_path / "given")
    assert given["warnings"] == []
    assert given["counts"]["valid"] < report["counts"]["valid"]


def test_warnings_of__a_value_that_no_pixel_has(scene, tmp_path):
    write_pair(tmp_path, scene)
    images = tmp_path / "left.tif", tmp_path / "right.tif"
    shifted = []
    for image in images:
        with rasterio.open(image) as file:
            pixels = file.read(1)
        shifted.append(tmp_path / f"all_{image.name}")
        write_layer(shifted[-1], np.maximum(pixels, 100), None, PLACE)
    search = "--disparity", scene.minimum, scene.maximum
    result = invoke("match", *shifted, tmp_path / "out", *search, "--nodata", 43)
    assert "all_left.tif: no pixel that was read is 43, the no-data value given: check it" in result.stderr
    assert result.stderr.count("warning: ") == 1
    assert "warning" not in invoke("match", *shifted, tmp_path / "with", *search, "--nodata", 100).stderr


def test_match__prints_the_verdict_and_then_the_warnings(scene, tmp_path):
    images = [lows(scene, tmp_path, side) for side in ("left", "right")]
    result = invoke("match", *images, tmp_path / "out", "--disparity", scene.minimum, scene.maximum)
    lines = result.output.splitlines()
    verdict = next(number for number, line in enumerate(lines) if "% valid, but see the warnings" in line)
    warned = [number for number, line in enumerate(lines) if line.startswith("warning: ")]
    time = next(number for number, line in enumerate(lines) if line.startswith("time"))
    assert time < verdict < min(warned)
    assert len(warned) == 2
    assert len([line for line in lines if line.startswith("matching tiles")]) == 1


def test_warnings_of__the_same_image_twice(scene, tmp_path):
    write_pair(tmp_path, scene)
    with (
        rasterio.open(tmp_path / "left.tif") as file,
        rasterio.open(tmp_path / "copy.tif", "w", **file.profile | {"compress": "lzw", "tiled": True}) as copy,
    ):
        copy.write(file.read())
    report = match_pair(tmp_path / "left.tif", tmp_path / "copy.tif", tmp_path / "out")
    assert report["warnings"][0].endswith("have the same pixels: give the left and the right image")


def test_doubts_of_images__of_two_sizes(scene, tmp_path):
    left, right = lows(scene, tmp_path, "left"), tmp_path / "right.tif"
    write_layer(right, scene.right[:140, :210].astype(np.uint16) + 2000, 2000, PLACE)
    (line,) = doubts_of_images(open_image(left), open_image(right))
    assert line.startswith(f"{left}: 17 % of the pixels are exactly 777, along its borders")
    given = [open_image(image, nodata=value) for image, value in ((left, 777), (right, None))]
    assert doubts_of_images(*given) == []
    assert doubts_of_images(open_image(left, nodata=778), open_image(right)) == []  # some rows do not tell


def test_warnings_of__isolated_pixels_without_data(scene, tmp_path):
    random = np.random.default_rng(0)
    for side in ("left", "right"):
        pixels = np.where(random.random(scene.left.shape) < 0.03, 0, getattr(scene, side)).astype(np.uint16)
        write_layer(tmp_path / f"{side}.tif", pixels, 0, PLACE)
    search = {"minimum": scene.minimum, "maximum": scene.maximum}
    report = match_pair(tmp_path / "left.tif", tmp_path / "right.tif", tmp_path / "out", {"disparity": search})
    assert "of the pixels are no data or masked, but spoil the windows of" in report["warnings"][0]


def test_warnings_of__images_that_have_little_in_common(wide, tmp_path):
    """As of dates before and after a change: cross-checking keeps most of it, with intervals as wide as the range."""
    left, right, other = wide.left[:, :330], wide.right[:, :330], wide.left[::-1, 130:]
    for own, count in ((0.7, 0), (0.25, 1)):
        images = [tmp_path / f"{side}{count}.tif" for side in ("left", "right")]
        for image, pixels in zip(images, (left, own * right + (1 - own) * other), strict=True):
            write_layer(image, pixels.astype(np.uint16), 0, PLACE)
        settings = {"disparity": {"minimum": wide.minimum, "maximum": wide.maximum}, "rows": "none"}
        report = match_pair(*images, tmp_path / str(count), settings)
        assert report["counts"]["valid"] > 0.5 * report["counts"]["pixels"]
        assert ["the median interval is" in line for line in report["warnings"]] == [True] * count


@pytest.mark.parametrize("search", [(-180, -110), (40, 80)])
def test_match__a_range_beside_the_truth_is_the_one_diagnosis(wide, tmp_path, search):
    """Rows are wrong, too, but the range is named, and the one to give."""
    write_pair(tmp_path, wide)
    images = tmp_path / "left.tif", tmp_path / "right.tif"
    for rows, status in (("auto", 2), ("none", 0)):
        out = tmp_path / rows
        result = invoke("match", *images, out, "--disparity", *search, "--rows", rows, "--quiet")
        (line,) = result.stderr.splitlines()
        assert result.exit_code == status
        searched = f"disparities {search[0]} to {search[1]} are searched, but have 0 % of the matches, which are at "
        there = re.search(searched + r"(\S+) to (\S+): give those, or leave out the range", line)
        assert int(there[1]) <= wide.minimum
        assert int(there[2]) >= wide.maximum
    left, right = (np.ma.masked_equal(image, 0) for image in (wide.left, wide.right))
    with pytest.raises(SatIntervalsError, match=f"which are at {there[1]} to {there[2]}: give those, or leave"):
        match_arrays(left, right, {"disparity": {"minimum": search[0], "maximum": search[1]}})


def test_prepare__refuses_an_unrelated_image(tmp_path):
    for side, seed in (("left", 1), ("right", 2)):
        pixels = getattr(make_scene(300, 420, seed=seed), side)
        write_layer(tmp_path / f"{side}.tif", pixels, 0, PLACE)
    search = {"disparity": {"minimum": -30, "maximum": 40}}
    with pytest.raises(SatIntervalsError, match="check that both images show the same place"):
        match_pair(tmp_path / "left.tif", tmp_path / "right.tif", tmp_path / "out", search)


def test_verdict_of__compares_widths_with_those_of_the_calibration():
    config = load_config({"interval": {"coverage": 0.9}, "disparity": {"minimum": -9, "maximum": 9}})
    counts = {"valid": 90, "pixels": 100, "median_interval_width": 1.1}
    assert verdict_of(counts, config, []) == "90 % valid, intervals usual for this preset"
    wide = verdict_of(counts | {"median_interval_width": 9.0}, config, [])
    assert wide.startswith("90 % valid, intervals wider than usual: median 9.00 px, ")
    assert verdict_of(counts, config, ["one"]) == "90 % valid, but see the warning"
    few = counts | {"valid": 3, "causes": {"left_window": 20, "mismatch": 70}}
    assert verdict_of(few, config, []) == "only 3 % valid, most of the others by mismatch"
    plain = load_config({"interval": {"alpha": 0.9}, "preset": "paper"})
    assert verdict_of(counts, plain, []) == "90 % valid, nothing unusual"
