"""Calibrations from pairs with truth."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from sat_intervals.config import Calibration, key_of
from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.levels import calibration_of_parts
from sat_intervals.match.measurement import Measured
from sat_intervals.match.memory import STRIP_PIXELS
from sat_intervals.run.checks import checked_region
from sat_intervals.run.measure import CalibrationScene, check_enough
from sat_intervals.tiling import strips

_LOG = logging.getLogger(__name__)


def check_scenes(scenes: Sequence[CalibrationScene]) -> None:
    """Raise if scenes cannot be calibrated together: settings without confidence, other settings, too few truths."""
    first = scenes[0]
    seen: dict[Any, str] = {}
    for scene in scenes:
        place = *((image.path, image.band) for image in (scene.left, scene.right)), scene.window
        if (same := seen.setdefault(place, scene.name)) != scene.name:
            raise SatIntervalsError(f"{same} and {scene.name} are the same scene: give each scene once")
        if scene.config.disparity.is_auto:
            raise SatIntervalsError(f"{scene.name}: the search range is auto, but calibrate needs it as numbers")
        missing = [name for name in ("ambiguity", "regularization") if getattr(scene.config, name) is None]
        if missing:
            raise SatIntervalsError(
                f"{scene.name}: {' and '.join(missing)} is null, but calibrate needs confidence: leave it on"
            )
        if key_of(scene.config) != key_of(first.config):
            raise SatIntervalsError(
                f"{scene.name} and {first.name} were matched with other settings: give one --preset or --config"
            )
    groups = {scene.group for scene in scenes}
    if len(scenes) > 1 and len(groups) == 1:
        raise SatIntervalsError(
            f"all {len(scenes)} pairs are of group {first.group}, so no other group is left to test the levels on: "
            "leave out --by-group, or give pairs of another group"
        )
    numbers = [_checked_truths(scene) for scene in scenes]
    check_enough(sum(known for known, _ in numbers), scenes, "known truths")
    for scene, (known, whole) in zip(scenes, numbers, strict=True):
        if known == whole and not scene.tolerance:
            _LOG.warning("the truth of %s has whole pixels only: try --tolerance 0.5", scene.name)


def _checked_truths(scene: CalibrationScene) -> tuple[int, int]:
    """Return the numbers of known truths and of whole ones; raise if most are outside the search range."""
    search, region = scene.config.disparity, checked_region(scene.left, scene.window)
    known = outside = whole = 0
    for window in strips(region.height, region.width, STRIP_PIXELS):
        truth = scene.truth.read(window)
        known += int(np.isfinite(truth).sum())
        outside += int(((truth < search.minimum) | (truth > search.maximum)).sum())
        whole += int((truth % 1 == 0).sum())
    if 2 * outside > known:
        raise SatIntervalsError(
            f"{scene.truth.image.path}: {outside} of {known} truths are outside the search range "
            f"{search.minimum} to {search.maximum}: check their sign, x_right = x_left + disparity, and the range"
        )
    return known, whole


def calibration_from(
    parts: Sequence[Measured], scenes: Sequence[CalibrationScene], name: str
) -> tuple[Calibration, list[dict[str, float]]]:
    """Return the calibration of measured scenes, and what to expect of it: a row for each coverage."""
    pairs = [
        {"name": scene.name, "group": scene.group, "search_range": [search.minimum, search.maximum]}
        | {"tolerance": scene.tolerance, "remove_bias": scene.remove_bias}
        for scene in scenes
        for search in (scene.config.disparity,)
    ]
    config = scenes[0].config
    return calibration_of_parts(parts, config, name, pairs, key_of(config))
