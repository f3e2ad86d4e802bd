"""``sat-intervals project``: write a QGIS project of a finished run."""

from pathlib import Path

import click

from sat_intervals.cli.options import FILE, log_options


@click.command(short_help="Write a QGIS project and styles of a finished run.")
@click.argument("out", type=FILE)
@log_options
def project(out: Path) -> None:
    """Write OUT/project.qgz, a QGIS project of the finished run in the folder OUT.

    \b
    OUT/project.qgz           images, disparity, width, confidence, validity;
                              with dsm.tif heights, hillshade, ortho-image (layers
                              without CRS are then off);
                              of `change`: change, difference, significance
    OUT/width.vrt             interval width, computed when it is read
    OUT/dsm_half_width.vrt    half the width of the intervals of heights
    OUT/*.qml                 style of the raster of the same name

    For QGIS 3.22 or newer. Of the folder of a batch each pair that is done gets one. Files of these names are
    replaced: save changes in QGIS under another name.
    """  # noqa: D301 (\b keeps the line breaks in click)
    from sat_intervals.run.status import runs_of
    from sat_intervals.show.project import write_project

    for run in runs_of(out):
        for file in write_project(run):
            click.echo(file)
