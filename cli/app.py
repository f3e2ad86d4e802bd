"""The group of commands, and how errors are shown.

Each command imports the library itself, so that help and usage errors do not wait for numba.
"""

import atexit
import errno
import gc
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, TextIO

import click

from sat_intervals.cli.ablate import ablate
from sat_intervals.cli.batch import batch
from sat_intervals.cli.calibrate import calibrate
from sat_intervals.cli.config import config
from sat_intervals.cli.demo import demo
from sat_intervals.cli.dsm import dsm
from sat_intervals.cli.evaluate import evaluate
from sat_intervals.cli.export import export
from sat_intervals.cli.logs import printable
from sat_intervals.cli.match import match
from sat_intervals.cli.plan import plan
from sat_intervals.cli.plot import plot
from sat_intervals.cli.process import check_process
from sat_intervals.cli.project import project
from sat_intervals.cli.range import search_range
from sat_intervals.cli.reference import reference
from sat_intervals.cli.report import report
from sat_intervals.cli.signals import Ended, armed
from sat_intervals.cli.stac import stac
from sat_intervals.cli.status import status
from sat_intervals.cli.surface import surface
from sat_intervals.cli.triangulate import triangulate

FAILED, USER_ERROR = 1, 2
_ITEM = "\n  "
# Exit status of a process ended by SIGPIPE.
READER_GONE = 141
_NO_MEMORY = "not enough memory: choose a smaller --tile-size or fewer --workers"
# Of errors that nobody foresaw: commands check their paths before they use them.
_GONE = ": was it, or a folder above it, moved away meanwhile? Put it back, or run the command again"
_WAYS_OUT = {
    errno.ENOENT: _GONE,
    errno.ENOTDIR: _GONE,
    errno.EISDIR: ": move it away",
    errno.EACCES: ": check its rights",
    errno.EPERM: ": check its rights",
    errno.ENAMETOOLONG: ": choose a shorter name",
}
_NOWHERE = "the working directory was deleted: change to another folder"
RESUMED = ("match", "demo", "batch", "surface")
STEPS: dict[str, tuple[click.Command, ...]] = {
    "Try and prepare": (demo, search_range, plan, config),
    "Match": (match, batch, status),
    "Look": (plot, report, project),
    "Heights": (surface, triangulate, dsm),
    "Compare with a truth": (reference, evaluate, calibrate, ablate),
    "Use elsewhere": (export, stac),
}
# The most common commands, which the command without arguments shows.
_DAILY = (demo, match, status, report, project, surface, triangulate, dsm, evaluate, export)


class _Commands(click.Group):
    """Group of commands; turns every error into one line and an exit status."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write all commands, grouped by step."""
        _write_steps(formatter, [command for commands in STEPS.values() for command in commands])

    def main(self, *args: Any, **kwargs: Any) -> Any:
        try:
            return super().main(*args, **kwargs)
        except OSError as error:  # --help and --version print before a command is invoked
            if not _is_of_stdout(error):
                raise
            _discard(sys.stdout)
            click.echo(f"sat-intervals: stdout cannot be written: {error.strerror}", err=True)
            sys.exit(FAILED)

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        try:
            return super().make_context(*args, **kwargs)
        except BrokenPipeError:  # of --help and --version; click would exit with 1
            _discard(sys.stdout)
            raise click.exceptions.Exit(READER_GONE) from None

    def invoke(self, context: click.Context) -> Any:
        if _is_nowhere():
            _end(USER_ERROR, _NOWHERE)
        # The libraries create two hundred thousand permanent objects. Garbage collection among them takes 0.2 s during
        # imports and 0.5 s at the end.
        gc.set_threshold(5000)
        atexit.register(gc.freeze)
        try:
            with armed():
                if context.invoked_subcommand != "config":
                    check_process()
                return super().invoke(context)
        except click.exceptions.Exit:
            raise
        except click.UsageError as error:
            where = f" (see {error.ctx.command_path} --help)" if error.ctx else ""
            return _end(USER_ERROR, f"{' '.join(error.format_message().split())}{where}")
        except Ended as ended:
            resumed = context.invoked_subcommand in RESUMED
            again = "; rerun the same command: it resumes" if resumed else ""
            return _end(ended.status, f"{ended}{again}")
        except Exception as error:
            if isinstance(error, OSError) and _is_of_stdout(error):
                _discard(sys.stdout)
                if isinstance(error, BrokenPipeError):
                    raise click.exceptions.Exit(READER_GONE) from None
                return _end(FAILED, f"stdout cannot be written: {error.strerror}")
            status, message = _explained(error)
            return _end(status, f"{message}; {_NOWHERE}" if _is_nowhere() else message)


