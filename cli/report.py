"""``sat-intervals report``: write an HTML page of a finished run."""

from pathlib import Path

import click

from sat_intervals.cli.options import FILE, log_options, truth_option


@click.command(short_help="Write an HTML page of a finished run.")
@click.argument("out", type=FILE)
@truth_option
@log_options
def report(out: Path, truth: Path | None) -> None:
    """Write OUT/report.html, one self-contained file for any browser.

    It shows maps, the interval profile of any row, histograms, validity, tiles, settings and times. With a
    truth, it also shows how often the intervals contain it; with dsm.tif, hillshade, half widths and completeness. For
    large images, maps and profiles show every n-th row and column. Of a folder of `change` it has its figures and, once
    `plot` has drawn it, the map. Of the folder of a batch each pair that is done gets its page.
    """
    from sat_intervals.cli.tables import change_lines
    from sat_intervals.results import open_results, read_change
    from sat_intervals.run.status import runs_of
    from sat_intervals.show.report.change_page import write_change_page
    from sat_intervals.show.report.page import write_report

    if changed := read_change(out):
        click.echo(write_change_page(out, changed, change_lines(changed)))
        return
    for run in runs_of(out):
        click.echo(write_report(open_results(run, truth)))
