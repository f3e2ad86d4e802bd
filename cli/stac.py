"""``sat-intervals stac``: describe a finished run as a STAC item."""

from pathlib import Path

import click

from sat_intervals.cli.options import FILE, log_options


@click.command(short_help="Write a STAC item of a finished run.")
@click.argument("out", type=FILE)
@click.option("--datetime", "taken", metavar="TIME", help="When the left image was taken; default: its TIFF tags.")
@click.option("--id", "identifier", metavar="ID", help="Identifier of the item; default: the name of the folder.")
@log_options
def stac(out: Path, taken: str | None, identifier: str | None) -> None:
    """Write OUT/stac.json, a STAC 1.1 item of the finished run in the folder OUT.

    It has footprint, projection, statistics of all bands, sizes and checksums of the files, versions and settings, and
    links to the images. All pixels are read once.

    TIME is ISO 8601 with a time zone, such as 2024-05-31T10:20:00Z.
    """
    from sat_intervals.interop.stac import write_item

    click.echo(write_item(out, taken=taken, identifier=identifier))
