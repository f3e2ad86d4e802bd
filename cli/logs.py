"""``--debug`` and ``--log-file``: show the log of a command on stderr and append it to a file."""

import logging
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import product
from pathlib import Path
from typing import IO

import click

from sat_intervals.cli.signals import Ended
from sat_intervals.errors import REPORT

_LOG = logging.getLogger(__name__)
_LINES = logging.Formatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s")


def printable(text: str) -> str:
    """Return a message in one printable line: line breaks and control characters are escaped."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)


def warn(lines: Iterable[str]) -> None:
    """Print warnings on stderr."""
    for line in lines:
        click.echo(f"warning: {printable(line)}", err=True)


class _Warnings(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return f"warning: {printable(record.getMessage())}"


class _Handler(logging.Handler):
    """Writes lines to a file or the current stderr; not a StreamHandler, since dask silences these on its loggers."""

    def __init__(self, lines: logging.Formatter, file: IO[str] | None = None) -> None:
        super().__init__()
        self.setFormatter(lines)
        self._file = file

    def emit(self, record: logging.LogRecord) -> None:
        try:
            click.echo(self.format(record), file=self._file, err=True)
        except OSError as error:
            if self._file:  # such as a full disk: continue without the log
                click.echo(f"sat-intervals: {self._file.name}: {error.strerror}: the log ends here", err=True)
            self.setLevel(logging.CRITICAL + 1)


@contextmanager
def logged(debug: bool, log_file: Path | None) -> Iterator[None]:
    """Log during the block: warnings on stderr, or everything with ``debug``; everything in a file."""
    ours = logging.getLogger("sat_intervals")
    with ExitStack() as stack:
        # Libraries give the root logger handlers of their own, which would repeat our lines.
        stack.callback(setattr, ours, "propagate", ours.propagate)
        ours.propagate = False
        shown = _Handler(_LINES if debug else _Warnings())
        shown.setLevel(logging.NOTSET if debug else logging.WARNING)
        shown.addFilter(lambda record: record.name != REPORT)
        everything = [_Handler(_LINES, stack.enter_context(_opened(log_file)))] if log_file else []
        everything += [shown] if debug else []
        # dask's logger gets a handler of its own and does not propagate, unless the root logger already has handlers
        dasks = logging.getLogger("distributed")
        loggers = [logging.root, ours, *([] if dasks.propagate else [dasks])]
        for handler, logger in [*product(everything, loggers), *([] if debug else [(shown, ours)])]:
            logger.addHandler(handler)
            stack.callback(logger.removeHandler, handler)
        # what aiohttp leaves to asyncio of a lost connection is raised, too
        logger, level = (ours, logging.DEBUG) if everything else (logging.getLogger("asyncio"), logging.CRITICAL)
        stack.callback(logger.setLevel, logger.level)
        logger.setLevel(level)
        name, began = click.get_current_context().command_path, time.monotonic()
        _LOG.info("%s begins", name)
        try:
            yield
        except (click.ClickException, click.exceptions.Exit):
            raise
        except Ended as ended:
            _LOG.info("%s %s", name, ended)
            raise
        except Exception as error:
            _LOG.debug("%s failed", name, exc_info=error)
            raise
        _LOG.info("%s ended after %.1f s", name, time.monotonic() - began)


@contextmanager
def _opened(log_file: Path) -> Iterator[IO[str]]:
    from sat_intervals.errors import SatIntervalsError
    from sat_intervals.raster.identity import check_not_replaced

    given = {**click.get_current_context().params, "log_file": None}.values()
    names = [name for value in given for name in (value if isinstance(value, tuple) else (value,))]
    check_not_replaced([name for name in names if isinstance(name, (str, Path))], [log_file])
    try:
        file = open(log_file, "a", encoding="utf-8", errors="backslashreplace", buffering=1)  # noqa: SIM115
    except OSError as error:
        raise SatIntervalsError(f"{log_file} cannot be written: {error.strerror}: choose another --log-file") from error
    try:
        yield file
    finally:
        with suppress(OSError):  # a full disk, already reported
            file.close()
