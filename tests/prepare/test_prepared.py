"""What is found of a pair is the same of files and of arrays."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import bands, write_pair

from sat_intervals import match_arrays, match_pair
from sat_intervals.demo import make_scene


def test_prepare__arrays_equal_files_in_every_bit_with_found_ranges_and_rows(tmp_path):
    scene = make_scene(160, 420, seed=8)
    scene = replace(scene, right=np.pad(scene.right[2:], [(0, 2), (0, 0)]))  # 0 is no data
    write_pair(tmp_path, scene)
    settings = {"disparity": {"local": True}}
    report = match_pair(tmp_path / "left.tif", tmp_path / "right.tif", tmp_path / "out", settings)
    assert report["rows"]["coefficients"][0] == pytest.approx(-2, abs=0.3)
    found = match_arrays(*(np.ma.masked_equal(image, 0) for image in (scene.left, scene.right)), settings)
    intervals, validity = bands(tmp_path / "out")
    for name, band in zip(("disparity", "lower", "upper", "confidence"), intervals, strict=True):
        np.testing.assert_array_equal(found[name], band)
    np.testing.assert_array_equal(found["validity"], validity)
