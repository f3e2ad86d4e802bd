"""``sat-intervals dsm``: make a surface model with height intervals."""

from pathlib import Path
from typing import Literal

import click

from sat_intervals.cli.options import json_option, log_options, path, quiet_option, say_json


@click.command(short_help="Make a surface model with height intervals from one or several runs.")
@click.argument("outs", metavar="OUT...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--resolution", type=float, required=True, metavar="METRES", help="Side of a cell.")
@click.option("--crs", metavar="EPSG", help="A projected CRS in metres; default the UTM zone of the points.")
@click.option("--radius", type=float, metavar="METRES", help="Reach of a point; default the side of a cell.")
@click.option(
    "--interval",
    type=click.Choice(["envelope", "mean"]),
    default="envelope",
    show_default=True,
    help="Interval of a cell: envelope of its points' intervals, or weighted mean of their bounds.",
)
@click.option("--geoid", callback=path, metavar="FILE", help="Geoid grid (GTX, GeoTIFF) that heights refer to.")
@click.option(
    "--output",
    callback=path,
    metavar="FILE",
    help="File to write; default dsm.tif in the first OUT. An existing surface model is replaced.",
)
@json_option
@quiet_option
@log_options
def dsm(
    outs: tuple[Path, ...],
    resolution: float,
    crs: str | None,
    radius: float | None,
    interval: Literal["envelope", "mean"],
    geoid: Path | None,
    output: Path | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make a surface model from the points that `triangulate` wrote to the folders OUT.

    Bands: height, height_lower, height_upper, count, confidence, agreement. Heights refer to the WGS 84 ellipsoid
    unless --geoid is given. A point contributes to its cell and to cells whose centre is within --radius. Other cells
    are no data.

    Where several OUT overlap, the intervals are intersected if they overlap. Else their hull is written and agreement
    is 0.
    """
    from sat_intervals.cli.console import Console
    from sat_intervals.heights.dsm import make_surface

    output = output or outs[0] / "dsm.tif"
    with Console(quiet or as_json) as console:
        report = make_surface(
            outs,
            output,
            resolution=resolution,
            crs=crs,
            radius=radius,
            interval=interval,
            geoid=geoid,
            progress=console.progress,
        )
    if as_json:
        say_json(report)
    console.say(
        f"{report['rows']} x {report['columns']} cells in {report['crs']} from {report['points']} points, "
        f"{100 * report['filled']:.1f} % with a height"
    )
    if report["disagreeing"] is not None:
        console.say(f"where runs overlap, {100 * report['disagreeing']:.1f} % of the cells disagree")
    for out in report["without_intervals"]:
        click.echo(f"{out} was matched without intervals: cells without another run have no height bounds", err=True)
    console.say(str(output))