def _is_nowhere() -> bool:
    """Return whether the working directory was deleted."""
    try:
        os.getcwd()
    except OSError:
        return True
    return False


def _write_steps(formatter: click.HelpFormatter, chosen: Sequence[click.Command]) -> None:
    widest = max(len(command.name or "") for command in chosen)
    for step, commands in STEPS.items():
        rows = [
            (f"{command.name:<{widest}}", command.get_short_help_str(90)) for command in commands if command in chosen
        ]
        if rows:
            with formatter.section(step):
                formatter.write_dl(rows)


def _is_of_stdout(error: OSError) -> bool:
    """Return whether printing failed: the error has no file name and was raised by code that prints."""
    trace = error.__traceback__
    while trace and trace.tb_next:
        trace = trace.tb_next
    place = trace.tb_frame.f_globals.get("__name__", "") if trace else ""
    return error.filename is None and place.startswith(("click.", "rich.", "sat_intervals.cli."))


def _discard(stream: TextIO) -> None:
    """Redirect a stream to the null device, so that flushing it at exit does not fail."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _explained(error: Exception) -> tuple[int, str]:
    from sat_intervals.errors import RunError, SatIntervalsError

    if isinstance(error, RunError):
        return FAILED, str(error)
    if isinstance(error, SatIntervalsError):
        return USER_ERROR, str(error)
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return FAILED, f"{_NO_MEMORY} ({error})"
    if isinstance(error, OSError) and error.strerror:
        reason = error.strerror + _WAYS_OUT.get(error.errno or 0, "")
        return FAILED, f"{error.filename}: {reason}" if error.filename else reason
    if isinstance(error, MemoryError):
        return FAILED, f"{_NO_MEMORY} ({error})"
    line = " ".join(str(error).split())
    if isinstance(error, SystemError):  # raised by Python for a library that fails without an exception
        return FAILED, f"a library failed without a reason, probably for lack of memory: {_NO_MEMORY} ({line})"
    if isinstance(error, RuntimeError) and line.startswith("can't start new thread"):
        return FAILED, f"no more threads can be started: {_NO_MEMORY}, or allow it more processes (ulimit -u)"
    if isinstance(error, RuntimeError) and line.startswith("cannot cache function"):  # of another library
        return FAILED, f"{line}: set NUMBA_CACHE_DIR to a folder that can be written"
    if isinstance(error, RuntimeError) and line.startswith("Symlink loop"):
        return USER_ERROR, f"{line}: it is a link to itself, choose another path"
    if isinstance(error, UnicodeEncodeError) and error.reason == "surrogates not allowed":
        return USER_ERROR, "a folder, perhaps the working directory, has a name that is not UTF-8: rename it"
    if isinstance(error, ValueError) and line.startswith("A dask config file"):
        return USER_ERROR, f"{line}: fix it, or set DASK_CONFIG to another"
    return FAILED, f"{type(error).__name__}: {line} (this should not happen; --debug shows where)"


def _end(status: int, message: str) -> None:
    lines = map(printable, message.split(_ITEM))  # one line for each item of a list
    try:
        click.echo(f"sat-intervals: {_ITEM.join(lines)}", err=True)
    except BrokenPipeError:
        _discard(sys.stderr)
    raise click.exceptions.Exit(status)


@click.group(cls=_Commands, invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="sat-intervals")
@click.pass_context
def main(context: click.Context) -> None:
    """Match epipolar satellite images: a disparity for every pixel, with its interval."""
    if context.invoked_subcommand is None:
        formatter = context.make_formatter()
        formatter.write_text(main.help or "")
        _write_steps(formatter, _DAILY)
        formatter.write_paragraph()
        formatter.write_text("sat-intervals demo OUT tries everything; sat-intervals --help lists all commands.")
        click.echo(formatter.getvalue().rstrip())


for _command in (command for commands in STEPS.values() for command in commands):
    main.add_command(_command)
