"""Evaluate a surface model: the options of ``sat-intervals evaluate --dsm``, and what they print and write."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import Any

import click

from sat_intervals.cli.options import FILE, Command, SurfaceAndReference, reference_options, say_json, with_options

Line = tuple[float, float, float, float]
# Files of --pictures: figures and pictures.
_TEXTS = "dsm-accuracy.json", "dsm-accuracy.md"
_PICTURES = "dsm-reliability.png", "dsm-errors.png", "dsm-profile.png"
# Beginnings of files of figures: those without one are not replaced, nor those that were changed since.
_MARKS = '{\n "software": "sat-intervals', "<!-- sat-intervals"


@dataclass(frozen=True)
class Surface:
    """A surface model to evaluate, and how."""

    given: SurfaceAndReference
    classes: Path | None
    folder: Path | None
    line: Line | None

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
        from sat_intervals.raster import watched_rasters

        given = self.given
        if self.folder is not None:
            _check_kept(self.folder, [given.dsm, given.reference, self.classes])
        check_unchanged = watched_rasters([given.dsm, given.reference])
        report = evaluate_surface(given.dsm, given.reference, self.classes, registers=given.registers)
        if as_json:
            say_json(report)
        else:
            show_surface(str(given.dsm), report)
        if self.folder is not None:
            written = _drawn(given, self.folder, self.line, report)
            check_unchanged()
            for path in () if quiet else written:
                click.echo(path, err=as_json)


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
        **others: Any,
    ) -> Any:
        given = {"--classes": classes, "--pictures": pictures, "--line": line}
        extra = next((name for name, value in given.items() if value), None)
        if extra and surface is None:
            raise click.UsageError(f"{extra} goes with --dsm: leave it out.")
        return command(surface=surface and Surface(surface, classes, pictures, line), **others)

    add_reference = reference_options("Evaluate this surface model against --reference, instead of runs.")
    return add_reference(with_options(with_surface, *_OPTIONS))


def _drawn(given: SurfaceAndReference, folder: Path, line: Line | None, report: dict[str, Any]) -> list[Path]:
    """Write figures and pictures of a surface model to a folder; return their paths."""
    from sat_intervals.cli.tables import surface_markdown
    from sat_intervals.config.sealing import ROOM, sealed
    from sat_intervals.evaluate.comparison import moved_by, open_comparison
    from sat_intervals.evaluate.dsm import read_profile
    from sat_intervals.raster import examined, whole_file
    from sat_intervals.raster.watching import watched_folder
    from sat_intervals.show.accuracy import draw_error_map, draw_height_profile, draw_reliability
    from sat_intervals.show.marks import check_made_here, write_made_here

    texts, paths = [folder / name for name in _TEXTS], [folder / name for name in _PICTURES]
    names = given.dsm.name, given.reference.name
    compared = moved_by(open_comparison(given.dsm, given.reference), report["registration"])
    profile = read_profile(compared, line)
    mark = f"sat-intervals, {ROOM}"
    content = (
        json.dumps({"software": mark} | report, indent=1),
        f"<!-- {mark} -->\n{surface_markdown(str(given.dsm), report)}",
    )
    with examined(folder, [*_TEXTS, *_PICTURES]) as there:
        _check_texts(folder)
        check_made_here(paths)
    pictures = {path: BytesIO() for path in paths}
    reliability, errors, heights = pictures.values()
    draw_reliability(report, reliability, names[0])
    draw_error_map(compared, report["all"]["nmad"], errors)
    draw_height_profile(profile, heights, names)
    check_folder = watched_folder(folder)
    for path, text in zip(texts, content, strict=True):
        with whole_file(path, there) as new:
            new.write_bytes(sealed(text.encode()))
            _check_texts(folder)  # again: a file may have appeared meanwhile
    write_made_here({path: drawn.getvalue() for path, drawn in pictures.items()}, there)
    check_folder()
    return [*texts, *paths]


def _check_kept(folder: Path, inputs: Sequence[Path | None]) -> None:
    """Raise if there is no such folder, or if files there would be replaced that are inputs or without a mark."""
    from sat_intervals.raster.identity import check_not_replaced
    from sat_intervals.show.marks import check_made_here

    if not folder.is_dir():
        raise click.UsageError(f"--pictures {folder} is not a folder: give an existing one.")
    check_not_replaced(inputs, [folder / name for name in (*_TEXTS, *_PICTURES)])
    check_made_here(folder / name for name in _PICTURES)
    _check_texts(folder)


def _check_texts(folder: Path) -> None:
    """Raise if a text file exists there without a mark, or was changed since."""
    from sat_intervals.config.sealing import is_as_made
    from sat_intervals.errors import SatIntervalsError, check_regular

    for path in (folder / name for name in _TEXTS):
        check_regular(path, "move it away")
        if not path.exists():
            continue
        content = path.read_bytes()
        if not content.startswith(tuple(mark.encode() for mark in _MARKS)) or not is_as_made(content):
            raise SatIntervalsError(
                f"{path} exists and was not made by sat-intervals, or was changed since: move it away"
            )
