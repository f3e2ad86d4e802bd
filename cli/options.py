"""Options shared by commands, and checks of file names."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from sat_intervals.cli.logs import logged

# Copied from `sat_intervals.config`, which --help must not import.
PRESETS = ("satellite", "satellite-mccnn", "paper", "mccnn")

# Pictures that `plot` writes to the folder of a run, without their ending.
PICTURES = ("overview", "errors", "coverage", "range", "profile", "curve", "dsm")

Command = Callable[..., Any]

# What rasterio takes for an address, even if there is a folder with this name.
_ADDRESS = re.compile(r"(file|https?|ftp|s3|gs|az|oss|zip|tar|gzip)(\+\w+)*:", re.IGNORECASE)


class _Name(click.ParamType):  # type: ignore[type-arg,unused-ignore]
    """A name that GDAL can open: UTF-8, and not empty, as from an unset shell variable."""

    name = "file"

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        if value == "":
            self.fail("it is empty: give a file or folder", parameter, context)
        try:
            str(value).encode()
        except UnicodeEncodeError:
            self.fail(f"{value!r} is not UTF-8: rename it", parameter, context)
        return value

    def shell_complete(
        self, context: click.Context, parameter: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return [CompletionItem(incomplete, type="file")]


class _File(_Name):
    """The path of a file or folder."""

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        if _ADDRESS.match(str(name := super().convert(value, parameter, context))):
            self.fail(f"{name} is read as an address: give the path of a file or folder here", parameter, context)
        return Path(name)


NAME, FILE = _Name(), _File()

quiet_option = click.option("--quiet", "-q", is_flag=True, help="Print errors only.")
preset_option = click.option(
    "--preset",
    type=click.Choice(PRESETS),
    help="satellite (default), satellite-mccnn for different dates or little texture, paper for the paper's figures.",
)
_SENSOR_OPTIONS = tuple(
    click.option(f"--{side}-{kind}", required=True, type=FILE, help=text.format(side))
    for kind, text in (("model", "RPC model of the {} sensor image."), ("grid", "Epipolar grid of the {} image."))
    for side in ("left", "right")
)


def sensor_options(command: Command) -> Command:
    """Add options for models and grids; the command gets ``sensor_files``, in this order."""

    @wraps(command)
    def with_sensors(*, left_model: Path, right_model: Path, left_grid: Path, right_grid: Path, **others: Any) -> Any:
        return command(sensor_files=(left_model, right_model, left_grid, right_grid), **others)

    return with_options(with_sensors, *_SENSOR_OPTIONS)


@dataclass(frozen=True)
class SurfaceAndReference:
    """A surface model, reference heights to compare it with, and whether these are moved to it first."""

    dsm: Path
    reference: Path
    registers: bool


def reference_options(dsm_help: str) -> Callable[[Command], Command]:
    """Return a decorator that adds --dsm, --reference and --no-register.

    The command gets ``surface``, a `SurfaceAndReference`, or None without them.
    """

    def decorated(command: Command) -> Command:
        @wraps(command)
        def with_reference(*, dsm: Path | None, reference: Path | None, no_register: bool, **others: Any) -> Any:
            if bool(dsm) != bool(reference):
                raise click.UsageError("--dsm and --reference go together: give both.")
            if no_register and not dsm:
                raise click.UsageError("--no-register goes with --dsm: leave it out.")
            surface = SurfaceAndReference(dsm, reference, not no_register) if dsm and reference else None
            return command(surface=surface, **others)

        return with_options(
            with_reference,
            click.option("--dsm", type=FILE, help=dsm_help),
            click.option(
                "--reference",
                type=FILE,
                help="With --dsm: reference heights above the same datum, in any CRS.",
            ),
            click.option("--no-register", is_flag=True, help="With --dsm: do not move the reference to the surface."),
        )

    return decorated


overwrite_option = click.option("--overwrite", is_flag=True, help="Replace files that exist.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print all figures as JSON.")


def say_json(content: Any) -> None:
    """Print figures as JSON; NaN and infinity are null."""
    import json
    import math

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(key): plain(one) for key, one in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(one) for one in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    click.echo(json.dumps(plain(content), indent=1, default=str))


def log_options(command: Command) -> Command:
    """Add options that show and save the log."""

    @wraps(command)
    def with_log(*, debug: bool, log_file: Path | None, **others: Any) -> Any:
        with logged(debug, log_file):
            return command(**others)

    return with_options(
        with_log,
        click.option("--debug", is_flag=True, help="Show the complete log, and tracebacks of errors."),
        click.option("--log-file", type=FILE, help="Append the complete log to FILE."),
    )


def with_options(command: Command, *options: Callable[[Command], Command]) -> Command:
    """Add options to a command, in the order of its help."""
    for option in reversed(options):
        command = option(command)
    return command
