"""``sat-intervals change``: what changed between two dates, at a named rate of false alarms."""

from pathlib import Path
from typing import Any

import click

from sat_intervals.cli import options
from sat_intervals.cli.logs import warn


@click.command(cls=options.Grouped, short_help="Find changes between two dates at a named rate of false alarms.")
@click.argument("before", type=options.FILE)
@click.argument("after", type=options.FILE)
@click.argument("out", type=options.FILE)
@click.option("--false-alarms", type=float, default=0.01, show_default=True, metavar="SHARE",
              help="Share of the cells without a change that may count as changed.")  # fmt: skip
@click.option("--smallest-area", type=float, default=50.0, show_default=True, metavar="M2",
              help="Square metres that an area of change has at least.")  # fmt: skip
@click.option("--stable", type=options.FILE,
              help="Ground without a change, to check the rate: a raster, not 0 there, or polygons.")  # fmt: skip
@options.expert_option("--sigma", type=float, metavar="METRES",
                       help="Standard deviation of heights of surfaces of other tools.")  # fmt: skip
@options.expert_option("--no-register", is_flag=True, help="Do not move AFTER to BEFORE by their constant shift.")
@options.overwrite_option
@options.printing_options
def change(before: Path, after: Path, out: Path, no_register: bool, printing: options.Printing, **how: Any) -> None:
    """Compare the surface models BEFORE and AFTER, files or folders with a dsm.tif, and write to the folder OUT:

    \b
    OUT/change.tif     difference AFTER - BEFORE, its bounds, significance, change
    OUT/changes.gpkg   areas of change: mean difference, volume, their errors
    OUT/change.json    figures

    AFTER is moved to BEFORE by their constant shift, as the reference in `evaluate`, and resampled to its cells, with
    the worst bounds of the cells it draws from. Significance is the probability of a difference as large without a
    change. Surfaces of other tools need --sigma, or a band named sigma. Polygons need the extra [reference]. Then: plot
    OUT, report OUT, project OUT.
    """  # noqa: D301, D400 (\b keeps the line breaks in click)
    from sat_intervals.cli.tables import change_lines
    from sat_intervals.workflows.change import FILES, change

    with printing.console() as console:
        report = change(before, after, out, registers=not no_register, **how, progress=console.progress)
    printing.say(report)
    for line in change_lines(report):
        console.say(line)
    warn(report["warnings"])
    for name in FILES:
        if (out / name).exists():
            console.say(str(out / name))
