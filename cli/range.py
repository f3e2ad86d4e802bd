"""``sat-intervals range``: find the search range of a pair, with its evidence."""

from pathlib import Path
from typing import Any

import click

from sat_intervals.cli.logs import warn
from sat_intervals.cli.matching import PairArguments, pair_options
from sat_intervals.cli.options import FILE, Grouped, json_option, log_options, overwrite_option, quiet_option, say_json

# Bars of the histogram that are printed, each of several bins.
_BARS = 8


@click.command("range", cls=Grouped, short_help="Find the search range of a pair.")
@pair_options
@click.option("--output", type=FILE, help="Write the local ranges, for the setting disparity.grid of match.")
@overwrite_option
@json_option
@quiet_option
@log_options
def search_range(pair: PairArguments, output: Path | None, overwrite: bool, as_json: bool, quiet: bool) -> None:
    """Find the search range of the epipolar images LEFT and RIGHT, as match does without --disparity.

    Prints the range and its evidence; --output keeps the ranges of the cells. --window has no effect: a range is always
    that of the whole images.
    """
    from sat_intervals.cli.console import Console
    from sat_intervals.run.preparing import range_of_pair

    with Console(quiet or as_json) as console:
        left, right = pair.open()
        found, survey, warnings = range_of_pair(left, right, output, overwrite=overwrite, progress=console.progress)
    if as_json:
        say_json(found.report() | {"survey": survey.report()})
        return
    for name, value in [*_rows(found), *_survey(survey)]:
        click.echo(f"{name:<36}{value}")
    warn(warnings)


def _rows(found: Any) -> list[tuple[str, str]]:
    rows = [("search range", f"{found.minimum} to {found.maximum} px")]
    rows.append(("consistent matches", f"{100 * found.matched:.1f} % of the left pixels"))
    rows.append(("local ranges, of the whole", f"{100 * found.local.share:.0f} %"))
    for level in found.levels:
        searched = f"{level.minimum} to {level.maximum} px searched, {100 * level.matched:.1f} % matched"
        rows.append((f"  images reduced by {level.step}", searched))
    rows += _histogram(found.histogram)
    for side, border in found.undeclared.items():
        share = f"{100 * border['share']:.0f} % of the pixels, along the borders"
        rows.append((f"{side} image, value {border['value']:g}", share))
    return rows


def _survey(survey: Any) -> list[tuple[str, str]]:
    rows = []
    if survey.noise is not None:
        rows.append(("distance of matches", f"{survey.noise:.2f} of that of random pixels"))
    found = survey.rows
    if found is None:
        rows.append(("rows of the two images", "not compared: too few matches"))
    else:
        for name, (median, most) in (
            ("rows of the two images", found.before),
            ("  from a smooth function", found.after),
        ):
            rows.append((name, f"differ by {median:.2f} px, 90 % at most {most:.2f} px"))
        does = "taken out with rows auto" if survey.is_large and not found.contradiction else "left as they are"
        rows.append(("  its largest", f"{found.most:.2f} px, of {found.matches} matches; {does}"))
    return rows


def _histogram(histogram: dict[str, list[float]]) -> list[tuple[str, str]]:
    edges, counts = histogram["edges"], histogram["counts"]
    each = len(counts) // _BARS
    bars = [sum(counts[first : first + each]) for first in range(0, len(counts), each)]
    return [
        (
            f"  {edges[each * i]:.0f} to {edges[each * (i + 1)]:.0f} px",
            f"{100 * bar / max(sum(bars), 1):.1f} % of the matches",
        )
        for i, bar in enumerate(bars)
    ]
