"""Draw how often intervals contain the truth, and how wide they are, from figures of `evaluate_run`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.disparity import evaluate_run
from sat_intervals.results import open_run
from sat_intervals.show.canvas import DPI, INK, page, plain_logarithm
from sat_intervals.show.legend import BLUE, ORANGE

_CLASSES = (("all", "valid pixels", "black"), ("high", "high confidence", BLUE), ("low", "low confidence", ORANGE))


def check_one_pair(runs: Sequence[Path]) -> None:
    """Raise if runs have read other images than the first one, or are no runs; copies of images are the same."""
    images = []
    for run in runs:
        inputs = open_run(run).report["inputs"]
        images.append([inputs[side].get(key) for side in ("left", "right") for key in ("bytes", "sha256", "etag")])
        if images[-1] != images[0]:
            raise SatIntervalsError(f"{run} is a run of other images than {runs[0]}: give runs of one pair")


def draw_coverage(runs: Sequence[Path], target: Path, dpi: int = DPI, **judging: Any) -> None:
    """Draw nominal coverage and mean width against measured coverage, of runs of one pair at several coverages."""
    reports = sorted((evaluate_run(run, **judging) for run in runs), key=lambda report: float(report["nominal"]))
    with page(target, (9.0, 4.2), dpi, f"{', '.join(run.name for run in runs)}: intervals and truth") as figure:
        left, right = figure.subplots(1, 2)
        deciles = [(report["nominal"], decile) for report in reports for decile in report["deciles"]]
        series = [("deciles of confidence", INK, ".", deciles)]
        for name, label, colour in _CLASSES:
            known = [(report["nominal"], report[name]) for report in reports if report[name]["count"]]
            series.append((label, colour, "o-", known))
        for label, colour, style, points in series:
            nominal, measured = [one for one, _ in points], [area["accuracy"] for _, area in points]
            left.plot(nominal, measured, style, color=colour, ms=5, lw=1, label=label)
            right.plot(measured, [area["mean_width"] for _, area in points], style, color=colour, ms=5, lw=1)
        left.plot([0, 1], [0, 1], color=INK, lw=0.8, ls="--")
        left.set(xlabel="nominal coverage (or alpha)", ylabel="measured coverage", xlim=(0.45, 1), ylim=(0, 1.02))
        left.legend(loc="lower right", frameon=False)
        right.set(xlabel="measured coverage", ylabel="mean width (px)", yscale="log")
        plain_logarithm(right.yaxis)
