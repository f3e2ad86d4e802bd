"""Print tables."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.table import Table

from sat_intervals.evaluate.paper import ACCURACY, OBJECTIVE, TABLE_1, SceneMetrics, look_up, mean, table_1

if TYPE_CHECKING:
    from sat_intervals.config import Calibration

# Characters of a line in a file or a pipe: lines are not wrapped.
_WIDEST = 10_000
# What the nominal level of intervals is, in reports and for a reader.
_NOMINAL = {"coverage": "coverage asked for", "alpha": "alpha"}
_EXPECTED = ("all", "high", "edge", "low", "lowest", "mean_width", "median_width", "score")
_PRECISE = 0.02  # standard error of a coverage that is precise


def show(header: Sequence[str], rows: Sequence[Sequence[str]], title: str) -> None:
    """Print a table with labels in the first column and figures in the others."""
    terminal = Console(highlight=False, markup=False, emoji=False)
    if not terminal.is_terminal:
        terminal.width = _WIDEST
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
    table.add_column(header[0], overflow="fold")
    for name in header[1:]:
        table.add_column(name.replace(" ", "\n") if terminal.is_terminal else name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    terminal.print(title, soft_wrap=True)
    terminal.print(table)


def show_scenes(scenes: Sequence[SceneMetrics]) -> None:
    """Print the paper's table 1, and each scene's coverage beside the one asked for, with widths and scores."""
    groups = [
        [row.label, str(row.scenes), str(row.at_objective), *map(_figure, row.figures.values())]
        for row in table_1(scenes)
    ]
    show(["", "scenes", f">= {OBJECTIVE}", *TABLE_1], groups, "means over scenes, valid pixels")
    accuracies = {scene.name: look_up(scene.report, ACCURACY) for scene in scenes}
    missed = [f"{name} ({_figure(value)})" for name, value in accuracies.items() if (value or 0.0) < OBJECTIVE]
    if missed:
        click.echo(f"below {OBJECTIVE}: {', '.join(missed)}")
    paths = [
        ("nominal",), ("all", "accuracy"), ("high", "accuracy"), ("low", "accuracy"), ("all", "mean_width"),
        ("all", "median_width"), ("all", "interval_score"), ("median_error",),
    ]  # fmt: skip
    figures = {scene.name: [look_up(scene.report, path) for path in paths] for scene in scenes}
    figures["mean"] = [mean(column) for column in zip(*figures.values(), strict=True)]
    nominal = " or ".join(sorted({_NOMINAL[scene.report["nominal_is"]] for scene in scenes}, reverse=True))
    header = ["", nominal, "coverage", "high", "low", "mean width", "median width", "score", "median error"]
    rows = [[name, *map(_figure, values)] for name, values in figures.items()]
    show(header, rows, f"{nominal}, measured coverage, widths, interval score and disparity - truth (px)")


def show_scene(scene: SceneMetrics) -> None:
    """Print all figures of one scene."""
    report = scene.report
    rows = _areas(report, "")
    if report["with_rejected"]:
        rows += _areas(report["with_rejected"], ", with rejected")
    header = ["", "pixels", "coverage", "mean width (px)", "median width (px)", "interval score (px)"]
    show(header, rows, scene.name)
    if not report["all"]["count"]:
        click.echo("no valid pixel has a known truth: check truth and mask")
    click.echo(_nominal_line(report))
    bad = [_figure(report[name]) for name in ("bad1", "bad3")]
    click.echo(f"disparity wrong by more than 1 px: {bad[0]}, by more than 3 px: {bad[1]}")
    if report["locking"] is not None:
        click.echo(f"locking to whole pixels (0 none, 1 whole pixels only): {_figure(report['locking'])}")
    if report["median_error"] is not None:
        click.echo(f"median of disparity - truth: {report['median_error']:+.3f} px")
    if report["tolerance"]:
        click.echo(f"truth up to {report['tolerance']:g} px outside an interval counts as inside")
    if report["bias"] is not None:
        click.echo(f"added to the truth before: {report['bias']:+.3f} px")
    if report["truth_outside_range"]:
        share = _figure(report["truth_outside_range"])
        click.echo(f"truth outside the search range, always missed: {share} (its sign: x_right = x_left + disparity)")
    deciles = [
        ["{:.3f} to {:.3f}".format(*decile["confidence"]), *_measures(decile, "accuracy", "mean_width")]
        for decile in report["deciles"]
    ]
    if deciles:
        show(["confidence", "pixels", "coverage", "mean width (px)"], deciles, "by decile of confidence")
    high, low = report["high"], report["low"]
    if high["count"] and low["count"] and high["accuracy"] < low["accuracy"] - 0.005:
        click.echo(
            "confident pixels are covered less often than doubtful ones: errors of the truth and of sub-pixel "
            f"disparities count in intervals of {high['mean_width']:.2f} px, not in {low['mean_width']:.2f} px"
        )


# Columns of the figures of a surface model: key, and heading.
_ACCURACY = {
    "count": "cells", "bias": "bias (m)", "median": "median (m)", "nmad": "NMAD (m)", "rmse": "RMSE (m)",
    "le90": "LE90 (m)", "p95_p5": "P95-P5 (m)", "coverage": "coverage",
    "coverage_deviation": "standard error", "mean_half_width": "mean half width (m)",
    "median_half_width": "median half width (m)", "interval_score": "interval score (m)",
    "completeness": "with height", "within": "within {within:g} m",
}  # fmt: skip


def show_surface(name: str, report: dict[str, Any]) -> None:
    """Print the figures of a surface model: registration, then all cells and classes."""
    for line in registration_lines(report["registration"]):
        click.echo(line)
    show(*_surface_table(report), name)
    for line in _notes(report):
        click.echo(line)


def surface_markdown(name: str, report: dict[str, Any]) -> str:
    """Return the figures of a surface model as a Markdown document."""
    header, rows = _surface_table(report)
    table = [header, ["---"] * len(header), *rows]
    lines = [f"# {name}", "", *(f"- {line}" for line in registration_lines(report["registration"])), ""]
    lines += [f"| {' | '.join(row)} |" for row in table]
    return "\n".join([*lines, "", *(f"- {line}" for line in _notes(report)), ""])


def _surface_table(report: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of the figures of a surface model."""
    named = [("all cells", report["all"])]
    if report["registration"]:
        named = [("all cells, before registration", report["before"]), ("all cells, after", report["all"])]
    for key, label in (("slope", "slope {} degrees"), ("half_width", "half width {} m")):
        for kind in report[key]:
            ends = f"{kind['from']:g} to {kind['to']:g}" if kind["to"] is not None else f"from {kind['from']:g}"
            named.append((label.format(ends), kind))
    named += [(f"class {kind['class']}", kind) for kind in report["classes"]]
    keys = list(_ACCURACY)[1:]
    header = ["", *(name.format(**report) for name in _ACCURACY.values())]
    return header, [[label, *_measures(kind, *keys)] for label, kind in named]


