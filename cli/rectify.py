"""``sat-intervals rectify``: make an epipolar pair of two raw images."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli import options
from sat_intervals.cli.images import PairArguments, image_options
from sat_intervals.cli.logs import warn
from sat_intervals.cli.matching import SettingsArguments, cluster_options

if TYPE_CHECKING:
    from sat_intervals.cli.console import Console


_MODEL_OPTIONS = (
    click.option("--left-model", type=options.FILE, help="RPC model of the left image; default that in or beside it."),
    click.option("--right-model", type=options.FILE, help="RPC model of the right image."),
)
_RAW_OPTIONS = (
    click.option("--dem", type=options.FILE, help="Raw images: DEM whose heights have disparity 0."),
    options.expert_option(
        "--altitude",
        type=float,
        metavar="METRES",
        help="Raw images: height above the ellipsoid that has disparity 0; default the middle of the ground's.",
    ),
    options.expert_option(
        "--resolution-of",
        type=click.Choice(("coarser", "left")),
        help="Raw images: whose pixel size to take if they differ by more than 10 %; default coarser.",
    ),
)
# The command gets ``raw``: arguments of `rectify`, without models or with them.
raw_options = options.gathered("raw", dict, *_RAW_OPTIONS)
raw_pair_options = options.gathered("raw", dict, *_MODEL_OPTIONS, *_RAW_OPTIONS)


@click.command(cls=options.Grouped, short_help="Make an epipolar pair of two raw images.")
@image_options
@click.argument("out", type=options.FILE)
@raw_pair_options
@click.option("--geoid", type=options.FILE, help="Geoid grid that heights of --dem refer to; default the ellipsoid.")
@cluster_options
@options.overwrite_option
@options.printing_options
def rectify(
    pair: PairArguments,
    out: Path,
    raw: dict[str, Any],
    settings: SettingsArguments,
    printing: options.Printing,
    **more: Any,
) -> None:
    """Resample the raw images LEFT and RIGHT, with RPC models, to an epipolar pair in the folder OUT.

    \b
    OUT/left.tif, right.tif            the overlap of the images
    OUT/left_grid.tif, right_grid.tif  column and row in the raw image of
                                       epipolar positions, as in CARS
    OUT/rectify.json                   inputs, altitude, base-to-height ratio,
                                       metres per pixel of disparity, rows

    Then: sat-intervals match OUT/left.tif OUT/right.tif RUN, and dsm RUN, which finds models and grids by rectify.json.
    `surface` does all of it. Models: RPC in tags of GeoTIFF or NITF, .RPB, _RPC.TXT, DIMAP XML, .geom. Needs the extra
    [dsm].
    """  # noqa: D301 (click's mark of a preformatted paragraph)
    from sat_intervals.workflows.rectify import rectify

    left, right = pair.open()
    with printing.console() as console:
        record = rectify(left, right, out, **raw, **more, config=settings.load(), progress=console.progress)
        say_rectified(console, record)
    printing.say(record)
    for name in ("left.tif", "right.tif", "left_grid.tif", "right_grid.tif", "rectify.json"):
        console.say(str(out / name))


def say_rectified(console: "Console", record: dict[str, Any]) -> None:
    """Print the figures of an epipolar pair, and warnings about its images."""
    warn(record["warnings"])
    for side in ("left", "right"):
        console.say(f"model of the {side} image: {record['inputs'][f'{side}_model']['path']}")
    height = "a DEM" if record["altitude"] is None else f"{record['altitude']:.0f} m"
    console.say(
        f"disparity 0 at {height}, {-record['metres_per_disparity']:.2f} m a pixel; base-to-height ratio "
        f"{record['base_to_height']:.2f}, pixels of {record['pixel_size']:.2f} m, "
        f"{100 * record['overlap']:.0f} % overlap"
    )
    if found := record["rows"]:
        console.say(f"rows: {found['text']}")
        warn(found["warnings"])
