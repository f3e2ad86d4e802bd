"""Calibrations of volumes: an overconfident softmax gets the coverage that is asked for on other scenes."""

import numpy as np
import pytest
from volumes import softmax, volume_of

from sat_intervals import SatIntervalsError, calibrate_volumes, intervals_of, load_config
from sat_intervals.config import load_calibration
from sat_intervals.demo import make_scene

DISPARITIES = np.arange(-16, 33)
CONFIG = load_config({"preset": "paper", "disparity": {"minimum": -16, "maximum": 32}})


@pytest.fixture(scope="module")
def scenes():
    """Softmax volumes of our aggregated costs with their truths: the temperature makes them overconfident."""
    found = []
    for seed in range(8):
        scene = make_scene(90, 150, seed=seed)
        images = (np.ma.masked_equal(image.astype(np.float32), 0) for image in (scene.left, scene.right))
        found.append((softmax(volume_of(*images, CONFIG, sgm=True), 2), scene.truth))
    return found


def coverage(scenes, interval):
    shares = []
    for volume, truth in scenes:
        found = intervals_of(volume, DISPARITIES, kind="probability", config={"interval": interval})
        known = np.isfinite(found["lower"].data) & np.isfinite(truth)
        inside = (found["lower"].data <= truth) & (truth <= found["upper"].data)
        shares.append(inside[known].mean())
    return np.mean(shares)


def test_calibrate_volumes__reaches_a_coverage_on_other_scenes(scenes, tmp_path) -> None:
    assert abs(coverage(scenes[1::2], {"alpha": 0.1}) - 0.9) > 0.04
    calibration = calibrate_volumes(scenes[::2], DISPARITIES, kind="probability", name="softmax")
    for wanted in (0.8, 0.9):
        interval = {"coverage": wanted, "calibration": calibration}
        assert abs(coverage(scenes[1::2], interval) - wanted) < 0.02
    read = load_calibration(calibration.model_dump(mode="json"))
    assert read == calibration
    assert 0.85 < calibration.provenance["expected"][5]["all"] < 0.95
    with pytest.raises(SatIntervalsError, match="belongs to other settings"):
        intervals_of(-np.log(scenes[0][0] + 1e-9), DISPARITIES, kind="cost", span=(-1, 21),
                     config={"interval": {"coverage": 0.9, "calibration": calibration}})  # fmt: skip


def test_calibrate_volumes__judges_a_single_volume_in_blocks(scenes) -> None:
    volume, truth = (band[:60] for band in scenes[0])
    how = {"kind": "similarity", "span": 1, "config": {"cross_check": None}}
    half = calibrate_volumes([(volume[:, :, 8:], truth / 2)], DISPARITIES[8:] / 2, tolerance=0.25, **how)
    whole = calibrate_volumes([(volume[:, :, 8:], truth)], DISPARITIES[8:], tolerance=0.5, **how)
    assert half.provenance["pairs"] == [{"name": "volume 0", "search_range": [-4, 16], "tolerance": 0.25}]
    assert half.levels == whole.levels
    assert half.provenance["expected"][0]["lowest"] == whole.provenance["expected"][0]["lowest"]


def test_calibrate_volumes__takes_a_mask_of_the_truth(scenes) -> None:
    volume, truth = (band[:60] for band in scenes[0])
    unknown = np.indices(truth.shape)[1] < 60
    masked = np.ma.array(np.where(unknown, -9999.0, truth), mask=unknown)
    how = {"disparities": DISPARITIES, "kind": "probability", "config": {"interval": {"coverage": 0.9}}}
    expected = calibrate_volumes([(volume, np.where(unknown, np.nan, truth))], **how)
    assert calibrate_volumes(iter([(volume, masked)]), **how).levels == expected.levels


def test_calibrate_volumes__refuses_in_one_line(scenes) -> None:
    volume, truth = scenes[0]
    refused = {
        r"truth 0 is \(9, 150\), its volume \(90, 150\)": {"pairs": [(volume, truth[:9])]},
        "0 kept pixels have a truth, at least 1000": {"pairs": [(volume, np.full_like(truth, np.nan))]},
        "0 % of the disparities of truth 0 are among": {"pairs": [(volume, truth + 200)]},
        "regularization is null": {"pairs": [(volume, truth)], "config": {"regularization": None}},
    }
    for message, given in refused.items():
        with pytest.raises(SatIntervalsError, match=message):
            calibrate_volumes(**given, disparities=DISPARITIES, kind="probability")
