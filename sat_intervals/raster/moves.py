"""Count renamings and arrivals in folders, which their times do not tell: those of a later file hide an earlier one."""

import ctypes
import os
from collections import Counter, defaultdict
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from struct import calcsize, unpack_from
from threading import Lock

# Constants of Linux' inotify: a folder was renamed, a file was made in it, written, or renamed to it, only folders that
# are no links are watched, and events were lost.
_RENAMED = 0x800
_MADE, _WRITTEN, _NAMED = 0x100, 0x8, 0x80
# Part of a file was written: Linux counts equal events once that follow each other, and this comes between them.
_MODIFIED = 0x2
_WATCHED = 0x01000000 | 0x02000000
_LOST = 0x4000
_EVENT = "iIII"
_AT_ONCE = 1 << 16  # bytes
# Endings of overviews and of files that a program has not finished.
_UNREAD = ".ovr", ".tmp"


class _Queue:
    """Events of a kind in all folders that this process has asked for."""

    def __init__(self, kind: int) -> None:
        self._system, self._kind = ctypes.CDLL(None), kind
        self._queue = self._system.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        self._counts: defaultdict[int, Counter[tuple[int, str]]] = defaultdict(Counter)
        self._lost = 0
        self._lock = Lock()

    def counts(self, folder: Path) -> tuple[int, int, Counter[tuple[int, str]]]:
        """Return the number of a folder, how often events of any were lost, and its events by kind and name."""
        with self._lock:
            number = self._system.inotify_add_watch(self._queue, os.fsencode(folder), self._kind | _WATCHED)
            with suppress(OSError):  # there are no more, or there is no queue
                while events := os.read(self._queue, _AT_ONCE):
                    self._add(events)
            return number, self._lost, self._counts[number].copy()

    def _add(self, events: bytes) -> None:
        start = 0
        while start < len(events):
            number, kind, _, size = unpack_from(_EVENT, events, start)
            start += calcsize(_EVENT) + size
            self._lost += bool(kind & _LOST)
            if kind := kind & self._kind:
                self._counts[number][kind, os.fsdecode(events[start - size : start].rstrip(b"\0"))] += 1


def moves(folder: Path) -> tuple[int, int]:
    """Return a number of the folder at a path in this process, and how often it was renamed since it was first asked.

    The number is -1 for what is no folder, and where the system cannot watch it. On a network disk, only renamings by
    this machine count.
    """
    number, lost, counts = _of_process(os.getpid(), _RENAMED).counts(folder)
    return number, lost + counts[_RENAMED, ""]


def arrivals(folder: Path) -> dict[str, int]:
    """Return how often a file of each name was made, written or renamed to in a folder, since it was first asked.

    Making and writing one counts once. Empty where the system cannot watch the folder; some may be missing if there are
    thousands.
    """
    counts = _of_process(os.getpid(), _MADE | _WRITTEN | _NAMED | _MODIFIED).counts(folder)[2]
    names = {name for kind, name in counts if kind != _MODIFIED}
    return {name: max(counts[_MADE, name], counts[_WRITTEN, name]) + counts[_NAMED, name] for name in names}


def came_beside(files: Iterable[str]) -> dict[str, int]:
    """Return how often files came that GDAL may read with rasters, by path, see `arrivals`."""
    counts = {}
    for file in filter(os.path.isfile, files):
        folder, name = os.path.split(os.path.abspath(file))
        for other, count in arrivals(Path(os.path.realpath(folder))).items():
            if other != name and is_beside(other, name) and not other.lower().endswith(_UNREAD):
                counts[os.path.join(folder, other)] = count
    return counts


def is_beside(other: str, name: str) -> bool:
    """Return whether GDAL may read a file of one name with a raster of another in the same folder."""
    stem = os.path.splitext(name)[0].lower()
    return other.lower().startswith((f"{stem}.", f"{stem}_rpc."))


@lru_cache(maxsize=2)
def _of_process(_: int, kind: int) -> _Queue:
    """Return the queue of a process; one that was forked would take the events of its parent."""
    return _Queue(kind)
