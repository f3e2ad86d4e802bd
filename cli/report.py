"""``sat-intervals report``: a finished run as one page for a browser."""

from pathlib import Path

import click

from sat_intervals.cli.options import log_options

_FILE = click.Path(path_type=Path)


@click.command(short_help="Make a page of a finished run to look at in a browser.")
@click.argument("out", type=_FILE)
@click.option("--truth", type=_FILE, help="True disparity; default truth.tif beside the left image, if there is one.")
@log_options
def report(out: Path, truth: Path | None) -> None:
    """Write OUT/report.html: one file for any browser, which needs no network and nothing beside it.

    Map and interval profile of any row, histograms, validity, tiles and seams, settings and times, and with a truth how
    often the intervals hold it. Of large images the map and the profiles show every n-th row and column.
    """
    from sat_intervals.results import open_results
    from sat_intervals.show.report import write_report

    click.echo(write_report(open_results(out, truth)))
