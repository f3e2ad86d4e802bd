"""Draw how intervals of runs compare with truth, and those of a surface model and its heights with a reference."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.comparison import Comparison
from sat_intervals.evaluate.disparity import evaluate_run
from sat_intervals.evaluate.surface_accuracy import Profile, error_map
from sat_intervals.results import open_run
from sat_intervals.show import canvas
from sat_intervals.show.legend import BLUE, ORANGE

_CLASSES = (("all", "valid pixels", "black"), ("high", "high confidence", BLUE), ("low", "low confidence", ORANGE))
_WORTH, _LONGEST = 50, 900  # cells of a class that are worth a point, and pixels of the longer side of a map


def check_one_pair(runs: Sequence[Path]) -> None:
    """Raise if runs have read other images than the first one, or are no runs; copies of images are the same."""
    images = []
    for run in runs:
        (opened := open_run(run)).check_pair()
        inputs = opened.report["inputs"]
        images.append([inputs[side].get(key) for side in ("left", "right") for key in ("bytes", "sha256", "etag")])
        if images[-1] != images[0]:
            raise SatIntervalsError(f"{run} is a run of other images than {runs[0]}: give runs of one pair")


def draw_coverage(runs: Sequence[Path], target: Path, dpi: int = canvas.DPI, **judging: Any) -> None:
    """Draw nominal coverage and mean width against measured coverage, of runs of one pair at several coverages."""
    reports = sorted((evaluate_run(run, **judging) for run in runs), key=lambda report: float(report["nominal"]))
    with canvas.page(target, (9.0, 4.2), dpi, f"{', '.join(run.name for run in runs)}: intervals and truth") as figure:
        left, right = figure.subplots(1, 2)
        deciles = [(report["nominal"], decile) for report in reports for decile in report["deciles"]]
        series = [("deciles of confidence", canvas.INK, ".", deciles)]
        for name, label, colour in _CLASSES:
            known = [(report["nominal"], report[name]) for report in reports if report[name]["count"]]
            series.append((label, colour, "o-", known))
        for label, colour, style, points in series:
            nominal, measured = [one for one, _ in points], [area["accuracy"] for _, area in points]
            left.plot(nominal, measured, style, color=colour, ms=5, lw=1, label=label)
            right.plot(measured, [area["mean_width"] for _, area in points], style, color=colour, ms=5, lw=1)
        left.plot([0, 1], [0, 1], color=canvas.INK, lw=0.8, ls="--")
        left.set(xlabel="nominal coverage (or alpha)", ylabel="measured coverage", xlim=(0.45, 1), ylim=(0, 1.02))
        left.legend(loc="lower right", frameon=False)
        right.set(xlabel="measured coverage", ylabel="mean width (px)", yscale="log")
        canvas.plain_logarithm(right.yaxis)


def draw_reliability(report: dict[str, Any], target: Path, name: str, dpi: int = canvas.DPI) -> None:
    """Draw the half widths of intervals against those that would have been needed, and coverage, by class of them."""
    nominal = report["nominal"]
    kinds = [kind for kind in report["half_width"] if kind["with_interval"] >= _WORTH]
    with canvas.page(target, (9.0, 4.2), dpi, f"{name}: intervals and reference") as figure:
        left, right = figure.subplots(1, 2)
        stated = [kind["mean_half_width"] for kind in kinds]
        if nominal is not None:
            needed = [kind["needed_half_width"] for kind in kinds]
            left.plot(stated, needed, "o-", color=BLUE, lw=1, ms=5)
            left.set_ylabel(f"|height - reference| of {100 * nominal:g} % of cells (m)")
            right.axhline(nominal, color=canvas.INK, lw=0.8, ls="--", label="nominal")
        ends = [max(0.05, 0.8 * min(stated, default=0.1)), 1.25 * max(stated, default=10.0)]
        left.plot(ends, ends, color=canvas.INK, lw=0.8, ls="--", label="intervals as wide as needed")
        left.set(xlabel="mean half width of intervals (m)", xscale="log", yscale="log")
        for axis in (left.xaxis, left.yaxis):
            canvas.plain_logarithm(axis)
        left.legend(loc="upper left", frameon=False)
        right.bar(range(len(kinds)), [kind["coverage"] for kind in kinds], color=BLUE, width=0.7)
        right.axhline(report["all"]["coverage"] or 0.0, color=ORANGE, lw=1, label="measured, all cells")
        right.set_xticks(range(len(kinds)), [_limits(kind) for kind in kinds], fontsize=8)
        right.set(xlabel="half width of the interval (m)", ylabel="share of reference heights inside", ylim=(0, 1.15))
        right.legend(loc="upper right", frameon=False, ncols=2)
        for place, kind in enumerate(kinds):
            right.text(place, 0.02, f"{kind['with_interval']:,}", ha="center", fontsize=7, color="white", rotation=90)


def _limits(kind: dict[str, Any]) -> str:
    return f"{kind['from']:g}+" if kind["to"] is None else f"{kind['from']:g}-{kind['to']:g}"


def draw_error_map(given: Comparison, nmad: float, target: Path, dpi: int = canvas.DPI) -> None:
    """Draw height - reference, within three NMAD of 0; large surfaces are sampled."""
    errors, extent = error_map(given, _LONGEST)
    end = max(3 * nmad, 0.1)
    height, width = canvas.map_size(errors.shape, 7.0)
    name = f"{given.surface.name} - {given.reference.name}"
    unit, empty = "height - reference (m), red: too high", "no common height"
    layer = canvas.MapLayer("", unit, errors, "RdBu_r", (-end, end), if_empty=empty)
    with canvas.page(target, (width + 1.8, height + 0.8), dpi, name) as figure:
        canvas.draw_layer(figure.subplots(), canvas.PlotFrame(*extent, canvas.GROUND), layer)


def draw_height_profile(profile: Profile, target: Path, names: Sequence[str], dpi: int = canvas.DPI) -> None:
    """Draw heights, their intervals and the reference along a line; ``names`` of surface and reference."""
    with canvas.page(target, (11.0, 4.0), dpi, f"{names[0]} and {names[1]} along a line") as figure:
        chart = figure.subplots()
        chart.fill_between(
            profile.distance, profile.lower, profile.upper, color=BLUE, alpha=0.3, lw=0, label="interval"
        )
        chart.plot(profile.distance, profile.height, color=BLUE, lw=1, label="height")
        chart.plot(profile.distance, profile.reference, color=ORANGE, lw=1, label="reference")
        (x, y), (last_x, last_y) = profile.ends
        chart.set(xlabel=f"metres from {x:.1f}, {y:.1f} to {last_x:.1f}, {last_y:.1f}", ylabel="height (m)")
        chart.legend(loc="upper right", frameon=False, ncols=3)
        chart.margins(x=0)
        known = profile.reference[np.isfinite(profile.reference)]
        if known.size:  # wide intervals would flatten the ground
            low, high = np.percentile(known, (0, 100))
            room = max(0.5 * (high - low), 5.0)
            chart.set_ylim(low - room, high + room)
        canvas.say_empty(chart, profile.height, "no height")
