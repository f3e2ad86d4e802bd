"""The tables of README and docs/presets.md (`make tune`): what each preset gives, by kind of scene.

Scenes of ``SAT_INTERVALS_SHARED``, in memory, with the presets' own intervals; a coverage takes a calibration that was
made without the scene, measured as for `make calibration`. On WorldView-3 the truth is LiDAR in whole pixels and biased
by a constant: the median error is removed and a truth within 1 px of an interval counts as inside. Arguments are
presets, or penalties to compare them with: ``make tune NAMES="satellite 'census 5, 8/64' 'mccnn, 1/6'"``.
"""

import sys

import numpy as np
from calibrations import MIDDLEBURY, PAIRED, SYNTHETIC, WORLDVIEW, read, search_of, settings_of, tolerance_of
from coverage_tables import header, row, without

from sat_intervals import load_config, match_arrays

NOMINAL = 0.9
KINDS = {"WorldView-3": WORLDVIEW, "synthetic cities": SYNTHETIC, "Middlebury": MIDDLEBURY}


def judged(scene: str, preset: str) -> dict[str, float]:
    """Figures of one scene."""
    settings = settings_of(preset) | {"disparity": search_of(scene)}
    config = load_config(settings)
    if config.has_coverage:
        config = load_config(settings, {"interval": {"coverage": NOMINAL, "calibration": without(scene, preset)}})
    found = match_arrays(read(scene, "left"), read(scene, "right"), config)
    bands = (found[name].values.astype(np.float64) for name in ("disparity", "lower", "upper"))
    truth = read(scene, "truth").filled(np.nan).astype(np.float64)
    disparity, lower, upper = bands
    kept = np.isfinite(truth) & np.isfinite(disparity)
    disparity, lower, upper, true = (band[kept] for band in (disparity, lower, upper, truth))
    tolerance = tolerance_of(scene)
    true = true + (np.median(disparity - true) if tolerance else 0.0)
    error, width = np.abs(disparity - true), upper - lower
    missed = np.maximum(np.maximum(lower - true, true - upper) - tolerance, 0.0)
    return {
        "good": (error <= 1).sum() / np.isfinite(truth).sum(),
        "bad-3": (error > 3).mean(),
        "kept": kept.sum() / np.isfinite(truth).sum(),
        "coverage": (missed == 0).mean(),
        "median width": np.median(width),
        "mean width": width.mean(),
        "score": width.mean() + 2 / (1 - NOMINAL) * missed.mean(),  # interval score (Gneiting and Raftery 2007)
    }


def main() -> None:
    """Print the means over the scenes of each kind."""
    is_first = True
    for preset in sys.argv[1:] or PAIRED:
        for kind, scenes in KINDS.items():
            found = [judged(scene, preset) for scene in scenes]
            if is_first:
                header("preset", "scenes", *found[0])
                is_first = False
            row(preset, kind, *(float(np.mean([one[name] for one in found])) for name in found[0]))


if __name__ == "__main__":
    main()
