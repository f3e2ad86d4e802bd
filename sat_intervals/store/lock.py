"""The lock of a folder: two commands never write one run."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sat_intervals.errors import SatIntervalsError
from sat_intervals.store.remote import disk_of

_LOCK = ".sat-intervals.lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Create and lock a folder for the block; the lock ends with its process, its file stays.

    A folder in a bucket is locked for the commands of this machine and user.
    """
    try:
        home, folder = folder, disk_of(folder)
        folder.mkdir(parents=True, exist_ok=True)
        stream = open(folder / _LOCK, "ab")  # noqa: SIM115
    except OSError as error:
        raise SatIntervalsError(f"{folder} cannot be written: {error.strerror}: choose another folder") from error
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            is_busy = isinstance(error, BlockingIOError)
            why = "another run is active in it: wait for its end" if is_busy else f"no lock there: {error.strerror}"
            raise SatIntervalsError(f"{home} cannot be used, {why} or choose another folder") from error
        yield


def is_locked(folder: Path) -> bool:
    """Return whether a run is active in a folder."""
    with suppress(FileNotFoundError):
        lock = os.open(disk_of(folder) / _LOCK, os.O_RDONLY)
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(lock)
    return False
