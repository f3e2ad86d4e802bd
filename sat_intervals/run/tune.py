"""Compare settings on pairs with truth: presets and a ladder of penalties, each with its own calibration."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.config import Calibration, Interval
from sat_intervals.config.candidates import changed
from sat_intervals.config.weights import weights_file
from sat_intervals.errors import InputError, RunError, SatIntervalsError
from sat_intervals.match.calibration import left_out, means
from sat_intervals.match.mccnn import load_network
from sat_intervals.match.measurement import ladders
from sat_intervals.progress import Progress
from sat_intervals.raster import OutputError
from sat_intervals.run.calibrate import calibration_from
from sat_intervals.run.measure import Subject, measure_subjects
from sat_intervals.store.manifest import StoreError

COVERAGE = 0.9  # that settings are compared at
# Settings with fewer good pixels than this share of the most are not chosen, however narrow their intervals.
_GOOD_ENOUGH = 0.95
# Errors that say nothing of the settings that are tried, such as a lost truth or a full disk.
OF_ALL = RunError, InputError, OutputError, StoreError


@dataclass(frozen=True)
class Tuned:
    """Figures of some settings on all pairs: shares of pixels kept, and good within 1 px; `means` at COVERAGE."""

    name: str
    subjects: Sequence[Subject]
    kept: float
    good: float
    figures: Mapping[str, float]
    calibration: Calibration


def has_network() -> bool:
    """Return whether MC-CNN and its weights are installed."""
    try:
        load_network(weights_file("full"))
    except SatIntervalsError:
        return False
    return True


def tuned(
    name: str, changes: Mapping[str, Any] | None, subjects: Sequence[Subject], folder: Path, progress: Progress
) -> Tuned:
    """Calibrate pairs with changed settings, and judge these; parameters as in `measure_subjects`."""
    subjects = [replace(subject, config=changed(subject.config, changes)) for subject in subjects]
    parts, key = measure_subjects(subjects, folder, progress)
    calibration, _ = calibration_from(parts, subjects, name, key)
    return Tuned(
        name,
        subjects,
        float(np.mean([part.kept / part.known for part in parts if part.known])),
        float(np.mean([part.good / part.known for part in parts if part.known])),
        means(left_out(parts, ladders(subjects[0].config), [COVERAGE])[0].values()),
        calibration,
    )


def best_of(found: Sequence[Tuned]) -> Tuned:
    """Return the settings with the smallest interval score, of those with nearly as many good pixels as any."""
    judged = [one for one in found if math.isfinite(one.figures.get("score", math.nan))]
    if not judged:
        raise SatIntervalsError("no settings leave enough pixels with truth to be compared: give more pairs")
    most = max(one.good for one in judged)
    return min((one for one in judged if one.good >= _GOOD_ENOUGH * most), key=lambda one: one.figures["score"])


def settings_of(best: Tuned, name: str) -> dict[str, Any]:
    """Return settings with their calibration, without search range and cluster, as a file for `match --config`."""
    calibration = best.calibration.model_copy(update={"name": name})
    interval = Interval(coverage=Decimal(str(COVERAGE)), calibration=calibration)
    config = best.subjects[0].config.model_copy(update={"interval": interval})
    return config.model_dump(mode="json", exclude={"disparity", "cluster", "products"})
