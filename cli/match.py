"""``sat-intervals match``: two epipolar GeoTIFFs and a search range in, georeferenced bands out."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from sat_intervals.cli.options import debug_option, named, path, quiet_option

Number = TypeVar("Number", int, float)

COSTS = ("census", "mccnn")


def run_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of every command that matches a pair."""
    options = [
        click.option(
            "--config", "config_file", callback=path, metavar="FILE", help="Settings (YAML); the command line wins."
        ),
        click.option("--cost", type=click.Choice(COSTS), help="Matching cost; its penalties come with it."),
        click.option("--tile-size", type=int, help="Side of a tile's core in pixels, a multiple of 64."),
        click.option("--overlap", type=int, help="Pixels read around a core."),
        click.option("--workers", type=click.IntRange(min=1), help="Tiles in work at once; default one a core."),
        click.option(
            "--cluster",
            metavar="SPEC",
            help="threads (default), processes, slurm, pbs, lsf, sge, or the address of a dask scheduler.",
        ),
        click.option(
            "--store", callback=named, metavar="URL", help="Folder or fsspec URL for tiles until the run is finished."
        ),
        click.option("--keep-tiles", is_flag=True, help="Keep the raw products of the tiles."),
        click.option("--overwrite", is_flag=True, help="Replace the run in OUT and drop its tiles."),
        quiet_option,
        debug_option,
    ]
    for option in reversed(options):
        command = option(command)
    return command


def overrides(
    disparity: tuple[int, int] | None = None,
    tile_size: int | None = None,
    overlap: int | None = None,
    workers: int | None = None,
    cluster: str | None = None,
    cost: str | None = None,
    store: str | None = None,
) -> dict[str, Any]:
    """The settings that the command line gives, as sections."""
    minimum, maximum = disparity or (None, None)
    is_address = cluster is not None and "://" in cluster
    sections: dict[str, dict[str, Any]] = {
        "disparity": {"minimum": minimum, "maximum": maximum},
        "cost": {"method": cost},
        "tiles": {"size": tile_size, "overlap": overlap},
        "cluster": {
            "workers": workers,
            "kind": "address" if is_address else cluster,
            "address": cluster if is_address else None,
            "store": store,
        },
    }
    given = {
        name: {key: value for key, value in section.items() if value is not None} for name, section in sections.items()
    }
    return {name: section for name, section in given.items() if section}


@click.command(short_help="Match a pair: disparity, interval, confidence, validity.")
@click.argument("left", callback=named)
@click.argument("right", callback=named)
@click.argument("out", callback=path)
@click.option("--disparity", type=int, nargs=2, metavar="MIN MAX", help="Search range in pixels, both ends searched.")
@click.option("--left-mask", callback=named, metavar="FILE", help="Left pixels to leave out: non-zero = masked.")
@click.option("--right-mask", callback=named, metavar="FILE", help="Right pixels to leave out.")
@click.option("--nodata", type=float, metavar="V", help="No-data value of both images, in place of their own.")
@click.option("--left-nodata", type=float, metavar="V", help="No-data value of the left image.")
@click.option("--right-nodata", type=float, metavar="V", help="No-data value of the right image.")
@click.option("--band", type=int, metavar="N", help="Band to match of both images, needed where they have several.")
@click.option("--left-band", type=int, metavar="N", help="Band of the left image.")
@click.option("--right-band", type=int, metavar="N", help="Band of the right image.")
@click.option("--window", type=int, nargs=4, metavar="ROW COL HEIGHT WIDTH", help="Region of the left image to match.")
@click.option("--dry-run", is_flag=True, help="Print the job script of the cluster, submit and match nothing.")
@run_options
def match(
    left: str,
    right: str,
    out: Path,
    disparity: tuple[int, int] | None,
    left_mask: str | None,
    right_mask: str | None,
    nodata: float | None,
    left_nodata: float | None,
    right_nodata: float | None,
    band: int | None,
    left_band: int | None,
    right_band: int | None,
    window: tuple[int, int, int, int] | None,
    dry_run: bool,
    config_file: Path | None,
    cost: str | None,
    tile_size: int | None,
    overlap: int | None,
    workers: int | None,
    cluster: str | None,
    store: str | None,
    keep_tiles: bool,
    overwrite: bool,
    quiet: bool,
) -> None:
    """Match the epipolar images LEFT and RIGHT over a search range and write to the folder OUT.

    \b
    OUT/intervals.tif   disparity, lower, upper (pixels), confidence
    OUT/validity.tif    flags: why a pixel is invalid, what was done to it
    OUT/run.json        settings, inputs, figures

    Disparity is x_right - x_left. An interrupted run goes on where it was with the same command.
    """  # noqa: D301 (click's mark of a paragraph to keep as it is)
    from sat_intervals.cli.console import Console
    from sat_intervals.config import load_config
    from sat_intervals.tiling import Window

    if disparity is None and config_file is None:
        raise click.UsageError("Missing search range: give --disparity MIN MAX, or a --config with it.")
    config = load_config(config_file, overrides(disparity, tile_size, overlap, workers, cluster, cost, store))
    if dry_run:
        from sat_intervals.cluster import job_script

        click.echo(job_script(config.cluster, out))
        return
    with Console(quiet) as console:
        from sat_intervals.raster import open_image
        from sat_intervals.run import match_pair

        report = match_pair(
            open_image(left, band=_either(left_band, band), nodata=_either(left_nodata, nodata), mask=left_mask),
            open_image(right, band=_either(right_band, band), nodata=_either(right_nodata, nodata), mask=right_mask),
            out,
            config,
            window=Window(*window) if window else None,
            keep_tiles=keep_tiles,
            overwrite=overwrite,
            progress=console.progress,
        )
    console.summary(report, out)


def _either(first: Number | None, second: Number | None) -> Number | None:
    return second if first is None else first
