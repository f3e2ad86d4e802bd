"""``sat-intervals triangulate``: compute ground points of a run."""

from pathlib import Path

import click

from sat_intervals.cli.options import json_option, log_options, path, quiet_option, say_json, sensor_options

# Metres between lines of sight above which models are suspect.
_SUSPECT = 0.1


@click.command(short_help="Compute points and height bounds of a run with sensor models.")
@click.argument("out", callback=path)
@sensor_options
@json_option
@quiet_option
@log_options
def triangulate(out: Path, sensor_files: tuple[Path, Path, Path, Path], as_json: bool, quiet: bool) -> None:
    """Triangulate the disparity and both bounds of the finished run in the folder OUT.

    \b
    OUT/points.tif   longitude, latitude, height, its two bounds, residual,
                     positions of the points at both bounds
    OUT/points.json  size and checksum of points.tif

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
    elif report["points"]:
        (lowest, highest), residual = report["height"], report["residual"][1]
        console.say(
            f"{report['points']} points between {lowest:.1f} and {highest:.1f} m above the ellipsoid, "
            f"lines of sight at most {residual:.2g} m apart (this tests models and grids, not the matches)"
        )
    else:
        console.say("no valid pixels, so no points")
    if report["lost"]:
        click.echo(f"{report['lost']} valid pixels have no point: grids or models have no values there", err=True)
    if report["median_residual"] > _SUSPECT:
        click.echo(
            f"warning: lines of sight miss each other by {report['median_residual']:.2g} m in the median, where "
            "matching models and grids give millimetres. Height errors may be many times larger: check that the grids "
            "were made with these models",
            err=True,
        )
    console.say(str(out / "points.tif"))
