"""``sat-intervals dsm``: make a surface model with height intervals."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli import options
from sat_intervals.cli.logs import warn
from sat_intervals.cli.matching import SettingsArguments, cluster_options
from sat_intervals.cli.triangulate import say_geometry

if TYPE_CHECKING:
    from sat_intervals.cli.console import Console

# Share of cells whose runs disagree above which it warns: of pairs of one year 1 to 3 %, not aligned 40 %.
_DISAGREEING = 0.1
# Metres of height that two datums may differ by.
_OTHER_DATUM = 10.0
_FILL_DISTANCE = 20.0  # metres
_GRID_OPTIONS = (
    click.option("--resolution", type=float, metavar="METRES", help="Side of a cell; or give --grid-like."),
    click.option("--grid-like", type=options.FILE, help="North-up raster whose grid and CRS the surface takes."),
    click.option("--crs", metavar="EPSG", help="A projected CRS in metres; default the UTM zone of the points."),
    click.option(
        "--geoid", type=options.FILE, help="Geoid grid (GTX, GeoTIFF) that heights refer to; default the ellipsoid."
    ),
)
_CELL_OPTIONS = (
    *_GRID_OPTIONS[:3],
    options.expert_option(
        "--radius", type=float, metavar="METRES", help="Reach of a point; default the side of a cell."
    ),
    _GRID_OPTIONS[3],
    options.expert_option(
        "--bounds",
        type=click.Choice(("envelope", "quantiles")),
        help="Interval of a cell: .3 and .7 quantiles of its points' bounds (default for runs with a coverage), or the "
        "envelope of their intervals (default for others).",
    ),
    options.expert_option(
        "--keep-border",
        "keeps_border",
        is_flag=True,
        help="Keep points of confidence below 0.1 beside missing data of the right image.",
    ),
    options.expert_option(
        "--keep-open/--drop-open",
        "keeps_open",
        default=None,
        help="Keep or leave out points whose interval is open at an end of the search range; default: leave out with a "
        "coverage, else keep.",
    ),
    options.expert_option(
        "--outliers",
        type=float,
        metavar="METRES",
        help="Leave out points farther than this from the median height within 2 pixels; default: none.",
    ),
    options.expert_option("--max-width", type=float, metavar="METRES", help="Leave out cells with a wider interval."),
    options.expert_option(
        "--min-confidence", type=float, metavar="C", help="Leave out cells of lower confidence, 0 to 1."
    ),
    click.option("--fill", "fills", is_flag=True, help="Fill voids, from the lower of their rims beside buildings."),
    click.option(
        "--fill-distance",
        type=float,
        metavar="METRES",
        help=f"Reach from a void to its rim, {_FILL_DISTANCE:g} by default; fills, too.",
    ),
    click.option("--flatten", type=options.FILE, help="Polygons or a raster, not 0 inside: areas of one height."),
    click.option("--mask", type=options.FILE, help="Polygons or a raster, not 0 inside: areas of no data."),
    click.option(
        "--ortho",
        is_flag=True,
        help="Write ortho.tif on its grid: both raw images, or the median of three and more.",
    ),
)


# The command gets ``grid``: the grid of a surface, and what its heights refer to.
grid_options = options.gathered("grid", dict, *_GRID_OPTIONS)


def side_of(resolution: float | None, grid_like: Path | None) -> float | Path:
    """Return the side of a cell, or the raster that has it; raise unless one of them is given."""
    side = resolution if grid_like is None else grid_like
    if side is None or None not in (resolution, grid_like):
        raise click.UsageError("give either --resolution or --grid-like.")
    return side


def _cells(
    *,
    grid_like: Path | None,
    height_calibration: Path | None,
    fills: bool,
    fill_distance: float | None,
    resolution: float | None,
    **others: Any,
) -> dict[str, Any]:
    """Return arguments of `make_surface`."""
    from sat_intervals.config import load_height_calibration
    from sat_intervals.heights.choices import SurfaceChoices

    # a surface that is only completed has its own
    side = side_of(resolution, grid_like) if resolution or grid_like else resolution
    others["fill"] = _FILL_DISTANCE if fills and fill_distance is None else fill_distance
    others["calibration"] = height_calibration and load_height_calibration(height_calibration)
    cells = {name: others.pop(name) for name in ("crs", "radius", "geoid")}
    return cells | {"resolution": side, "choices": SurfaceChoices(**others)}


def cell_options(calibration: str) -> options.Decorator:
    """Add options for the cells of a surface, that of their calibration by its name; the command gets ``cells``."""
    text = "Calibration written by calibrate --dsm: margins in metres that move the bounds."
    option = click.option(calibration, "height_calibration", type=options.FILE, help=text)
    return options.gathered("cells", _cells, *_CELL_OPTIONS, option)


def say_surface(console: "Console", report: dict[str, Any]) -> None:
    """Print what a surface has: cells, filled share, half widths, and what was left out."""
    from sat_intervals.cli.console import say_completed
    from sat_intervals.cli.tables import shift_of
    from sat_intervals.heights.cells import WIDE

    say_geometry(console, report["geometry"])
    console.say(
        f"{report['rows']} x {report['columns']} cells in {report['crs']} from {report['points']} points, "
        f"{100 * report['filled']:.1f} % with a height"
    )
    if report["median_half_width"] is not None:
        by = f", calibration {report['calibration']}" if report["calibration"] else ""
        console.say(
            f"median half width +-{report['median_half_width']:.2f} m, {100 * report['wide']:.1f} % wider than "
            f"+-{WIDE:g} m, by --bounds {report['bounds']}{by}"
        )
    for name, what in (
        ("outliers", "points left out as outliers"),
        ("open", "points left out, with intervals open at an end of the search range"),
        ("border", "points left out, beside missing data of the right image and of confidence below 0.1"),
        ("poor_cells", "cells left out for their width or confidence"),
    ):
        if report[name]:
            console.say(f"{report[name]} {what}")
    say_completed(console, report["completed"])
    for found in report["shifts"]:
        console.say(f"{found['run']} moved: {shift_of(found)}")
        if abs(up := found["shift"][2]) > _OTHER_DATUM:
            warn([f"{found['run']} moved by {up:.0f} m in height, as if of another datum: check what heights refer to"])
    if (share := report["disagreeing"]) is not None:
        console.say(f"where runs overlap, {100 * share:.1f} % of the cells disagree")
        if share > _DISAGREEING:
            warn([f"{100 * share:.0f} % of the cells disagree: runs of other dates, or not moved onto each other"])
    warn(
        f"{out} was matched without intervals: cells without another run have no height bounds"
        for out in report["without_intervals"]
    )


@click.command(cls=options.Grouped, short_help="Make a surface model of one or several finished runs.")
@click.argument("outs", metavar="OUT...", nargs=-1, required=True, type=options.FILE)
@cell_options("--calibration")
@click.option("--no-align", "aligns", flag_value=False, default=True, help="Do not move several OUT onto each other.")
@click.option(
    "--reference", type=options.FILE, help="Raster of heights, above the same datum, that each OUT is moved onto."
)
@click.option("--output", type=options.FILE, help="File to write; default dsm.tif in the first OUT.")
@cluster_options
@options.overwrite_option
@options.sensor_options
@options.printing_options
def dsm(
    outs: tuple[Path, ...],
    cells: dict[str, Any],
    aligns: bool,
    reference: Path | None,
    output: Path | None,
    settings: SettingsArguments,
    overwrite: bool,
    sensor_files: list[options.SensorFiles],
    printing: options.Printing,
) -> None:
    """Make a surface model from the finished runs in the folders OUT, or of the pairs of a batch.

    Models are GeoTIFF or NITF with RPC tags, .RPB, _RPC.TXT, .geom or DIMAP XML files. Grids contain the sensor column
    and row (bands 1 and 2) of epipolar positions, as written by CARS and shareloc, or displacements to them, if OTB's
    tag METADATATYPE=OTB says so. Give them once for each OUT: OUT/geometry.json names them for later commands. A pair
    that `rectify` has made needs neither. Swapping both models and grids of left and right is not detected, and inverts
    the relief. Needs the extra [dsm].

    Bands: height, height_lower, height_upper, count, confidence, agreement. Heights refer to the WGS 84 ellipsoid
    unless --geoid is given. A point contributes to its cell and to cells whose centre is within --radius. Other cells
    are no data.

    --fill fills voids inside the surface, --flatten gives areas such as lakes one height: count is 0 there. A finished
    surface of three images and more is completed without matching again: dsm OUT --fill --output FILE.

    Several OUT are moved onto each other first: models of their images differ by a pixel or so. Where they overlap,
    heights and intervals are averaged, narrow ones with the most weight. Heights more than two cells apart are not:
    the one with a third of the weights below it is taken. Where intervals do not meet, agreement is 0, and it is their
    hull.
    """
    from sat_intervals.cli.console import say_completed
    from sat_intervals.raster.publishing import check_free
    from sat_intervals.run.status import runs_of
    from sat_intervals.workflows.dsm import make_surface

    choices = replace(cells["choices"], aligns=aligns, reference=reference)
    if choices.ortho and output:
        check_free(output.with_name("ortho.tif"), overwrite=overwrite)
    output = options.output_file(output, outs[0] / "dsm.tif", overwrite=overwrite)
    outs = tuple(run for out in outs for run in runs_of(out))
    with printing.console() as console:
        options.note_geometry(outs, sensor_files)
        cells |= {"choices": choices, "config": settings.load()}
        report = make_surface(outs, output, **cells, progress=console.progress)
    printing.say(report)
    if "geometry" in report:
        say_surface(console, report)
    else:
        say_completed(console, report["completed"])
    console.say(str(output))
    if choices.ortho:
        console.say(str(output.with_name("ortho.tif")))
