"""Count renamings of folders and arrivals of files: times do not tell, since a later change hides an earlier one."""

import ctypes
import os
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping
from contextlib import suppress
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


class _Queue:
    """Events of a kind in all folders that this process has asked for."""

    def __init__(self, kind: int) -> None:
        self._system, self._kind = ctypes.CDLL(None), kind
        self._queue = -1
        self._begin()
        os.register_at_fork(after_in_child=self._begin)

    def _begin(self) -> None:
        """Forget everything: a forked process would take the events of its parent."""
        if self._queue >= 0:
            os.close(self._queue)
        self._queue = -1
        self._asked: defaultdict[int, set[str]] = defaultdict(set)
        self._counts: defaultdict[int, Counter[tuple[int, str]]] = defaultdict(Counter)
        self._lost = 0
        self._lock = Lock()

    def counts(self, folder: Path, names: Collection[str]) -> tuple[int, int, Mapping[tuple[int, str], int]]:
        """Return the number of a folder, how often events of any were lost, and its events by kind and name.

        ``names`` are those that count, in lower case: others have no end.
        """
        with self._lock:
            if self._queue < 0:
                self._queue = self._system.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
            number = self._system.inotify_add_watch(self._queue, os.fsencode(folder), self._kind | _WATCHED)
            self._asked[number].update(names)
            with suppress(OSError):  # there are no more, or there is no queue
                while events := os.read(self._queue, _AT_ONCE):
                    self._add(events)
            counts = {event: count for event, count in self._counts[number].items() if event[1].lower() in names}
            return number, self._lost, Counter(counts)

    def _add(self, events: bytes) -> None:
        start = 0
        while start < len(events):
            number, kind, _, size = unpack_from(_EVENT, events, start)
            start += calcsize(_EVENT) + size
            name = os.fsdecode(events[start - size : start].rstrip(b"\0"))
            self._lost += bool(kind & _LOST)
            if (kind := kind & self._kind) and name.lower() in self._asked[number]:
                self._counts[number][kind, name] += 1


_RENAMINGS, _ARRIVALS = _Queue(_RENAMED), _Queue(_MADE | _WRITTEN | _NAMED | _MODIFIED)


def moves(folder: Path) -> tuple[int, int] | None:
    """Return a number of the folder at a path in this process, and how often it was renamed since it was first asked.

    None for what is no folder, and where the system cannot watch it. On a network disk, only renamings by this machine
    count.
    """
    number, lost, counts = _RENAMINGS.counts(folder, ("",))
    return None if number < 0 else (number, lost + counts[_RENAMED, ""])


def arrivals(folder: Path, names: Collection[str]) -> dict[str, int]:
    """Return how often files were made, written or renamed to in a folder, since they were first asked for, by name.

    Making and writing one counts once. ``names`` are in lower case, and count in any case. Empty where the system
    cannot watch the folder; some may be missing if there are thousands.
    """
    counts = _ARRIVALS.counts(folder, names)[2]
    came = {name for kind, name in counts if kind != _MODIFIED}
    return {name: max(counts[_MADE, name], counts[_WRITTEN, name]) + counts[_NAMED, name] for name in came}
