"""``sat-intervals export``: export a run to the files of another tool."""

from pathlib import Path

import click

from sat_intervals.cli.options import FILE, log_options, overwrite_option


@click.command(short_help="Export a run to the files of CARS, OTB, ASP or s2p.")
@click.argument("out", type=FILE)
@click.argument("target", type=FILE)
@click.option("--to", "form", type=click.Choice(["cars", "otb", "asp", "s2p"]), required=True, help="Target tool.")
@overwrite_option
@log_options
def export(out: Path, target: Path, form: str, overwrite: bool) -> None:
    """Export the finished run in the folder OUT to the folder TARGET in the format of another tool.

    \b
    cars   epi_disp.tif, epi_disp_interval_bounds_inf.tif and _sup.tif,
           epi_disp_ambiguity.tif (1 - confidence),
           epi_disp_mask.tif (255 = valid)
    otb    disparity.tif (horizontal, vertical), mask.tif (255 = valid)
    asp    experimental: TARGET-F.tif (horizontal, vertical, valid);
           TARGET is a prefix
    s2p    rectified_disp.tif, rectified_mask.png (1 = valid),
           rectified_disp_confidence.tif

    The format of ASP follows its documentation and has not been tested with ASP itself. All files have the size of the
    left image.
    """  # noqa: D301 (\b keeps the line breaks in click)
    from sat_intervals.interop.export import export

    for file in export(out, form, target, overwrite=overwrite):
        click.echo(file)
