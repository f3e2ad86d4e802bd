"""``sat-intervals match``: match two epipolar GeoTIFFs."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.options import (
    check_strict,
    disparity_option,
    grid_option,
    image_options,
    json_option,
    local_option,
    named,
    path,
    run_options,
    say_json,
    settings_options,
    with_range,
)

if TYPE_CHECKING:
    from sat_intervals.raster import Image
    from sat_intervals.tiling import Window


@click.command(short_help="Match a pair: disparity, interval, confidence, validity.")
@click.argument("left", callback=named)
@click.argument("right", callback=named)
@click.argument("out", callback=path)
@disparity_option
@local_option
@grid_option
@image_options
@click.option("--dry-run", is_flag=True, help="Print the job script of the cluster; submit nothing.")
@json_option
@settings_options
@run_options
def match(
    left: str,
    right: str,
    out: Path,
    disparity: tuple[int, int] | None,
    local_range: bool,
    range_grid: str | None,
    open_images: "Callable[[str, str], tuple[Image, Image]]",
    window: "Window | None",
    dry_run: bool,
    as_json: bool,
    config_file: Path | None,
    given: dict[str, Any],
    keep_tiles: bool,
    overwrite: bool,
    strict: bool,
    quiet: bool,
) -> None:
    """Match the epipolar images LEFT and RIGHT and write to the folder OUT.

    \b
    OUT/intervals.tif   disparity, lower and upper bound (pixels), confidence
    OUT/validity.tif    flags: why a pixel is invalid, how it was processed
    OUT/run.json        settings, inputs, statistics

    The disparity is x_right - x_left; its search range is found unless it is given. To resume an interrupted run,
    rerun the same command.
    """  # noqa: D301 (click's mark of a preformatted paragraph)
    from sat_intervals.cli.console import Console
    from sat_intervals.config import load_config

    config = load_config(config_file, with_range(given, disparity, local_range, range_grid))
    if dry_run:
        from sat_intervals.run.batch_system import job_script

        click.echo(job_script(config.cluster, out))
        return
    with Console(quiet or as_json) as console:
        from sat_intervals.raster.identity import check_not_replaced
        from sat_intervals.run.output import OUTPUTS
        from sat_intervals.run.pair import match_pair

        check_not_replaced([config_file], [out / name for name in OUTPUTS], [out / "tiles"])
        images = open_images(left, right)
        kept: dict[str, Any] = {"keep_tiles": keep_tiles, "overwrite": overwrite}
        report = match_pair(*images, out, config, window=window, progress=console.progress, **kept)
    if as_json:
        say_json(report)
    console.summary(report, out, then="report")
    check_strict(strict, report["warnings"])
