"""The group of commands, and what a person sees when one of them fails.

The library is imported by the command that needs it: help and usage errors do not wait for numba.
"""

import signal
import traceback
from typing import Any

import click

from sat_intervals.cli.demo import demo
from sat_intervals.cli.match import match
from sat_intervals.cli.settings import config

FAILED, USER_ERROR, INTERRUPTED, TERMINATED = 1, 2, 130, 143


class _Terminated(BaseException):
    """The process was asked to end (SIGTERM)."""


def _terminate(number: int, frame: Any) -> None:
    raise _Terminated


class _Commands(click.Group):
    """Turns whatever goes wrong in a command into one line and an exit status."""

    def invoke(self, context: click.Context) -> Any:
        signal.signal(signal.SIGTERM, _terminate)
        try:
            return super().invoke(context)
        except (click.ClickException, click.exceptions.Exit):
            raise
        except (KeyboardInterrupt, click.Abort):
            return _end(INTERRUPTED, "interrupted; the same command goes on from the tiles that are done")
        except _Terminated:
            return _end(TERMINATED, "terminated; the same command goes on from the tiles that are done")
        except Exception as error:
            if context.meta.get("sat_intervals.debug"):
                traceback.print_exception(error)
            return _end(*_explained(error))


def _explained(error: Exception) -> tuple[int, str]:
    from sat_intervals.errors import RunError, SatIntervalsError

    if isinstance(error, RunError):
        return FAILED, str(error)
    if isinstance(error, SatIntervalsError):
        return USER_ERROR, str(error)
    return FAILED, f"{type(error).__name__}: {error} (this should not happen; --debug shows where)"


def _end(status: int, message: str) -> None:
    click.echo(f"sat-intervals: {message}", err=True)
    raise click.exceptions.Exit(status)


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="sat-intervals")
def main() -> None:
    """Dense matching of epipolar satellite images: for every pixel a disparity and the interval around it."""


main.add_command(match)
main.add_command(config)
main.add_command(demo)
