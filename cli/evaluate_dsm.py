"""Evaluate a surface model: the options of ``sat-intervals evaluate --dsm``, and what they print and write."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import click

from sat_intervals.cli.options import (
    FILE,
    Command,
    SurfaceAndReference,
    overwrite_option,
    reference_options,
    say_json,
    with_options,
)

Line = tuple[float, float, float, float]
# Files of --pictures: figures and pictures.
_TEXTS = "dsm-accuracy.json", "dsm-accuracy.md"
_PICTURES = "dsm-reliability.png", "dsm-errors.png", "dsm-profile.png"


@dataclass(frozen=True)
class Surface:
    """A surface model to evaluate, and how."""

    given: SurfaceAndReference
    classes: Path | None
    folder: Path | None
    line: Line | None
    overwrite: bool

    def check_alone(self, folders: Sequence[Path], options: Mapping[str, Any]) -> None:
        """Raise if there are runs to evaluate too, or options for them."""
        for name, value in options.items():
            if value:
                raise click.UsageError(f"{name} applies to runs and pairs, not to --dsm: leave it out.")
        if folders:
            raise click.UsageError(f"{folders[0]} is a run and --dsm a surface model: evaluate one of them at a time.")

    def evaluate(self, as_json: bool, quiet: bool) -> None:
        """Print figures, and write them with pictures to the folder, whose names are not printed if quiet."""
        from sat_intervals.cli.tables import show_surface
        from sat_intervals.evaluate.dsm import evaluate_surface

        given = self.given
        if self.folder is not None:
            self._check_folder(self.folder)
        report = evaluate_surface(given.dsm, given.reference, self.classes, registers=given.registers)
        if as_json:
            say_json(report)
        else:
            show_surface(str(given.dsm), report)
        if self.folder is not None:
            written = _drawn(given, self.folder, self.line, report)
            for path in () if quiet else written:
                click.echo(path, err=as_json)

    def _check_folder(self, folder: Path) -> None:
        """Raise if there is no such folder, or files in it would be replaced."""
        from sat_intervals.raster.identity import check_not_replaced
        from sat_intervals.raster.publishing import check_free

        if not folder.is_dir():
            raise click.UsageError(f"--pictures {folder} is not a folder: give an existing one.")
        paths = [folder / name for name in (*_TEXTS, *_PICTURES)]
        check_not_replaced([self.given.dsm, self.given.reference, self.classes], paths)
        for path in paths:
            check_free(path, overwrite=self.overwrite)


_OPTIONS = (
    click.option("--classes", type=FILE, help="With --dsm: raster of whole numbers, such as land cover, in any CRS."),
    click.option(
        "--pictures",
        type=FILE,
        metavar="FOLDER",
        help="With --dsm: write figures (JSON, Markdown) and pictures there.",
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


def surface_options(command: Command) -> Command:
    """Add options for a surface model; the command gets ``surface``, None without one."""

    @wraps(command)
    def with_surface(
        *,
        surface: SurfaceAndReference | None,
        classes: Path | None,
        pictures: Path | None,
        line: Line | None,
        overwrite: bool,
        **others: Any,
    ) -> Any:
        given = {"--classes": classes, "--pictures": pictures, "--line": line, "--overwrite": overwrite}
        extra = next((name for name, value in given.items() if value), None)
        if extra and surface is None:
            raise click.UsageError(f"{extra} goes with --dsm: leave it out.")
        return command(surface=surface and Surface(surface, classes, pictures, line, overwrite), **others)

    add_reference = reference_options("Evaluate this surface model against --reference, instead of runs.")
    return add_reference(with_options(with_surface, *_OPTIONS))


def _drawn(given: SurfaceAndReference, folder: Path, line: Line | None, report: dict[str, Any]) -> list[Path]:
    """Write figures and pictures of a surface model to a folder; return their paths."""
    from sat_intervals.cli.tables import surface_markdown
    from sat_intervals.evaluate.comparison import open_comparison
    from sat_intervals.evaluate.dsm import read_profile
    from sat_intervals.raster.publishing import write_file
    from sat_intervals.show.accuracy import draw_error_map, draw_height_profile, draw_reliability

    figures, table, reliability, errors, heights = paths = [folder / name for name in (*_TEXTS, *_PICTURES)]
    names = given.dsm.name, given.reference.name
    compared = open_comparison(given.dsm, given.reference, report["registration"])
    profile = read_profile(compared, line)
    write_file(figures, json.dumps({"software": "sat-intervals"} | report, indent=1).encode())
    write_file(table, f"<!-- sat-intervals -->\n{surface_markdown(str(given.dsm), report)}".encode())
    draw_reliability(report, reliability, names[0])
    draw_error_map(compared, report["all"]["nmad"], errors)
    draw_height_profile(profile, heights, names)
    return paths
