"""The paper's table 2 (`make ablation`): accuracy of its baseline, of alpha-cuts, and of the whole method.

Means over the Middlebury scenes of ``SAT_INTERVALS_SHARED``, over pixels that pass accurate cross-checking and have a
truth. Only the last column is regularised. Beside them the figures of the paper (Malinowski et al. 2024) and of its
implementation Pandora, with penalties 8 and 32. The baseline scales each cost curve by its own minimum and maximum.
"""

import numpy as np
from calibrations import DATA, read, search_of
from coverage_tables import header, row
from volumes import volume_of

from sat_intervals import load_config, match_arrays
from sat_intervals.products import INVALID

LEVELS = 0.5, 0.8, 0.9, 0.98
PAPER = {
    "mb2003": (0.503, 0.997, 0.985, 0.982, 0.980, 0.973),
    "mb2005": (0.592, 0.978, 0.958, 0.950, 0.944, 0.963),
}
PANDORA = {
    "mb2003": (0.481, 0.997, 0.970, 0.955, 0.943, 0.975),
    "mb2005": (0.580, 0.997, 0.958, 0.932, 0.909, 0.959),
}


def accuracies(scene: str) -> list[float]:
    """Shares of valid pixels whose interval contains the truth: baseline, LEVELS, 0.9 regularised."""
    paper = {"preset": "paper", "disparity": search_of(scene)}
    accurate = load_config(paper, {"cross_check": {"method": "accurate"}})
    left, right = (read(scene, side) for side in ("left", "right"))
    levels = [{"interval": {"alpha": alpha}, "regularization": None} for alpha in LEVELS]
    runs = [match_arrays(left, right, load_config(accurate, changes)) for changes in (*levels, {})]
    bounds = [(run["lower"].values, run["upper"].values) for run in runs]
    volume = volume_of(left, right, load_config(paper), sgm=True)
    highest = np.nanmax(volume, axis=2, keepdims=True, initial=0)
    inside = 10 * (highest - volume) >= 9 * (highest - np.nanmin(volume, axis=2, keepdims=True, initial=np.inf))
    first, last = inside.argmax(axis=2), volume.shape[2] - 1 - inside[:, :, ::-1].argmax(axis=2)
    minimum = search_of(scene)["minimum"]
    truth = read(scene, "truth").filled(np.nan)
    kept = (runs[0]["validity"].values & INVALID == 0) & np.isfinite(truth)
    return [
        float(((lower <= truth) & (truth <= upper))[kept].mean())
        for lower, upper in ((minimum + first, minimum + last), *bounds)
    ]


def main() -> None:
    """Print the means of both years, and the figures of others."""
    header("scenes", "baseline", *map(str, LEVELS), "0.9 regularised")
    for year in PAPER:
        row(year, *np.mean([accuracies(folder.name) for folder in sorted(DATA.glob(f"{year}_*"))], axis=0))
        row("paper", *PAPER[year])
        row("Pandora", *PANDORA[year])


if __name__ == "__main__":
    main()
