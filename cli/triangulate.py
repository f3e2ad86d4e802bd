"""``sat-intervals triangulate``: export the points of a run."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli import options
from sat_intervals.cli.logs import warn

if TYPE_CHECKING:
    from sat_intervals.cli.console import Console


@click.command(cls=options.Grouped, short_help="Export the points of a run with height bounds.")
@click.argument("out", type=options.FILE)
@click.option("--output", type=options.FILE, help="File to write: .tif, .laz or .las; default points.tif in OUT.")
@options.overwrite_option
@options.sensor_options
@options.printing_options
def triangulate(
    out: Path, output: Path | None, overwrite: bool, sensor_files: list[options.SensorFiles], printing: options.Printing
) -> None:
    """Write the points of the finished run in the folder OUT; `dsm` does not need them.

    \b
    points.tif    longitude, latitude, height, its two bounds, residual,
                  positions of the points at both bounds
    points.laz    x, y (UTM), z, intensity; extra dimensions lower, upper,
                  confidence; needs the extra [reference]

    Heights are above the ellipsoid of WGS 84. Models and grids are those of `dsm`.
    Needs the extra [dsm].
    """  # noqa: D301 (\b keeps the line breaks in click)
    from sat_intervals.heights.triangulate import triangulate

    output = options.output_file(output, out / "points.tif", overwrite=overwrite)
    with printing.console() as console:
        options.note_geometry([out], sensor_files)
        report = triangulate(out, output, console.progress)
    printing.say(report)
    if report["points"]:
        lowest, highest = report["height"]
        console.say(f"{report['points']} points between {lowest:.1f} and {highest:.1f} m above the ellipsoid")
    else:
        console.say("no valid pixels, so no points")
    say_geometry(console, {str(out): report})
    console.say(str(output))


def say_geometry(console: "Console", reports: dict[str, Any]) -> None:
    """Print how models and grids of each run fit, and what is wrong with them."""
    from sat_intervals.heights.geometry import SUSPECT, geometry_warnings

    for out, report in reports.items():
        if report["median_residual"] <= SUSPECT:
            console.say(
                f"{out}: lines of sight miss each other by {report['median_residual']:.2g} m in the median (so models "
                "and grids fit together; neither the matches nor whether they belong to these images is tested)"
            )
    warn(geometry_warnings(reports))
