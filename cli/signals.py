"""Ctrl-C and SIGTERM: the first asks the command to end, the second kills it."""

import logging
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


class Ended(KeyboardInterrupt):
    """The process was asked to end by a signal, its only argument."""

    @property
    def status(self) -> int:
        """Exit status by the convention of shells."""
        return 128 + int(self.args[0])

    def __str__(self) -> str:
        """What happened, in a word."""
        return _WORDS[self.args[0]]


_asked: list[Ended] = []


def check() -> None:
    """End if that was asked for: Python drops what a signal raises inside a destructor."""
    if _asked:
        raise _asked[0]


@contextmanager
def armed() -> Iterator[None]:
    """Raise `Ended` on the first Ctrl-C or SIGTERM."""
    before = {number: signal.signal(number, _end) for number in _WORDS}
    hook, sys.unraisablehook = sys.unraisablehook, _report
    try:
        yield
    finally:
        if not _asked:  # else what is left to do may still take a while: the second kills, and nothing is complained of
            sys.unraisablehook = hook
            for number, handler in before.items():
                signal.signal(number, handler)


def _end(number: int, frame: Any) -> None:
    for other in _WORDS:
        signal.signal(other, signal.SIG_DFL)
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)  # of what zarr and dask do not bring to an end
    _asked.append(Ended(number))
    raise _asked[0]


def _report(unraisable: "sys.UnraisableHookArgs") -> None:
    if not _asked:
        sys.__unraisablehook__(unraisable)
