"""``sat-intervals triangulate``: compute ground points of a run."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.options import FILE, json_option, log_options, quiet_option, say_json, sensor_options

if TYPE_CHECKING:
    from sat_intervals.cli.console import Console

# Metres between lines of sight above which models are suspect.
_SUSPECT = 0.1
# Nodes of a grid beyond the image above which it may be that of another image: CARS adds up to three.
_MOST_BEYOND = 4


@click.command(short_help="Compute points and height bounds of a run with sensor models.")
@click.argument("out", type=FILE)
@sensor_options
@json_option
@quiet_option
@log_options
def triangulate(out: Path, sensor_files: tuple[Path, Path, Path, Path], as_json: bool, quiet: bool) -> None:
    """Triangulate the disparity and both bounds of the finished run in the folder OUT.

    \b
    OUT/points.tif   longitude, latitude, height, its two bounds, residual,
                     positions of the points at both bounds

    Models are GeoTIFFs with RPC tags, .geom or DIMAP XML files. Grids contain the sensor column and row (bands 1 and 2)
    of epipolar positions, as written by CARS and shareloc, or displacements to them, if OTB's tag METADATATYPE=OTB
    says so. All must be local files. Swapping both models and grids of
    left and right is not detected, and inverts the relief.
    Needs shareloc: pip install 'sat-intervals[dsm]'.
    """  # noqa: D301 (\b keeps the line breaks in click)
    from sat_intervals.cli.console import Console
    from sat_intervals.heights.triangulate import triangulate

    with Console(quiet or as_json) as console:
        report = triangulate(out, *sensor_files, progress=console.progress)
    if as_json:
        say_json(report)
    say_points(console, report)
    console.say(str(out / "points.tif"))


def say_points(console: "Console", report: dict[str, Any]) -> None:
    """Print the range of the points of a run, and what is wrong with them."""
    if report["points"]:
        (lowest, highest), residual = report["height"], report["residual"][1]
        console.say(
            f"{report['points']} points between {lowest:.1f} and {highest:.1f} m above the ellipsoid, "
            f"lines of sight at most {residual:.2g} m apart (so models and grids fit together; "
            "neither the matches nor whether they belong to these images is tested)"
        )
    else:
        console.say("no valid pixels, so no points")
    for line in point_warnings(report):
        click.echo(line, err=True)


def point_warnings(report: dict[str, Any]) -> list[str]:
    """Return lines about pixels without a point, and models that hardly fit."""
    lines = []
    if report.get("lost"):
        lines.append(f"{report['lost']} valid pixels have no point: grids or models have no values there")
    if report.get("beyond", 0) > _MOST_BEYOND * report.get("grid_step", 0):
        lines.append(
            f"warning: the left grid reaches {report['beyond']:.0f} px beyond the left image, more than {_MOST_BEYOND} "
            "of its nodes: check that models and grids belong to these images, which must not be cropped"
        )
    if report.get("median_residual", 0) > _SUSPECT:
        lines.append(
            f"warning: lines of sight miss each other by {report['median_residual']:.2g} m in the median, where "
            "matching models and grids give millimetres. Height errors may be many times larger: check that the grids "
            "were made with these models"
        )
    return lines