def _notes(report: dict[str, Any]) -> list[str]:
    return [
        "errors are height - reference; bias is their mean; LE90: 90 % of the absolute errors are not larger",
        "with height, within: shares of the reference heights that have a height, and one with an error up to that",
        *points_lines(report["points"], report["all"]["with_interval"], report["all"]["coverage_deviation"]),
        _nominal_line(report),
        *_ranking_lines(report["ranking"]),
        *report["warnings"],
    ]


def points_lines(points: dict[str, float] | None, count: int, deviation: float | None) -> list[str]:
    """Return what the coverage of points is, and how many a precise one takes; ``count``: those with an interval."""
    if points is None or deviation is None:
        return []
    noise = "coverage is that of the true heights, other figures include errors of the points"
    needed = math.ceil(count * (deviation / _PRECISE) ** 2)
    return [
        *([f"{noise} (standard deviation {points['sigma']:g} m)"] if points["sigma"] else []),
        f"{count} points give the coverage with a standard error of {deviation:.3f}: one of {_PRECISE:g} takes about "
        f"{needed} like these",
    ]


def _ranking_lines(ranking: dict[str, float | None]) -> list[str]:
    """Return a line that says how well half widths rank errors."""
    if ranking["half_width"] is None:
        return []
    return [
        f"AUSE of half widths {ranking['half_width']:.3f}, of the range of heights in 5 x 5 cells alone "
        f"{ranking['relief']:.3f}: how far the error of what is left, as the most doubtful cells go, is above the "
        "least possible, in mean errors; 0: widths rank cells as errors do"
    ]


def _nominal_line(report: dict[str, Any]) -> str:
    """Return a line about the coverage asked for, or alpha."""
    if report["nominal"] is None:
        return "coverage asked for: unknown, so no interval scores"
    return (
        f"{_NOMINAL[report['nominal_is']]}: {report['nominal']:g}; interval score: width, and 2 / (1 - that) times "
        "each miss, less is better"
    )


