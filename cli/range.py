"""``sat-intervals range``: find the search range of a pair, with its evidence."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from sat_intervals.cli.images import PairArguments, pair_options
from sat_intervals.cli.logs import warn
from sat_intervals.cli.options import FILE, Grouped, Printing, overwrite_option, printing_options

# Bars of the histogram that are printed, each of several bins.
_BARS = 8


@click.command("range", cls=Grouped, short_help="Find the search range of a pair.")
@pair_options
@click.option("--output", type=FILE, help="Write the local ranges, for the setting disparity.grid of match.")
@overwrite_option
@printing_options
def search_range(pair: PairArguments, output: Path | None, overwrite: bool, printing: Printing) -> None:
    """Find the search range of the epipolar images LEFT and RIGHT, as match does without --disparity.

    Prints the range and its evidence; --output keeps the ranges of the cells. --window has no effect: a range is always
    that of the whole images.
    """
    from sat_intervals.run.preparing import range_of_pair

    with printing.console() as console:
        left, right = pair.open()
        found, survey, warnings = range_of_pair(left, right, output, overwrite=overwrite, progress=console.progress)
    printing.say(found.report() | {"survey": survey.report()})
    if printing.as_json:
        return
    for name, value in (*_rows(found), *_survey(survey)):
        click.echo(f"{name:<36}{value}")
    warn(warnings)


def _rows(found: Any) -> Iterator[tuple[str, str]]:
    yield "search range", f"{found.minimum} to {found.maximum} px"
    yield "consistent matches", f"{100 * found.matched:.1f} % of the left pixels"
    yield "local ranges, of the whole", f"{100 * found.local.share:.0f} %"
    for level in found.levels:
        searched = f"{level.minimum} to {level.maximum} px searched, {100 * level.matched:.1f} % matched"
        yield f"  images reduced by {level.step}", searched
    edges, counts = found.histogram["edges"], found.histogram["counts"]
    each = len(counts) // _BARS
    for first in range(0, len(counts), each):
        share = 100 * sum(counts[first : first + each]) / max(sum(counts), 1)
        yield f"  {edges[first]:.0f} to {edges[first + each]:.0f} px", f"{share:.1f} % of the matches"
    for side, border in found.undeclared.items():
        share = f"{100 * border['share']:.0f} % of the pixels, along the borders"
        yield f"{side} image, value {border['value']:g}", share


def _survey(survey: Any) -> Iterator[tuple[str, str]]:
    if survey.noise is not None:
        yield "distance of matches", f"{survey.noise:.2f} of that of random pixels"
    found = survey.rows
    if found is None:
        yield "rows of the two images", "not compared: too few matches"
        return
    for name, (median, most) in (("rows of the two images", found.before), ("  from a smooth function", found.after)):
        yield name, f"differ by {median:.2f} px, 90 % at most {most:.2f} px"
    does = "taken out with rows auto" if survey.is_large and not found.contradiction else "left as they are"
    yield "  its largest", f"{found.most:.2f} px, of {found.matches} matches; {does}"
