"""``sat-intervals match``: match two epipolar GeoTIFFs."""

from pathlib import Path

import click

from sat_intervals.cli.images import PairArguments, pair_options
from sat_intervals.cli.matching import RunArguments, SettingsArguments, run_options, search_options
from sat_intervals.cli.options import FILE, Grouped


@click.command(cls=Grouped, short_help="Match a pair: disparity, interval, confidence, validity.")
@search_options
@pair_options
@click.argument("out", type=FILE)
@run_options
def match(pair: PairArguments, out: Path, settings: SettingsArguments, run: RunArguments) -> None:
    """Match the epipolar images LEFT and RIGHT and write to the folder OUT, which may be in a bucket: s3://bucket/run.

    \b
    OUT/intervals.tif   disparity, lower and upper bound (pixels), confidence
    OUT/validity.tif    flags: why a pixel is invalid, how it was processed
    OUT/run.json        settings, inputs, statistics

    The disparity is x_right - x_left; its search range is found unless it is given. To resume an interrupted run,
    rerun the same command.
    """  # noqa: D301 (click's mark of a preformatted paragraph)
    from sat_intervals.cli.logs import warn
    from sat_intervals.raster import path_of

    config = settings.load()
    if run.says_job(config, out):
        return
    with run.console() as console:
        settings.check_kept(out)
        left, right = pair.open()
        report = run.match(left, right, out, config, window=pair.window, progress=console.progress)
    run.say(report)
    console.summary(report, out, then="report")
    if out.resolve() in (path_of(image).parent.resolve() for image in (pair.left, pair.right)):
        warn([f"{out} also holds the images: write to another folder"])
    run.check_strict(report["warnings"])
