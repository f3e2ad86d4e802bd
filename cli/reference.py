"""``sat-intervals reference``: true disparities of a run from reference heights."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli import options
from sat_intervals.cli.logs import warn

if TYPE_CHECKING:
    from sat_intervals.cli.console import Console

# Pixels of row misfit above which it is rather a mistake.
_SUSPECT_ROWS = 0.5


@click.command(cls=options.Grouped, short_help="Turn reference heights into true disparities of a run.")
@click.argument("out", type=options.FILE)
@click.option("--heights", type=options.FILE, help="Raster of heights, in any CRS.")
@click.option("--points", type=options.FILE, help="Points: CSV, Parquet, LAS, LAZ, GeoPackage.")
@click.option("--ellipsoid", is_flag=True, help="Heights are above the ellipsoid of WGS 84.")
@click.option("--geoid", type=options.FILE, help="Geoid grid (GTX, GeoTIFF) that heights refer to.")
@click.option("--crs", metavar="EPSG", help="CRS of the heights, in place of the file's.")
@click.option("--no-register", is_flag=True, help="Do not move the reference to the heights of the run.")
@click.option("--output", type=options.FILE, help="File to write; default truth.tif in OUT.")
@options.overwrite_option
@options.sensor_options
@options.printing_options
def reference(
    out: Path,
    heights: Path | None,
    points: Path | None,
    ellipsoid: bool,
    geoid: Path | None,
    crs: str | None,
    no_register: bool,
    output: Path | None,
    overwrite: bool,
    sensor_files: list[options.SensorFiles],
    printing: options.Printing,
) -> None:
    """Write the disparities that reference heights have in the finished run OUT: OUT/truth.tif.

    Give it to calibrate or evaluate as --truth. It has the disparity of the height that the left sensor sees at each
    pixel, and NaN elsewhere. Heights need a CRS and what they refer to: --ellipsoid or --geoid, unless the file says
    so. A CSV or Parquet file has the columns longitude, latitude, height, or x, y, height with --crs.

    The reference is first moved by its constant shift from the heights of the run (easting, northing, height), which
    is printed with its standard deviation. On flat ground only the height is moved.

    Models and grids are those of `dsm`. Needs the extra [dsm], points [reference].
    """
    if (heights is None) == (points is None):
        raise click.UsageError("give either --heights or --points.")
    if ellipsoid and geoid:
        raise click.UsageError("--ellipsoid and --geoid exclude each other.")
    from sat_intervals.heights.reference import Reference, make_truth
    from sat_intervals.raster import Vertical

    target = options.output_file(output, out / "truth.tif", overwrite=overwrite)
    vertical = Vertical(ellipsoid, geoid)
    given = Reference(heights or points, points is not None, vertical, crs)  # type: ignore[arg-type]
    with printing.console() as console:
        options.note_geometry([out], sensor_files)
        report = make_truth(out, given, path=output, registers=not no_register, progress=console.progress)
    _say_fit(console, out, given.path, report)
    console.say(
        f"{report['pixels']} pixels with a true disparity ({100 * report['share']:.1f} %), "
        f"{100 * report['outside_range']:.1f} % of them outside the search range"
    )
    console.say(str(target))
    printing.say(report)


def _say_fit(console: "Console", out: Path, heights: Path, report: dict[str, Any]) -> None:
    """Print the registration and the misfit of rows; warn of those that are suspect."""
    from sat_intervals.cli.tables import registration_lines
    from sat_intervals.raster.surfaces import datum_warnings

    if report["registration"]:
        for line in registration_lines(report["registration"]):
            console.say(line)
        warn(datum_warnings(out, heights, report["registration"]["shift"][2]))
    misfit = report["row_misfit"]
    if misfit:
        console.say(f"row misfit of models and grids: {misfit[0]:.2g} px in the median, {misfit[1]:.2g} px at most")
        if misfit[0] > _SUSPECT_ROWS:
            warn([f"the rows of the two images differ by {misfit[0]:.2g} px: check models and grids"])
