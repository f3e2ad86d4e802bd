"""Handle Ctrl-C and SIGTERM: the first signal ends the command cleanly, the second kills it."""

import logging
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


class Ended(KeyboardInterrupt):
    """A signal, its only argument, asked the process to end."""

    @property
    def status(self) -> int:
        """Return the exit status by the convention of shells."""
        return 128 + int(self.args[0])

    def __str__(self) -> str:
        """Return what happened, in one word."""
        return _WORDS[self.args[0]]


_received: list[Ended] = []


@contextmanager
def armed() -> Iterator[None]:
    """Raise `Ended` on the first Ctrl-C or SIGTERM."""
    before = {number: signal.signal(number, _end) for number in _WORDS}
    hook, sys.unraisablehook = sys.unraisablehook, _report
    try:
        yield
    finally:
        if not _received:  # after a signal, a second one must still kill the cleanup, without messages
            sys.unraisablehook = hook
            for number, handler in before.items():
                signal.signal(number, handler)


def _end(number: int, frame: Any) -> None:
    for other in _WORDS:
        signal.signal(other, signal.SIG_DFL)
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)  # about unfinished tasks of dask
    _received.append(Ended(number))
    raise _received[0]


def _report(unraisable: "sys.UnraisableHookArgs") -> None:
    if not _received:
        sys.__unraisablehook__(unraisable)
