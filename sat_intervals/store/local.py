"""A folder of this machine, or of a disk that it shares with others."""

import errno
import fcntl
import os
import shutil
import stat
import time
import uuid
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from sat_intervals.errors import SatIntervalsError, check_regular

# A file of this name that is regular and empty is ours; any other stays as it is.
_LOCK = ".sat-intervals.lock"
# Seconds for which a lock is tried.
_PATIENCE = 0.2


@dataclass(frozen=True)
class LocalFolder:
    """See `Folder`; files get their names when they are whole. Runs keep each other out by the system's own lock."""

    path: Path

    def __str__(self) -> str:
        """How users call it."""
        return str(self.path)

    def read(self, name: str) -> str | None:
        """See `Folder`."""
        content = self.read_bytes(name)
        return None if content is None else content.decode(errors="replace")

    def read_bytes(self, name: str) -> bytes | None:
        """See `Folder`."""
        check_regular(self.path / name)
        try:
            return (self.path / name).read_bytes()
        except FileNotFoundError:
            return None

    def read_all(self, folder: str) -> dict[str, str]:
        """See `Folder`."""
        files = (self.path / folder).glob("[!.]*.json")
        return {file.stem: file.read_text(errors="replace") for file in files if file.is_file()}

    def sizes(self) -> dict[str, int]:
        """See `Folder`."""
        found = {}
        for place, folders, files in os.walk(self.path):
            for name in (*files, *(folder for folder in folders if os.path.islink(f"{place}/{folder}"))):
                with suppress(FileNotFoundError):  # others may be at work here
                    found[os.path.relpath(f"{place}/{name}", self.path)] = os.lstat(f"{place}/{name}").st_size
        return found

    def write(self, name: str, text: str) -> None:
        """See `Folder`."""
        with self._written(name, text) as (temporary, file):
            os.replace(temporary, file)

    def create(self, name: str, text: str) -> bool:
        """See `Folder`."""
        with self._written(name, text) as (temporary, file):
            try:
                os.link(temporary, file)
            except FileExistsError:
                return False
            except OSError:  # a disk without links
                if file.exists():
                    return False
                os.replace(temporary, file)
        return True

    @contextmanager
    def _written(self, name: str, text: str) -> Iterator[tuple[Path, Path]]:
        """A file with the text that lasts as long as the block, and the one that it is to become."""
        file = self.path / name
        temporary = file.with_name(f".{file.name}.{uuid.uuid4().hex}")
        try:
            temporary.write_text(text, encoding="utf-8")
            yield temporary, file
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(file)) from error
        finally:
            temporary.unlink(missing_ok=True)

    def delete(self, name: str) -> None:
        """See `Folder`."""
        (self.path / name).unlink(missing_ok=True)

    def delete_all(self, names: Collection[str], folders: Collection[str] = ()) -> None:
        """See `Folder`."""
        for name in names:
            self.delete(name)
        for folder in folders:
            for place, _, _ in os.walk(self.path / folder, topdown=False):
                LocalFolder(Path(place)).delete_if_empty()

    def delete_if_empty(self) -> None:
        """See `Folder`."""
        with suppress(OSError):
            self.path.rmdir()

    def inside(self, folder: str) -> "LocalFolder":
        """See `Folder`."""
        return LocalFolder(self.path / folder)

    def make(self, folder: str) -> None:
        """See `Folder`."""
        (self.path / folder).mkdir(parents=True, exist_ok=True)

    def place(self, name: str) -> Path:
        """See `Folder`."""
        return self.path / name

    def free_bytes(self) -> int:
        """See `Folder`."""
        return shutil.disk_usage(self.path).free

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep every other run out until the block ends.

        The lock dies with its process, and a folder that is then empty goes.

        Raises
        ------
        SatIntervalsError
            When another run is at work there, or the folder cannot be used.
        """
        lock = self._lock()
        try:
            yield
        finally:
            # whoever opened it meanwhile sees that it is gone, see _lock
            with suppress(FileNotFoundError):
                ours, there = os.fstat(lock), (self.path / _LOCK).lstat()
                if os.path.samestat(ours, there) and not ours.st_size:
                    (self.path / _LOCK).unlink()
            os.close(lock)
            self.delete_if_empty()

    def _lock(self) -> int:
        """The descriptor of the lock's file, locked, under its name."""
        file = self.path / _LOCK
        end = time.monotonic() + _PATIENCE
        while True:
            is_late = time.monotonic() > end
            try:
                self.path.mkdir(parents=True, exist_ok=True)
                lock = _opened(file, os.O_RDWR | os.O_CREAT)
            except OSError as error:
                if isinstance(error, (FileNotFoundError, FileExistsError)) and not is_late:
                    continue  # removed by the one who left
                raise SatIntervalsError(f"{self} cannot be written: {error.strerror}: choose another folder") from error
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.path.samestat(os.fstat(lock), file.lstat()):
                    return lock
            except FileNotFoundError:
                pass
            except BlockingIOError as error:
                if is_late:  # else it may be held by one who only looks whether it is
                    os.close(lock)
                    raise SatIntervalsError(
                        f"another run is at work in {self}: wait for its end or choose another folder"
                    ) from error
                time.sleep(_PATIENCE / 20)
            except OSError as error:
                os.close(lock)
                raise SatIntervalsError(
                    f"{self} cannot be locked: {error.strerror}: choose a folder on a disk that has locks"
                ) from error
            os.close(lock)  # it was removed, or replaced, before it was locked

    def is_locked(self) -> bool:
        """Whether a run is at work there."""
        try:
            lock = _opened(self.path / _LOCK, os.O_RDONLY)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(lock)
        return False


def _opened(file: Path, flags: int) -> int:
    """The descriptor of a lock's file as it is: neither truncated nor opened through a link."""
    try:
        lock = os.open(file, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, f"{file.name} is a symbolic link") from error
        raise
    if not stat.S_ISREG(os.fstat(lock).st_mode):
        os.close(lock)
        raise OSError(errno.EINVAL, f"{file.name} is no regular file")
    return lock