def change_lines(report: dict[str, Any]) -> list[str]:
    """Return lines about a change of height: shift, shares, volumes, and the rate of false alarms."""
    cells, rate = report["cells"], report["rate"]
    share = {name: f"{100 * count / max(1, cells['compared']):.2f} %" for name, count in cells.items()}
    volumes = (f"{name} {value:.0f} +-{deviation:.0f}" for name, (value, deviation) in report["volume"].items())
    bulk = f"half of the differences are below {rate['median']:.2f} standard deviations"
    checked = f"without --stable, checked on the bulk alone: {bulk}"
    if rate["stable"]:
        checked = f"{100 * rate['measured']:.2g} % measured on {rate['stable']} stable cells"
    return [
        *registration_lines(report["registration"], "second surface")[:1],
        f"{report['areas']} areas of {report['smallest_area']:g} m2 or more: {share['risen']} of the cells risen, "
        f"{share['fallen']} fallen",
        f"volumes with standard deviations (m3): {', '.join(volumes)}",
        f"{100 * cells['undecided'] / (cells['undecided'] + cells['compared']):.1f} % of the cells without a decision",
        f"false alarms: {100 * rate['named']:g} % named; {checked}",
    ]


def shift_of(found: dict[str, Any]) -> str:
    """Return a shift in words, with standard deviations where they are known."""
    named = zip(("easting", "northing", "height"), found["shift"], found["deviation"], strict=True)
    return ", ".join(
        f"{axis} {value:+.2f} m" + ("" if deviation is None else f" (standard deviation {deviation:.2g})")
        for axis, value, deviation in named
    )


def registration_lines(found: dict[str, Any] | None, moved: str = "reference") -> list[str]:
    """Return lines for the user about a registration: the shift, and figures before and after it."""
    if found is None:
        return []
    shift = shift_of(found)
    lines = [f"{moved} moved: {shift}"]
    if not any(found["shift"]) and found["is_horizontal"]:
        deviations = ", ".join(f"{value:.2g} m" for value in found["deviation"])
        lines = [f"{moved} not moved: its shift is less than two standard deviations, {deviations}"]
    if not found["is_horizontal"]:
        lines = [
            f"{moved} moved: {shift.rpartition(', ')[2]}; easting and northing cannot be determined: flat ground, or a "
            f"{moved} many cells off"
        ]
    for when in ("before", "after"):
        figures = found[when]
        lines.append(
            f"height - reference {when}: median {figures['median']:.2f} m, NMAD {figures['nmad']:.2f} m, "
            f"LE90 {figures['le90']:.2f} m, {figures['count']} points"
        )
    return lines


def show_calibration(calibration: "Calibration", expected: Sequence[dict[str, float]]) -> None:
    """Print what to expect of a calibration, its levels and its notes."""
    rows = []
    for row, levels in zip(expected, calibration.levels, strict=True):
        quantile = "none" if levels.quantile is None else f"{levels.quantile:g}"
        figures = [_figure(row.get(key)) for key in _EXPECTED if key != "edge" or levels.edge is not None]
        high = [f"{level:.4g}" for level in (levels.high, levels.edge) if level is not None]
        rows.append([f"{levels.coverage:g}", *figures, *high, f"{levels.low:.1f}", quantile])
    has_edges = calibration.levels[0].edge is not None
    names = [key.replace("_", " ") for key in _EXPECTED if key != "edge" or has_edges]
    factors = ["factor high", "factor edge"] if has_edges else ["level high"]
    header = ["coverage", *names, *factors, "level low", "quantile"]
    show(header, rows, "expected: coverage, widths and score (px) of pairs left out, and levels")
    for note in calibration.provenance["notes"]:
        click.echo(note)


def _areas(report: dict[str, Any], where: str) -> list[list[str]]:
    """Return rows for all pixels counted and for those of high and low confidence."""
    columns = "accuracy", "mean_width", "median_width", "interval_score"
    names = {"all": "all pixels" if where else "valid pixels", "high": "high confidence", "low": "low confidence"}
    return [[name + where, *_measures(report[key], *columns)] for key, name in names.items()]


def _measures(area: dict[str, float | None], *columns: str) -> list[str]:
    return [str(area["count"]), *(_figure(area.get(column)) for column in columns)]


def _figure(value: float | None) -> str:
    """Format a figure with three decimals, or a dash for None and NaN."""
    return "-" if value is None or math.isnan(value) else f"{value:.3f}"
