"""The tables of docs/coverage.md (`make coverage`), on the pairs of ``SAT_INTERVALS_SHARED``.

Every scene is matched with a calibration that was made without it, and compared with alpha 0.9. Fast cross-checking,
valid pixels. On WorldView-3 the bias is removed, and a truth within 1 px of an interval counts as inside.
"""

import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from calibrations import DATA, DEVELOPMENT, WORLDVIEW, row_of, scenes_of

from sat_intervals import load_config, match_arrays
from sat_intervals.kernels.confidence import low_confidence
from sat_intervals.match.calibration import Measured
from sat_intervals.products import INVALID
from sat_intervals.raster import open_image
from sat_intervals.run.calibrate import Subject, calibration_from, measure_subjects, truth_of

TOWNS = "phr_picanteo_pre", "dsm_picanteo"
FIGURES = "coverage", "lowest", "high", "width of high", "low", "width of low", "mean width", "median width", "score"


def read(scene: str, name: str) -> np.ma.MaskedArray:
    """Read an image of a pair; no data is masked."""
    with rasterio.open(DATA / scene / f"{name}.tif") as file:
        return np.ma.masked_array(file.read(1), file.dataset_mask() == 0)


def subject_of(scene: str, preset: str) -> Subject:
    """Open a scene to calibrate with."""
    _, left, right, truth, minimum, maximum, tolerance, _ = row_of(scene)
    config = load_config({"preset": preset, "disparity": {"minimum": minimum, "maximum": maximum}})
    images = open_image(left), open_image(right)
    return Subject(scene, scene, *images, truth_of(images[0], truth), config, None, float(tolerance), tolerance > 0)


@cache
def measured(preset: str) -> tuple[list[Subject], list[Measured]]:
    """Measure all scenes of a preset's calibration."""
    subjects = [subject_of(scene, preset) for scene in scenes_of(preset)]
    with tempfile.TemporaryDirectory() as folder:
        return subjects, measure_subjects(subjects, Path(folder), lambda *_: None)


def judged(scene: str, preset: str, interval: dict[str, Any], coverage: float) -> dict[str, float]:
    """Match a scene in memory, and compare its intervals with the truth if it has one."""
    search = dict(zip(("minimum", "maximum"), row_of(scene)[4:6], strict=True))
    config = load_config({"preset": preset, "disparity": search, "interval": interval})
    bands = match_arrays(read(scene, "left"), read(scene, "right"), config)
    disparity, lower, upper, confidence, validity = (bands[name].values for name in bands)
    low = low_confidence(confidence, config.regularization.threshold, config.regularization.kernel)
    kept = validity & INVALID == 0
    if (DATA / scene / "truth.tif").exists():
        truth = read(scene, "truth").filled(np.nan).astype(np.float64)
        kept &= np.isfinite(truth)
        bias = np.median((disparity - truth)[kept]) if scene in WORLDVIEW else 0
        tolerance = row_of(scene)[6]
        missed = np.maximum(np.maximum(lower - truth - bias, truth + bias - upper) - tolerance, 0)
    else:
        missed = np.full(lower.shape, np.nan)
    width = upper.astype(np.float64) - lower
    classes = kept & ~low, kept & low
    coverages = [(missed[chosen] == 0).mean() for chosen in (kept, *classes)]
    widths = [width[chosen].mean() for chosen in classes]
    score = width[kept].mean() + 2 / (1 - coverage) * missed[kept].mean()
    figures = coverages[0], coverages[0], coverages[1], widths[0], coverages[2], widths[1]
    return dict(zip(FIGURES, (*figures, width[kept].mean(), np.median(width[kept]), score), strict=True))


def calibrated(scene: str, preset: str, coverage: float) -> dict[str, float]:
    """Judge a scene with a calibration that was made without it."""
    subjects, parts = measured(preset)
    others = [(subject, part) for subject, part in zip(subjects, parts, strict=True) if subject.name != scene]
    calibration, _ = calibration_from([part for _, part in others], [subject for subject, _ in others], "others")
    return judged(scene, preset, {"coverage": coverage, "calibration": calibration}, coverage)


def row(*cells: object) -> None:
    """Print a row of a table."""
    print("| " + " | ".join(cell if isinstance(cell, str) else f"{cell:.3f}" for cell in cells) + " |", flush=True)


def header(*cells: str) -> None:
    """Print the head of a table."""
    print()
    row(*cells)
    row(*["---"] * len(cells))


def mean_row(preset: str, label: str, found: list[dict[str, float]]) -> None:
    """Print means over scenes, and the lowest coverage."""
    means = {name: float(np.mean([one[name] for one in found])) for name in FIGURES}
    means["lowest"] = min(one["coverage"] for one in found)
    row(preset, label, *means.values())


def left_out(preset: str, scenes: tuple[str, ...], coverages: tuple[float, ...]) -> None:
    """Print alpha 0.9 and some coverages of a preset, means over scenes."""
    mean_row(preset, "alpha 0.9", [judged(scene, preset, {"alpha": 0.9}, 0.9) for scene in scenes])
    for coverage in coverages:
        mean_row(preset, f"coverage {coverage:g}", [calibrated(scene, preset, coverage) for scene in scenes])


def development() -> None:
    """Twelve scenes, one left out at a time."""
    header("preset", "asked for", *FIGURES)
    left_out("paper", DEVELOPMENT, (0.5, 0.8, 0.9, 0.95, 0.99))
    left_out("mccnn", DEVELOPMENT, (0.9,))


def scenes() -> None:
    """Each of the twelve scenes."""
    header("scene", "asked for", *FIGURES)
    for scene in DEVELOPMENT:
        row(scene, "coverage 0.9", *calibrated(scene, "paper", 0.9).values())


def worldview() -> None:
    """Two WorldView-3 tiles, one left out at a time."""
    header("preset, tile", "asked for", *FIGURES)
    for preset in ("satellite", "satellite-mccnn"):
        for scene in WORLDVIEW:
            row(f"{preset}, {scene}", "alpha 0.9", *judged(scene, preset, {"alpha": 0.9}, 0.9).values())
            row(f"{preset}, {scene}", "coverage 0.9", *calibrated(scene, preset, 0.9).values())


def towns() -> None:
    """Widths on Pleiades pairs without truth, with the built-in calibrations."""
    names = "width of high", "width of low", "mean width", "median width"
    header("scene", "preset", "asked for", *names)
    for scene in TOWNS:
        for preset in ("paper", "satellite"):
            for label, interval in (("alpha 0.9", {"alpha": 0.9}), ("coverage 0.9", {"coverage": 0.9})):
                found = judged(scene, preset, interval, 0.9)
                row(scene, preset, label, *(found[name] for name in names))


if __name__ == "__main__":
    for table in sys.argv[1:] or ["development", "scenes", "worldview", "towns"]:
        {"development": development, "scenes": scenes, "worldview": worldview, "towns": towns}[table]()
