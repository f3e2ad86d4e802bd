"""The group of commands, and what a person sees when one of them fails.

The library is imported by the command that needs it: help and usage errors do not wait for numba.
"""

import atexit
import errno
import gc
import os
import sys
from contextlib import suppress
from typing import Any

import click

from sat_intervals.cli.ablate import ablate
from sat_intervals.cli.batch import batch
from sat_intervals.cli.demo import demo
from sat_intervals.cli.dsm import dsm
from sat_intervals.cli.evaluate import evaluate
from sat_intervals.cli.export import export
from sat_intervals.cli.logs import printable
from sat_intervals.cli.match import match
from sat_intervals.cli.plan import plan
from sat_intervals.cli.plot import plot
from sat_intervals.cli.process import check_process
from sat_intervals.cli.report import report
from sat_intervals.cli.settings import config
from sat_intervals.cli.signals import Ended, armed
from sat_intervals.cli.status import status
from sat_intervals.cli.triangulate import triangulate

FAILED, USER_ERROR = 1, 2
_ITEM = "\n  "
# As of a process that SIGPIPE ends.
READER_GONE = 141
_NO_MEMORY = "not enough memory: choose a smaller --tile-size or fewer --workers"
RESUMED = ("match", "demo", "batch")


class _Commands(click.Group):
    """Turns whatever goes wrong in a command into one line and an exit status."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        try:
            return super().main(*args, **kwargs)
        except OSError as error:  # of --help and --version, which print before a command is invoked
            if not _is_of_stdout(error):
                raise
            _forget_stdout()
            click.echo(f"sat-intervals: stdout cannot be written: {error.strerror}", err=True)
            sys.exit(FAILED)

    def invoke(self, context: click.Context) -> Any:
        try:
            os.getcwd()
        except OSError:
            _end(USER_ERROR, "the working directory is gone: change to a folder that is there")
        # The libraries make two hundred thousand objects that live as long as the process. To look for garbage among
        # them takes a fifth of a second while they are imported, and half a second at the end.
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
            return _end(USER_ERROR, f"{error.format_message()}{where}")
        except Ended as ended:
            resumed = context.invoked_subcommand in RESUMED
            again = "; the same command goes on from the tiles that are done" if resumed else ""
            return _end(ended.status, f"{ended}{again}")
        except Exception as error:
            if isinstance(error, OSError) and _is_of_stdout(error):
                _forget_stdout()
                if isinstance(error, BrokenPipeError):
                    raise click.exceptions.Exit(READER_GONE) from None
                return _end(FAILED, f"stdout cannot be written: {error.strerror}")
            return _end(*_explained(error))


def _is_of_stdout(error: OSError) -> bool:
    """Whether what is printed failed to be written: it has no file name, and comes from those who print."""
    trace = error.__traceback__
    while trace and trace.tb_next:
        trace = trace.tb_next
    place = trace.tb_frame.f_globals.get("__name__", "") if trace else ""
    return error.filename is None and place.startswith(("click.", "rich.", "sat_intervals.cli."))


def _forget_stdout() -> None:
    """Let nobody complain at the end of the process of what stdout did not take."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _explained(error: Exception) -> tuple[int, str]:
    from sat_intervals.errors import RunError, SatIntervalsError

    if isinstance(error, RunError):
        return FAILED, str(error)
    if isinstance(error, SatIntervalsError):
        return USER_ERROR, str(error)
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return FAILED, f"{_NO_MEMORY} ({error})"
    if isinstance(error, OSError) and error.strerror:
        return FAILED, f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, MemoryError):
        return FAILED, f"{_NO_MEMORY} ({error})"
    line = " ".join(str(error).split())
    if isinstance(error, SystemError):  # Python's word for a library that failed and did not say why
        return FAILED, f"a library failed without a reason, as they do out of memory: {_NO_MEMORY} ({line})"
    if isinstance(error, ValueError) and line.startswith("A dask config file"):
        return USER_ERROR, f"{line}: mend it, or point DASK_CONFIG elsewhere"
    return FAILED, f"{type(error).__name__}: {line} (this should not happen; --debug shows where)"


def _end(status: int, message: str) -> None:
    lines = map(printable, message.split(_ITEM))  # of a list, such as of tiles, a line an item
    click.echo(f"sat-intervals: {_ITEM.join(lines)}", err=True)
    raise click.exceptions.Exit(status)


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="sat-intervals")
def main() -> None:
    """Dense matching of epipolar satellite images: for every pixel a disparity and the interval around it."""


main.add_command(match)
main.add_command(config)
main.add_command(demo)
main.add_command(batch)
main.add_command(plan)
main.add_command(status)
main.add_command(plot)
main.add_command(report)
main.add_command(evaluate)
main.add_command(ablate)
main.add_command(triangulate)
main.add_command(dsm)
main.add_command(export)
