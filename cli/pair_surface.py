"""``sat-intervals surface``: from two epipolar images to a surface model in one command."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.dsm import calibration_option, cell_options, say_surface
from sat_intervals.cli.options import (
    check_strict,
    disparity_option,
    grid_option,
    image_options,
    local_option,
    named,
    path,
    run_options,
    sensor_options,
    settings_options,
    with_range,
)

if TYPE_CHECKING:
    from sat_intervals.config import Interval
    from sat_intervals.raster import Image
    from sat_intervals.tiling import Window


@click.command(short_help="Match a pair, triangulate it and make a surface model.")
@click.argument("left", callback=named)
@click.argument("right", callback=named)
@click.argument("out", callback=path)
@sensor_options
@cell_options
@calibration_option("--height-calibration")
@disparity_option
@local_option
@grid_option
@image_options
@settings_options
@run_options
def surface(
    left: str,
    right: str,
    out: Path,
    sensor_files: tuple[Path, Path, Path, Path],
    cells: dict[str, Any],
    disparity: tuple[int, int] | None,
    local_range: bool,
    range_grid: str | None,
    open_images: "Callable[[str, str], tuple[Image, Image]]",
    window: "Window | None",
    config_file: Path | None,
    given: dict[str, Any],
    keep_tiles: bool,
    overwrite: bool,
    strict: bool,
    quiet: bool,
) -> None:
    """Match the epipolar images LEFT and RIGHT, triangulate the run, and write its surface model to OUT/dsm.tif.

    The same as `match`, `triangulate` and `dsm`, with their options and files. To resume, rerun the same command: a
    finished match with these images and settings is kept, points and surface are made again.
    """
    from sat_intervals.cli.console import Console
    from sat_intervals.config import load_config

    config = load_config(config_file, with_range(given, disparity, local_range, range_grid))
    with Console(quiet) as console:
        from sat_intervals.heights.dsm import make_surface
        from sat_intervals.heights.triangulate import triangulate
        from sat_intervals.run.before import report_before
        from sat_intervals.run.pair import match_pair

        _check(out, cells, sensor_files, config_file, config.interval)
        images = open_images(left, right)
        report = None if overwrite else report_before(*images, out, config, window)
        if report is None:
            tiles: dict[str, Any] = {"window": window, "keep_tiles": keep_tiles, "overwrite": overwrite}
            report = match_pair(*images, out, config, **tiles, progress=console.progress)
        triangulate(out, *sensor_files, progress=console.progress)
        made = make_surface([out], out / "dsm.tif", **cells, progress=console.progress)
    console.summary(report, out)
    say_surface(console, made)
    console.say(str(out / "dsm.tif"))
    check_strict(strict, report["warnings"])


def _check(
    out: Path,
    cells: dict[str, Any],
    sensor_files: tuple[Path, Path, Path, Path],
    config: Path | None,
    interval: "Interval | None",
) -> None:
    """Raise for what the later steps cannot use, before hours of matching."""
    from sat_intervals.heights.dsm import checked_cells, surface_tags
    from sat_intervals.heights.sensors import Sensors
    from sat_intervals.raster.identity import check_not_replaced
    from sat_intervals.run.output import OUTPUTS

    results = [out / name for name in (*OUTPUTS, "points.tif", "points.json", "dsm.tif")]
    like = [cells["resolution"]] if isinstance(cells["resolution"], Path) else []
    check_not_replaced([config, *sensor_files, cells["geoid"], *like], results, [out / "tiles"])
    _, cell, _, radius = checked_cells(out / "dsm.tif", cells["resolution"], cells["crs"], cells["radius"])
    surface_tags(["run"], [interval], cells["choices"].for_intervals([interval]), cell, radius)
    Sensors.load(*sensor_files)
