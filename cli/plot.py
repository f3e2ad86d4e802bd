"""``sat-intervals plot``: draw pictures of a finished run."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.options import FILE, PICTURES, TOLERANCE, log_options, truth_option

if TYPE_CHECKING:
    from sat_intervals.results import Results


@click.command(short_help="Draw a finished run: maps, errors, a row, a pixel.")
@click.argument("out", type=FILE)
@truth_option
@click.option("--row", type=int, metavar="R", help="Draw the profile of this row.")
@click.option("--columns", type=int, nargs=2, metavar="A B", help="First and last column of the profile.")
@click.option("--pixel", type=int, nargs=2, metavar="R C", help="Draw the cost curve of this pixel.")
@click.option(
    "--beside", type=FILE, multiple=True, metavar="OUT", help="Run of the same pair at another coverage, to draw too."
)
@click.option("--mask", type=FILE, help="Pixels that coverage.png counts (not 0).")
@click.option("--tolerance", **TOLERANCE, help="In coverage.png, truth up to PX outside an interval counts as inside.")
@click.option("--remove-bias", is_flag=True, help="In coverage.png, add the median of disparity - truth to the truth.")
@click.option("--dpi", type=click.IntRange(30, 600), default=110, show_default=True, help="Dots per inch.")
@log_options
def plot(
    out: Path,
    truth: Path | None,
    row: int | None,
    columns: tuple[int, int] | None,
    pixel: tuple[int, int] | None,
    beside: tuple[Path, ...],
    dpi: int,
    **judging: Any,
) -> None:
    """Draw pictures of the finished run in the folder OUT and write them there.

    \b
    OUT/overview.png   pairs: left image, disparity, width, confidence, validity
    OUT/errors.png     with a truth and intervals: pixels whose interval misses it
    OUT/coverage.png   with --beside: coverage asked for and measured, width
    OUT/rows.png       if rows were compared: offsets, and what is left of them
    OUT/range.png      for a found or local search range: matches, cells
    OUT/profile.png    with --row: interval, disparity and truth along a row
    OUT/curve.png      with --pixel: cost curve of a pixel and its interval
    OUT/dsm.png        with dsm.tif: hillshade, up to 2000 cells with a pixel
                       each, height, half width, confidence
    OUT/ortho.png      with ortho.tif: the image on the surface
    OUT/change.png     of a folder of `change`: significant changes of height

    Of three images and more, only dsm.png and ortho.png are drawn. Rows and columns count from 0 at the first pixel of
    OUT/intervals.tif. Needs the extra [plot].
    """  # noqa: D301 (\b keeps the line breaks in click)
    from sat_intervals.errors import check_absent
    from sat_intervals.results import open_results, read_change
    from sat_intervals.show.accuracy import draw_coverage
    from sat_intervals.show.change_map import draw_change
    from sat_intervals.show.maps import draw_errors, draw_overview
    from sat_intervals.show.preparation import draw_range, draw_rows, has_range, has_rows
    from sat_intervals.show.profile import draw_curve, draw_profile

    of_pair = {"--row": row, "--columns": columns, "--pixel": pixel, "--beside": beside or None}
    if changed := read_change(out):
        check_absent(of_pair | {"--truth": truth}, f"a pair, {out} is a change between two dates")
        return _draw(out, {"change": partial(draw_change, out / "change.tif", changed, dpi=dpi)})
    results = open_results(out, truth)
    of_surface = _of_surface(results, dpi)
    if results.is_sweep:
        check_absent(of_pair, f"a pair, {out} is of {len(results.images)} images")
        results.check_kept([out / f"{name}.png" for name in of_surface])
        return _draw(out, of_surface)
    is_judged = results.truth is not None and results.config.interval is not None
    _check_options(results, row, columns, beside, is_judged=is_judged)
    results.check_kept([out / f"{name}.png" for name in PICTURES], [truth, judging["mask"], out / "dsm.tif"])
    drawings: dict[str, Callable[[Path], None]] = {"overview": partial(draw_overview, results, dpi=dpi)}
    if is_judged:
        drawings["errors"] = partial(draw_errors, results, dpi=dpi)
    if beside:
        drawings["coverage"] = partial(draw_coverage, [out, *beside], dpi=dpi, truth=truth, **judging)
    prepared = ("range", has_range, draw_range), ("rows", has_rows, draw_rows)
    drawings |= {name: partial(drawn, results, dpi=dpi) for name, has, drawn in prepared if has(results)}
    if row is not None:
        results.check_part(row, columns)
        drawings["profile"] = lambda target: draw_profile(results, target, row, columns, dpi)
    if pixel:
        results.check_pixel(*pixel)
        drawings["curve"] = lambda target: draw_curve(results, target, *pixel, dpi)
    _draw(out, drawings | of_surface)


def _of_surface(results: "Results", dpi: int) -> dict[str, Callable[[Path], None]]:
    """Return how the surface of a run and its ortho-image are drawn, if they are there."""
    from sat_intervals.show.surface_map import draw_ortho, draw_surface

    if not results.has_current("dsm.tif"):
        return {}
    files = ("dsm", draw_surface, results.out / "dsm.tif"), ("ortho", draw_ortho, results.ortho)
    return {name: partial(draw, file, dpi=dpi) for name, draw, file in files if file}


def _draw(out: Path, drawings: Mapping[str, Callable[[Path], None]]) -> None:
    """Draw pictures and print their names."""
    for name, draw in drawings.items():
        draw(out / f"{name}.png")
        click.echo(out / f"{name}.png")


def _check_options(
    results: "Results", row: int | None, columns: tuple[int, int] | None, beside: tuple[Path, ...], *, is_judged: bool
) -> None:
    from sat_intervals.errors import SatIntervalsError
    from sat_intervals.show.accuracy import check_one_pair

    if beside and not is_judged:
        where = f"{results.out} has no truth or no intervals"
        raise SatIntervalsError(f"--beside compares coverages, but {where}: give --truth")
    check_one_pair([results.out, *beside])
    if columns is not None and row is None:
        raise SatIntervalsError(f"--columns {columns[0]} {columns[1]} belong to a profile: give --row too")
