"""The table of docs/coverage.md and more coverages (`make coverage`), on the pairs of ``SAT_INTERVALS_SHARED``.

Every scene is matched with a calibration that was made without its group, and compared with alpha 0.9. Fast
cross-checking, valid pixels, by class; widths of smooth ground are medians, those of the other classes means. On
WorldView-3 the bias is removed, and a truth within 1 px of an interval counts as inside. Scenes are measured as for
`make calibration`, once for both.
"""

import sys
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from calibrations import DATA, DEVELOPMENT, PAIRED, WORLDVIEW, group_of, measured, noisy, read, search_of, tolerance_of

from sat_intervals import load_config, match_arrays
from sat_intervals.config import Calibration
from sat_intervals.kernels.confidence import low_confidence, surroundings
from sat_intervals.products import INVALID
from sat_intervals.run.calibrate import calibration_from

TOWNS = "phr_picanteo_pre", "dsm_picanteo"
COVERAGES = 0.5, 0.8, 0.9, 0.95, 0.99
CLASSES = "smooth", "edge", "low"
WIDTHS = *(f"width of {name}" for name in CLASSES), "mean width", "median width"
FIGURES = "coverage", "lowest", *CLASSES, *WIDTHS, "score", "90 % error of smooth"


def judged(scene: str, preset: str, interval: dict[str, Any], coverage: float, noise: float = 0) -> dict[str, float]:
    """Match a scene in memory, and compare its intervals with the truth if it has one."""
    config = load_config({"preset": preset, "disparity": search_of(scene), "interval": interval})
    bands = match_arrays(noisy(read(scene, "left"), noise, 1), noisy(read(scene, "right"), noise, 2), config)
    names = "disparity", "lower", "upper", "confidence", "validity"
    disparity, lower, upper, confidence, validity = (bands[name].values for name in names)
    low = low_confidence(confidence, config.regularization.threshold, config.regularization.kernel)
    kept = validity & INVALID == 0
    lowest, highest, whole = surroundings(disparity, kept, 9)  # see METHOD.md, section 19
    edge = ~whole | (highest - lowest > 2)
    if (DATA / scene / "truth.tif").exists():
        truth = read(scene, "truth").filled(np.nan).astype(np.float64)
        kept &= np.isfinite(truth)
        bias = np.median((disparity - truth)[kept]) if scene in WORLDVIEW else 0
        error = np.abs(disparity - truth - bias)
        missed = np.maximum(lower - truth - bias, truth + bias - upper)
        missed = np.maximum(missed - tolerance_of(scene), 0)
    else:
        error = missed = np.full(lower.shape, np.nan)
    width = upper.astype(np.float64) - lower
    classes = kept & ~low & ~edge, kept & ~low & edge, kept & low
    total, *coverages = ((missed[chosen] == 0).mean() for chosen in (kept, *classes))
    widths = (mean(width[chosen]) for mean, chosen in zip((np.median, np.mean, np.mean), classes, strict=True))
    score = width[kept].mean() + 2 / (1 - coverage) * missed[kept].mean()
    error_90 = np.quantile(error[classes[0]], 0.9)
    figures = total, total, *coverages, *widths, width[kept].mean(), np.median(width[kept]), score, error_90
    return dict(zip(FIGURES, figures, strict=True))


@cache
def without(scene: str, preset: str) -> Calibration:
    """Return the calibration of a preset that was made without the group of a scene."""
    pairs = [(one, part) for one, part in zip(*measured(preset), strict=True) if one.group != group_of(scene)]
    scenes, parts = zip(*pairs, strict=True)
    return calibration_from(parts, scenes, "others")[0]


def intervals_of(scene: str, preset: str, coverages: Sequence[float] = COVERAGES) -> list[dict[str, float]]:
    """Judge a scene with alpha 0.9, and at coverages with a calibration that was made without it."""
    return [judged(scene, preset, {"alpha": 0.9}, 0.9)] + [
        judged(scene, preset, {"coverage": coverage, "calibration": without(scene, preset)}, coverage)
        for coverage in coverages
    ]


def row(*cells: object) -> None:
    """Print a row of a table."""
    print("| " + " | ".join(cell if isinstance(cell, str) else f"{cell:.3f}" for cell in cells) + " |", flush=True)


def header(*cells: str) -> None:
    """Print the head of a table."""
    print()
    row(*cells)
    row(*["---"] * len(cells))


def development() -> None:
    """Means over twelve scenes, one group left out at a time."""
    header("preset", "asked for", *FIGURES)
    labels = ["alpha 0.9", *(f"coverage {coverage:g}" for coverage in COVERAGES)]
    for preset in PAIRED:
        found = zip(*(intervals_of(scene, preset) for scene in DEVELOPMENT), strict=True)
        for label, scenes in zip(labels, found, strict=True):
            means = {name: float(np.mean([scene[name] for scene in scenes])) for name in FIGURES}
            row(preset, label, *(means | {"lowest": min(scene["coverage"] for scene in scenes)}).values())


def worldview() -> None:
    """Two WorldView-3 tiles, with a calibration from the other scenes."""
    header("preset, tile", "asked for", *FIGURES)
    for preset in ("satellite", "satellite-mccnn"):
        for scene in WORLDVIEW:
            for label, found in zip(("alpha 0.9", "coverage 0.9"), intervals_of(scene, preset, [0.9]), strict=True):
                row(f"{preset}, {scene}", label, *found.values())


def noise() -> None:
    """Means over all scenes with noise in both images."""
    header("noise", *FIGURES)
    scenes = DEVELOPMENT + WORLDVIEW
    for share in (0, 0.1, 0.3):
        found = []
        for scene in scenes:
            interval = {"coverage": 0.9, "calibration": without(scene, "satellite")}
            found.append(judged(scene, "satellite", interval, 0.9, share))
        means = {name: float(np.mean([one[name] for one in found])) for name in FIGURES}
        row(f"{share:g}", *(means | {"lowest": min(one["coverage"] for one in found)}).values())


def towns() -> None:
    """Widths on Pleiades pairs without truth, with the built-in calibrations."""
    header("scene", "preset", "asked for", *WIDTHS)
    for scene in TOWNS:
        for preset in ("paper", "satellite"):
            for label, interval in (("alpha 0.9", {"alpha": 0.9}), ("coverage 0.9", {"coverage": 0.9})):
                found = judged(scene, preset, interval, 0.9)
                row(scene, preset, label, *(found[name] for name in WIDTHS))


if __name__ == "__main__":
    tables = {"development": development, "worldview": worldview, "noise": noise, "towns": towns}
    for name in sys.argv[1:] or tables:
        tables[name]()
