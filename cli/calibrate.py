"""``sat-intervals calibrate``: find the levels that reach a coverage, on pairs with known truth."""

from pathlib import Path
from typing import Any

import click

from sat_intervals.cli import options
from sat_intervals.cli.calibrate_dsm import calibrate_heights
from sat_intervals.cli.matching import SettingsArguments, options_without_levels


@click.command(cls=options.Grouped, short_help="Find what intervals need for a coverage, with a truth.")
@click.argument("pairs", nargs=-1, type=options.FILE)
@click.option("--output", type=options.FILE, required=True, help="Calibration to write (YAML).")
@options.overwrite_option
@click.option(
    "--truth", "truths", type=options.FILE, multiple=True, help="True disparity; one for each of PAIRS, in that order."
)
@options.tolerance_option
@click.option("--remove-bias", is_flag=True, help="Add the median of disparity - truth of each pair to its truth.")
@click.option(
    "--by-group", is_flag=True, help="Leave out all pairs of a group together (meta.json, CSV), not each pair."
)
@click.option("--name", help="Name of the calibration; by default that of the file.")
@options.surface_options("Calibrate this surface model against --reference, instead of pairs.", "pairs", "coverage")
@options.printing_options
@click.option(
    "--coverage",
    type=float,
    metavar="C",
    help="With --dsm: coverage that the margins must reach, .5 to .99; default: the coverage of the runs.",
)
@options_without_levels
def calibrate(
    pairs: tuple[Path, ...],
    output: Path,
    surface: options.Surface | None,
    coverage: float | None,
    settings: SettingsArguments,
    printing: options.Printing,
    **how: Any,
) -> None:
    """Find the levels of the cost curve whose intervals reach coverages of .5 to .99 on PAIRS, and write them to FILE.

    Use FILE with: match --coverage 0.9 --calibration FILE. It is valid for images like those of PAIRS, and only with
    the same settings.

    One of PAIRS is a folder with left.tif, right.tif, truth.tif and meta.json (`disparity`: [minimum, maximum],
    `group`), a CSV, YAML or JSON file with left, right, truth, minimum, maximum and optionally name, group, tolerance
    and remove_bias, or the folder of a finished run, which is matched again from its images. The truth may be sparse:
    unknown pixels are NaN or no data.

    The table shows what to expect: figures of each pair with the levels found on the others, means over pairs. A single
    pair is split into 16 blocks, and each block is evaluated with the levels found on the other 15.

    With --dsm: find margins in metres, so that the intervals of a surface model contain the required share of the
    heights of --reference (its own coverage, or --coverage). Use FILE with: dsm --calibration FILE; of three images or
    more: surface --height-calibration FILE.
    """
    if surface is not None:
        calibrate_heights(surface, output, how["name"], coverage, printing, overwrite=how["overwrite"])
        return
    if not pairs:
        raise click.UsageError("give PAIRS, or --dsm and --reference.")
    from sat_intervals.cli.tables import show_calibration
    from sat_intervals.workflows.calibrate import calibrate

    with printing.console() as console:
        calibration, expected = calibrate(
            pairs, output, settings.file, overrides=settings.sections, progress=console.progress, **how
        )
    printing.say({"calibration": calibration.model_dump(mode="json"), "expected": expected})
    if not printing.is_silent:
        show_calibration(calibration, expected)
        click.echo(str(output))
