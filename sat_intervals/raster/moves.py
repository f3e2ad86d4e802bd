"""Count the renamings of folders, which their times do not tell: a file that is made in one later sets them, too."""

import ctypes
import os
from collections import Counter
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from struct import iter_unpack
from threading import Lock

# Constants of Linux' inotify: a folder was renamed, only folders that are no links are watched, and events were lost.
_MOVED = 0x800
_WATCHED = 0x01000000 | 0x02000000
_LOST = 0x4000
_EVENT = "iIII"
_AT_ONCE = 4096  # bytes


class _Queue:
    """Events of all folders that this process has asked for."""

    def __init__(self) -> None:
        self._system = ctypes.CDLL(None)
        self._queue = self._system.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        self._moves: Counter[int] = Counter()
        self._lost = 0
        self._lock = Lock()

    def moves(self, folder: Path) -> tuple[int, int]:
        with self._lock:
            number = self._system.inotify_add_watch(self._queue, os.fsencode(folder), _MOVED | _WATCHED)
            with suppress(OSError):  # there are no more, or there is no queue
                while events := os.read(self._queue, _AT_ONCE):
                    for of_folder, kind, _, _ in iter_unpack(_EVENT, events):
                        self._moves[of_folder] += bool(kind & _MOVED)
                        self._lost += bool(kind & _LOST)
            return number, self._moves[number] + self._lost


def moves(folder: Path) -> tuple[int, int]:
    """Return a number of the folder at a path in this process, and how often it was renamed since it was first asked.

    The number is -1 for what is no folder, and where the system cannot watch it. On a network disk, only renamings by
    this machine count.
    """
    return _of_process(os.getpid()).moves(folder)


@lru_cache(maxsize=1)
def _of_process(_: int) -> _Queue:
    """Return the queue of a process; one that was forked would take the events of its parent."""
    return _Queue()
