"""The group of commands, and how errors are shown.

Each command imports the library itself, so that help and usage errors do not wait for numba.
"""

import atexit
import errno
import gc
from collections.abc import Sequence
from typing import Any, NoReturn

import click

from sat_intervals.cli.batch import batch
from sat_intervals.cli.calibrate import calibrate
from sat_intervals.cli.change import change
from sat_intervals.cli.config import config
from sat_intervals.cli.demo import demo
from sat_intervals.cli.dsm import dsm
from sat_intervals.cli.evaluate import evaluate
from sat_intervals.cli.export import export
from sat_intervals.cli.logs import printable
from sat_intervals.cli.match import match
from sat_intervals.cli.plan import plan
from sat_intervals.cli.plot import plot
from sat_intervals.cli.project import project
from sat_intervals.cli.range import search_range
from sat_intervals.cli.rectify import rectify
from sat_intervals.cli.reference import reference
from sat_intervals.cli.report import report
from sat_intervals.cli.signals import Ended, armed
from sat_intervals.cli.stac import stac
from sat_intervals.cli.status import status
from sat_intervals.cli.surface import surface
from sat_intervals.cli.triangulate import triangulate

FAILED, USER_ERROR = 1, 2
# Packages of extras.
_EXTRAS = {"matplotlib": "plot", "scipy": "dsm", "pyogrio": "reference", "shapely": "reference"}
_ITEM = "\n  "
RESUMED = ("match", "demo", "batch", "surface", "rectify")
STEPS: dict[str, tuple[click.Command, ...]] = {
    "Try and prepare": (demo, search_range, plan, config),
    "Surfaces": (surface, change, rectify, dsm, triangulate),
    "Match": (match, batch, status),
    "Inspect": (plot, report, project),
    "Compare with a truth": (reference, evaluate, calibrate),
    "Use elsewhere": (export, stac),
}
# The most common commands, which the command without arguments shows.
_DAILY = (demo, surface, change, dsm, match, status, report, project, evaluate, export)


class _Commands(click.Group):
    """Group of commands; turns every error into one line and an exit status."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write all commands, grouped by step."""
        _write_steps(formatter, [command for commands in STEPS.values() for command in commands])

    def invoke(self, context: click.Context) -> Any:
        # The libraries create two hundred thousand permanent objects. Garbage collection among them takes 0.2 s during
        # imports and 0.5 s at the end.
        gc.set_threshold(5000)
        atexit.register(gc.freeze)
        try:
            with armed():
                return super().invoke(context)
        except (click.exceptions.Exit, BrokenPipeError):  # click ends where the reader of stdout has gone
            raise
        except click.UsageError as error:
            where = f" (see {error.ctx.command_path} --help)" if error.ctx else ""
            return _end(USER_ERROR, f"{' '.join(error.format_message().split())}{where}")
        except Ended as ended:
            again = "; rerun the same command: it resumes" if context.invoked_subcommand in RESUMED else ""
            return _end(ended.status, f"{ended}{again}")
        except Exception as error:
            return _end(*_explained(error))


def _write_steps(formatter: click.HelpFormatter, chosen: Sequence[click.Command]) -> None:
    widest = max(len(command.name or "") for command in chosen)
    for step, commands in STEPS.items():
        rows = [
            (f"{command.name:<{widest}}", command.get_short_help_str(90)) for command in commands if command in chosen
        ]
        if rows:
            with formatter.section(step):
                formatter.write_dl(rows)


def _explained(error: Exception) -> tuple[int, str]:
    """Return exit status and line of an error."""
    from sat_intervals.errors import RunError, SatIntervalsError

    if isinstance(error, SatIntervalsError):
        is_failed = getattr(error.__cause__, "errno", None) in (errno.ENOSPC, errno.EDQUOT, errno.EIO)
        return FAILED if isinstance(error, RunError) or is_failed else USER_ERROR, str(error)
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return FAILED, f"not enough memory: choose a smaller --tile-size or fewer --workers ({error})"
    if isinstance(error, OSError) and error.strerror:
        return FAILED, f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, ModuleNotFoundError) and (extra := _EXTRAS.get((error.name or "").split(".")[0])):
        return USER_ERROR, f"{error.name} is not installed: pip install 'sat-intervals[{extra}]'"
    line = " ".join(str(error).split())
    return FAILED, f"{type(error).__name__}: {line} (this should not happen; --debug shows where)"


def _end(status: int, message: str) -> NoReturn:
    lines = map(printable, message.split(_ITEM))  # one line for each item of a list
    click.echo(f"sat-intervals: {_ITEM.join(lines)}", err=True)
    raise click.exceptions.Exit(status)


@click.group(cls=_Commands, invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="sat-intervals")
@click.pass_context
def main(context: click.Context) -> None:
    """Surface models and disparities of satellite images, two or many, with an interval for every value."""
    if context.invoked_subcommand is None:
        formatter = context.make_formatter()
        formatter.write_text(main.help or "")
        _write_steps(formatter, _DAILY)
        formatter.write_paragraph()
        formatter.write_text("sat-intervals demo OUT tries everything; sat-intervals --help lists all commands.")
        click.echo(formatter.getvalue().rstrip())


for _command in (command for commands in STEPS.values() for command in commands):
    main.add_command(_command)
