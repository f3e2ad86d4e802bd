"""Calibrations from pairs with truth."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from sat_intervals.config import Calibration, key_of
from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.calibration import calibration_of_parts
from sat_intervals.match.measurement import Measured
from sat_intervals.match.memory import STRIP_PIXELS
from sat_intervals.run.checks import checked_region
from sat_intervals.run.measure import Subject, check_enough
from sat_intervals.tiling import strips

_LOG = logging.getLogger(__name__)


def check_subjects(subjects: Sequence[Subject]) -> None:
    """Raise if subjects cannot be calibrated together: settings without confidence, other settings, too few truths."""
    first = subjects[0]
    scenes: dict[Any, str] = {}
    for subject in subjects:
        scene = *((image.path, image.band) for image in (subject.left, subject.right)), subject.window
        if (same := scenes.setdefault(scene, subject.name)) != subject.name:
            raise SatIntervalsError(f"{same} and {subject.name} are the same scene: give each scene once")
        if subject.config.disparity.is_auto:
            raise SatIntervalsError(f"{subject.name}: the search range is auto, but calibrate needs it as numbers")
        missing = [name for name in ("ambiguity", "regularization") if getattr(subject.config, name) is None]
        if missing:
            raise SatIntervalsError(
                f"{subject.name}: {' and '.join(missing)} is null, but calibrate needs confidence: leave it on"
            )
        if key_of(subject.config) != key_of(first.config):
            raise SatIntervalsError(
                f"{subject.name} and {first.name} were matched with other settings: give one --preset or --config"
            )
    groups = {subject.group for subject in subjects}
    if len(subjects) > 1 and len(groups) == 1:
        raise SatIntervalsError(
            f"all {len(subjects)} pairs are of group {first.group}, so no other group is left to test the levels on: "
            "leave out --by-group, or give pairs of another group"
        )
    numbers = [_checked_truths(subject) for subject in subjects]
    check_enough(sum(known for known, _ in numbers), subjects, "known truths")
    for subject, (known, whole) in zip(subjects, numbers, strict=True):
        if known == whole and not subject.tolerance:
            _LOG.warning("the truth of %s has whole pixels only: try --tolerance 0.5", subject.name)


def _checked_truths(subject: Subject) -> tuple[int, int]:
    """Return the numbers of known truths and of whole ones; raise if most are outside the search range."""
    search, region = subject.config.disparity, checked_region(subject.left, subject.window)
    known = outside = whole = 0
    for window in strips(region.height, region.width, STRIP_PIXELS):
        truth = subject.truth.read(window)
        known += int(np.isfinite(truth).sum())
        outside += int(((truth < search.minimum) | (truth > search.maximum)).sum())
        whole += int((truth % 1 == 0).sum())
    if 2 * outside > known:
        raise SatIntervalsError(
            f"{subject.truth.image.path}: {outside} of {known} truths are outside the search range "
            f"{search.minimum} to {search.maximum}: check their sign, x_right = x_left + disparity, and the range"
        )
    return known, whole


def calibration_from(
    parts: Sequence[Measured], subjects: Sequence[Subject], name: str
) -> tuple[Calibration, list[dict[str, float]]]:
    """Return the calibration of measured subjects, and what to expect of it: a row for each coverage."""
    pairs = [
        {"name": subject.name, "group": subject.group, "search_range": [search.minimum, search.maximum]}
        | {"tolerance": subject.tolerance, "remove_bias": subject.remove_bias}
        for subject in subjects
        for search in (subject.config.disparity,)
    ]
    config = subjects[0].config
    return calibration_of_parts(parts, config, name, pairs, key_of(config))
