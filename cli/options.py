"""Options shared by commands, and checks of file names."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from sat_intervals.cli.logs import logged

if TYPE_CHECKING:
    from sat_intervals.cli.console import Console

# Copied from `sat_intervals.config`, which --help must not import.
PRESETS = ("satellite", "satellite-mccnn", "paper", "mccnn", "many")

# Pictures that `plot` writes to the folder of a run, without their ending.
PICTURES = ("overview", "errors", "coverage", "range", "rows", "profile", "curve", "dsm", "ortho")


class _Expert(click.Option):
    """An option that few runs need."""


expert_option = partial(click.option, cls=_Expert)


class Grouped(click.Command):
    """A command whose help lists `expert_option` under a heading of their own, at the end."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write both lists."""
        options = [one for one in self.get_params(ctx) if isinstance(one, click.Option)]
        for title, is_expert in (("Options", False), ("Expert options", True)):
            chosen = [one for one in options if isinstance(one, _Expert) == is_expert]
            if rows := [row for one in chosen if (row := one.get_help_record(ctx))]:
                with formatter.section(title):
                    formatter.write_dl(rows)


Command = Callable[..., Any]
Decorator = Callable[[Command], Command]


class _Name(click.ParamType):  # type: ignore[type-arg,unused-ignore]
    """A name that GDAL can open, not empty, as from an unset shell variable; or a path of this machine."""

    name = "file"

    def __init__(self, *, is_path: bool) -> None:
        self._is_path = is_path

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        if value == "":
            self.fail("it is empty: give a file or folder", parameter, context)
        if not self._is_path:
            return value
        if "/vsi" not in (text := str(value)) and "://" not in text:
            return Path(value)
        from sat_intervals.raster import path_of  # fsspec takes a while

        return path_of(value)

    def shell_complete(
        self, context: click.Context, parameter: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return [CompletionItem(incomplete, type="file")]


NAME, FILE = _Name(is_path=False), _Name(is_path=True)


def gathered(name: str, gather: Callable[..., Any], *options: Decorator) -> Decorator:
    """Return a decorator that adds options; the command gets ``name``, what ``gather`` makes of their values."""
    names = [one.name or "" for one in click.command()(with_options(lambda: None, *options)).params]

    def decorated(command: Command) -> Command:
        @wraps(command)
        def with_gathered(**given: Any) -> Any:
            values = {option: given.pop(option) for option in names}
            return command(**{name: gather(**values)}, **given)

        return with_options(with_gathered, *options)

    return decorated


def with_options(command: Command, *options: Decorator) -> Command:
    """Add options to a command, in the order of its help."""
    for option in reversed(options):
        command = option(command)
    return command


quiet_option = click.option("--quiet", "-q", is_flag=True, help="Print errors only.")
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace files that exist.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print all figures as JSON.")
truth_option = click.option(
    "--truth", type=FILE, help="True disparity; default truth.tif beside the left image, if it exists."
)


def _finite(context: click.Context, parameter: click.Parameter, value: float) -> float:
    """Raise if a number of pixels is infinite or NaN, which no range of click refuses."""
    if not math.isfinite(value):
        raise click.BadParameter(f"{value} is not a number of pixels")
    return value


TOLERANCE: dict[str, Any] = {"type": click.FloatRange(min=0), "default": 0.0, "callback": _finite, "metavar": "PX"}
tolerance_option = click.option(
    "--tolerance",
    **TOLERANCE,
    help="Truth up to PX outside an interval counts as inside; for quantised truth, give half a step.",
)

SensorFiles = tuple[Path, Path, Path, Path]
"""Left and right RPC model, left and right epipolar grid."""


def sensor_options(command: Command, *, models_alone: bool = False) -> Command:
    """Add options for models and grids, to be given once for each run, or models alone; the command gets a list."""

    def gather(**given: tuple[Path, ...]) -> list[tuple[Path, ...]]:
        if models_alone and not (given["left_grid"] or given["right_grid"]):
            given = {name: files for name, files in given.items() if name.endswith("model")}
        if len({len(files) for files in given.values()}) > 1:
            options = ", ".join("--" + name.replace("_", "-") for name in given)
            raise click.UsageError(f"{options} go together: give {'both' if len(given) == 2 else 'all four'}.")
        return list(zip(*given.values(), strict=True))

    return gathered(
        "sensor_files",
        gather,
        click.option("--left-model", multiple=True, type=FILE, help="RPC model of the left sensor image."),
        click.option("--right-model", multiple=True, type=FILE, help="RPC model of the right sensor image."),
        click.option("--left-grid", multiple=True, type=FILE, help="Epipolar grid of the left image."),
        click.option("--right-grid", multiple=True, type=FILE, help="Epipolar grid of the right image."),
    )(command)


def note_geometry(outs: Sequence[Path], sensor_files: Sequence[SensorFiles]) -> None:
    """Note the models and grids of runs in their folders, if any are given."""
    if sensor_files and len(sensor_files) != len(outs):
        given = f"models and grids are given {len(sensor_files)} times for {len(outs)} OUT"
        raise click.UsageError(f"{given}: give them for each, or for none.")
    from sat_intervals.heights.geometry import set_geometry

    for out, files in zip(outs, sensor_files, strict=False):
        set_geometry(out, *files)


@dataclass(frozen=True)
class Surface:
    """A surface model, reference heights to compare it with, and ``how``, how they are compared."""

    dsm: Path
    reference: Path
    how: dict[str, Any]


# Options of commands for surface models and others that apply to both.
_FOR_BOTH = {"output", "overwrite", "name", "as_json", "quiet", "debug", "log_file"}


def surface_options(dsm_help: str, others: str, *of_surfaces: str) -> Decorator:
    """Add --dsm, --reference and --no-register to a command for ``others``; ``of_surfaces``: what else needs --dsm."""

    def gather(
        *, dsm: Path | None, reference: Path | None, no_register: bool, reference_sigma: float | None
    ) -> Surface | None:
        if bool(dsm) != bool(reference):
            raise click.UsageError("--dsm and --reference go together: give both.")
        if no_register and not dsm:
            raise click.UsageError("--no-register goes with --dsm: leave it out.")
        if reference_sigma is not None and not dsm:
            raise click.UsageError("--reference-sigma goes with --dsm: leave it out.")
        _check_options(bool(dsm), others, of_surfaces)
        how = {"registers": not no_register, "reference_sigma": reference_sigma}
        return Surface(dsm, reference, how) if dsm and reference else None

    return gathered(
        "surface",
        gather,
        click.option("--dsm", type=FILE, help=dsm_help),
        click.option(
            "--reference",
            type=FILE,
            help="With --dsm: reference heights above the same datum, in any CRS: a raster, or points (CSV, "
            "GeoPackage, Parquet, LAZ).",
        ),
        click.option(
            "--reference-sigma",
            type=click.FloatRange(min=0),
            metavar="METRES",
            help="With --dsm: standard deviation of the errors of points without a column sigma; default 0.",
        ),
        click.option("--no-register", is_flag=True, help="With --dsm: do not move the reference to the surface."),
    )


def _check_options(has_surface: bool, others: str, of_surfaces: Sequence[str]) -> None:
    """Raise for what the command line has beside a surface model, or without one, and must not."""
    context = click.get_current_context()
    for parameter in context.command.params:
        key, option = parameter.name or "", parameter.opts[0]
        if not context.params[key] or key in ("dsm", "reference", "no_register", "reference_sigma"):
            continue
        if not has_surface and key in of_surfaces:
            raise click.UsageError(f"{option} applies only with --dsm: leave it out.")
        if has_surface and isinstance(parameter, click.Argument):
            line = f"{context.params[key][0]} is given, and --dsm: {context.info_name} one of them at a time."
            raise click.UsageError(line)
        if has_surface and key not in of_surfaces and key not in _FOR_BOTH:
            raise click.UsageError(f"{option} applies to {others}, not to --dsm: leave it out.")


@dataclass(frozen=True)
class Printing:
    """What a command prints: text, JSON, or errors only."""

    as_json: bool
    quiet: bool

    @property
    def is_silent(self) -> bool:
        """Return whether no text is printed."""
        return self.quiet or self.as_json

    def console(self) -> "Console":
        """Return what shows progress and prints text; it is silent beside JSON."""
        from sat_intervals.cli.console import Console

        return Console(self.is_silent)

    def say(self, report: Any) -> None:
        """Print a report if JSON is asked for."""
        if self.as_json:
            say_json(report)


def printing_options(command: Command) -> Command:
    """Add --json, --quiet and the options of the log; the command gets ``printing``."""
    return gathered("printing", Printing, json_option, quiet_option)(log_options(command))


def output_file(given: Path | None, default: Path, *, overwrite: bool) -> Path:
    """Return the file to write; raise if one that is given exists and may not be replaced."""
    from sat_intervals.raster.publishing import check_free

    if given:
        check_free(given, overwrite=overwrite)
    return given or default


def say_json(content: Any) -> None:
    """Print figures as JSON; NaN and infinity are null."""
    from sat_intervals.raster import as_json

    click.echo(as_json(content))


def log_options(command: Command) -> Command:
    """Add options that show and save the log."""

    @wraps(command)
    def with_log(*, debug: bool, log_file: Path | None, **others: Any) -> Any:
        with logged(debug, log_file):
            return command(**others)

    return with_options(
        with_log,
        expert_option("--debug", is_flag=True, help="Show the complete log, and tracebacks of errors."),
        expert_option("--log-file", type=FILE, help="Append the complete log to FILE."),
    )
