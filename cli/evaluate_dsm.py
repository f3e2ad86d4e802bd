"""Evaluate a surface model: the options of ``sat-intervals evaluate --dsm``, and what they print and write."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from sat_intervals.cli.options import FILE, Printing, Surface, gathered, overwrite_option

# Files of --pictures: figures and pictures.
_FILES = "dsm-accuracy.json", "dsm-accuracy.md", "dsm-reliability.png", "dsm-errors.png", "dsm-profile.png"


@dataclass(frozen=True)
class Details:
    """What is evaluated of a surface model beside all cells, and the folder for pictures, which is made."""

    classes: Path | None
    within: float | None
    pictures: Path | None
    line: tuple[float, float, float, float] | None
    overwrite: bool

    def check_folder(self, folder: Path, surface: Surface) -> None:
        """Raise if the folder is a file, or files in it would be replaced."""
        from sat_intervals.raster.identity import check_not_replaced
        from sat_intervals.raster.publishing import check_free

        if folder.exists() and not folder.is_dir():
            raise click.UsageError(f"--pictures {folder} is not a folder: choose another name.")
        paths = [folder / name for name in _FILES]
        check_not_replaced([surface.dsm, surface.reference, self.classes], paths)
        for path in paths:
            check_free(path, overwrite=self.overwrite)

    def draw(self, folder: Path, surface: Surface, report: dict[str, Any]) -> list[Path]:
        """Write figures and pictures of a surface model to a folder; return their paths."""
        from sat_intervals.cli.tables import surface_markdown
        from sat_intervals.evaluate.comparison import open_comparison
        from sat_intervals.evaluate.surface_accuracy import read_profile
        from sat_intervals.raster.publishing import failing, write_file, write_record
        from sat_intervals.show.accuracy import draw_error_map, draw_height_profile, draw_reliability

        paths = [folder / name for name in _FILES[: 3 if report["points"] else None]]
        figures, table, reliability, *maps = paths
        if maps:
            compared = open_comparison(surface.dsm, surface.reference, report["registration"])
            profile = read_profile(compared, self.line)
        with failing(figures):
            folder.mkdir(parents=True, exist_ok=True)
        write_record(figures, {"software": "sat-intervals"} | report)
        write_file(table, f"<!-- sat-intervals -->\n{surface_markdown(str(surface.dsm), report)}".encode())
        draw_reliability(report, reliability, surface.dsm.name)
        if maps:
            draw_error_map(compared, report["all"]["nmad"], maps[0])
            draw_height_profile(profile, maps[1], (surface.dsm.name, surface.reference.name))
        return paths


# The command gets ``details``.
details_options = gathered(
    "details",
    Details,
    click.option("--classes", type=FILE, help="With --dsm: raster of whole numbers, such as land cover, in any CRS."),
    click.option(
        "--within",
        type=click.FloatRange(min=0),
        metavar="METRES",
        help="With --dsm: errors up to this count as found in the completeness; default 1.",
    ),
    click.option(
        "--pictures", type=FILE, metavar="FOLDER", help="With --dsm: write figures (JSON, Markdown) and pictures there."
    ),
    click.option(
        "--line",
        type=float,
        nargs=4,
        metavar="X Y X Y",
        help="Ends of the profile of --pictures; default the middle row.",
    ),
    overwrite_option,
)


def evaluate_heights(surface: Surface, details: Details, printing: Printing) -> None:
    """Print figures, and write them with pictures to the folder, whose names are not printed if quiet."""
    from sat_intervals.cli.tables import show_surface
    from sat_intervals.evaluate.surface_accuracy import evaluate_surface

    if details.pictures:
        details.check_folder(details.pictures, surface)
    within: dict[str, Any] = {} if details.within is None else {"within": details.within}
    report = evaluate_surface(surface.dsm, surface.reference, details.classes, **surface.how, **within)
    printing.say(report)
    if not printing.as_json:
        show_surface(str(surface.dsm), report)
    for path in details.draw(details.pictures, surface, report) if details.pictures else ():
        if not printing.quiet:
            click.echo(path, err=printing.as_json)
