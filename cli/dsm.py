"""``sat-intervals dsm``: a surface model whose cells carry intervals."""

from pathlib import Path
from typing import Literal

import click

from sat_intervals.cli.options import log_options, path, quiet_option


@click.command(short_help="A surface model with an interval for every cell, of one or several runs.")
@click.argument("outs", metavar="OUT...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--resolution", type=float, required=True, metavar="METRES", help="Side of a cell.")
@click.option("--crs", metavar="EPSG", help="A projected CRS in metres; default the UTM zone of the points.")
@click.option("--radius", type=float, metavar="METRES", help="How far a point reaches; default the side of a cell.")
@click.option(
    "--interval",
    type=click.Choice(["envelope", "mean"]),
    default="envelope",
    show_default=True,
    help="A cell's interval: all of its points' intervals, or the weighted mean of their bounds.",
)
@click.option("--geoid", callback=path, metavar="FILE", help="Grid of geoid heights (GTX, GeoTIFF) to count from.")
@click.option(
    "--output",
    callback=path,
    metavar="FILE",
    help="The file to write; default dsm.tif in the first OUT. A surface model there is replaced.",
)
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
    quiet: bool,
) -> None:
    """Make a surface model of the points in the folders OUT, which `triangulate` wrote.

    Bands: height, height_lower, height_upper, count, confidence, agreement. Heights count from the ellipsoid of WGS 84
    unless --geoid is given. A point reaches its cell and those whose centre lies within --radius; the others stay no
    data.
    Where several OUT overlap, their intervals are intersected if they meet; else their hull is taken, and agreement is
    0.
    """
    from sat_intervals.cli.console import Console
    from sat_intervals.heights.dsm import make_surface

    output = output or outs[0] / "dsm.tif"
    with Console(quiet) as console:
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
    console.say(
        f"{report['rows']} x {report['columns']} cells in {report['crs']} of {report['points']} points, "
        f"{100 * report['filled']:.1f} % with a height"
    )
    if report["disagreeing"] is not None:
        console.say(f"where runs overlap, {100 * report['disagreeing']:.1f} % of the cells do not agree")
    for out in report["without_intervals"]:
        click.echo(
            f"{out} was matched without intervals: where no other run reaches, cells have heights alone", err=True
        )
    console.say(str(output))
