"""A folder on a local or shared disk."""

import errno
import fcntl
import os
import shutil
import stat
import tempfile
import time
import uuid
import zlib
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from glob import escape
from pathlib import Path

from sat_intervals.errors import SatIntervalsError, open_regular
from sat_intervals.store.open_folder import (
    empty,
    flush_names,
    opened,
    opened_inside,
    read_small,
    remove_empty,
    write_new,
)

# Marks are few, and outlast a power loss. MADE has the `mark` of the run that made a folder.
_MARKS = ".sat-intervals."
MADE = f"{_MARKS}tiles"
# The lock file is regular and empty; any other file of this name is left unchanged.
_LOCK = ".sat-intervals.lock"
# Folder of the files of `LocalFolder.scratch`, beside the lock.
_FILES = "files"
# Seconds to wait for a lock.
_TIMEOUT = 0.2
# Status of the folders that this process has locked, by path.
_LOCKED: dict[Path, os.stat_result] = {}


@dataclass(frozen=True)
class LocalFolder:
    """See `Folder`. Files are renamed when complete; runs exclude each other with ``flock``.

    Nothing is written or deleted behind a link that is the folder or in it, in a folder without the mark of the run, or
    in one that took the place of one that this process has locked: files there are those of somebody else.

    Attributes
    ----------
    path
        The folder.
    depth
        Number of the folders above ``path`` that are folders of the store, too.
    run
        See `of_run`.
    """

    path: Path
    depth: int = field(default=0, compare=False)
    run: str = field(default="", compare=False)

    def __str__(self) -> str:
        """Return the path."""
        return str(self.path)

    def read(self, name: str) -> str | None:
        """See `Folder`."""
        content = self.read_bytes(name)
        return None if content is None else content.decode(errors="replace")

    def read_bytes(self, name: str) -> bytes | None:
        """See `Folder`."""
        try:
            with open_regular(self.path / name) as file:
                return file.read()
        except FileNotFoundError:
            return None
        except IsADirectoryError as error:
            raise _is_folder(self.path / name) from error

    def read_parts(self, parts: Sequence[tuple[str, int, int]]) -> list[bytes | None]:
        """See `Folder`."""
        return [self._part(*part) for part in parts]

    def _part(self, name: str, start: int, stop: int) -> bytes | None:
        try:
            with open_regular(self.path / name) as file:
                file.seek(start)
                return file.read(stop - start)
        except FileNotFoundError:
            return None

    def read_all(self, folder: str) -> dict[str, str]:
        """See `Folder`."""
        names: list[str] = []
        with suppress(FileNotFoundError, NotADirectoryError):
            names = os.listdir(self.path / folder)
        files = [Path(folder) / name for name in names if name.endswith(".json") and not name.startswith(".")]
        texts = {file.stem: self.read(str(file)) for file in files if (self.path / file).is_file()}
        return {name: text for name, text in texts.items() if text is not None}

    def sizes(self) -> dict[str, int]:
        """See `Folder`."""
        found = {}
        for place, folders, files in os.walk(self.path, onerror=_raise_unless_missing):
            for name in (*files, *(folder for folder in folders if os.path.islink(f"{place}/{folder}"))):
                with suppress(FileNotFoundError):  # deleted by another process
                    found[os.path.relpath(f"{place}/{name}", self.path)] = os.lstat(f"{place}/{name}").st_size
        return found

    def write(self, name: str, text: str) -> None:
        """See `Folder`."""
        self.write_bytes(name, text.encode())

    def write_bytes(self, name: str, content: bytes) -> None:
        """See `Folder`."""
        with self._written(name, content) as (folder, temporary, file):
            os.replace(temporary, file, src_dir_fd=folder, dst_dir_fd=folder)
            if name.startswith(_MARKS):
                flush_names(folder)

    def create(self, name: str, text: str) -> bool:
        """See `Folder`."""
        with self._written(name, text.encode()) as (folder, temporary, file):
            try:
                os.link(temporary, file, src_dir_fd=folder, dst_dir_fd=folder)
            except FileExistsError:
                return False
            except OSError:  # a file system without hard links
                if (self.path / name).exists():
                    return False
                os.replace(temporary, file, src_dir_fd=folder, dst_dir_fd=folder)
        return True

    @contextmanager
    def _written(self, name: str, content: bytes) -> Iterator[tuple[int, str, str]]:
        """Write a temporary file, deleted after the block; yield as `_entered`, with its name before the final one."""
        try:
            with self._entered(name) as (folder, file):
                temporary = f".{file}.{uuid.uuid4().hex}"
                try:
                    write_new(temporary, content, folder, is_flushed=name.startswith(_MARKS))
                    yield folder, temporary, file
                finally:
                    with suppress(FileNotFoundError):
                        os.unlink(temporary, dir_fd=folder)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path / name)) from error

    def delete(self, name: str) -> None:
        """See `Folder`."""
        with suppress(FileNotFoundError), self._entered(name) as (folder, file):
            os.unlink(file, dir_fd=folder)

    @property
    def _top(self) -> Path:
        """Return the folder of the store."""
        return (self.path, *self.path.parents)[self.depth]

    @contextmanager
    def _entered(self, name: str) -> Iterator[tuple[int, str]]:
        """Open the folder of a file; yield it, and the file's name in it. Raise if it would be somebody else's.

        What takes the place of a folder on the way meanwhile is not changed.
        """
        place, top = self.path / name, self._top
        for above in place.parents[: self.depth + len(Path(name).parts)]:
            if above.is_symlink():
                raise OSError(errno.ELOOP, f"{above} has become a symbolic link", str(place))
        with opened(top) as folder:
            if (locked := _LOCKED.get(top.absolute())) and not os.path.samestat(locked, os.fstat(folder)):
                raise OSError(errno.ESTALE, f"{top} has been replaced by another folder", str(place))
            made_by = read_small(MADE, folder) if self.run else mark(self.run)
            if made_by is None and name != MADE:
                raise OSError(errno.ESTALE, f"{top} has been replaced by a folder that no run made", str(place))
            if made_by and made_by != mark(self.run) and made_by == mark(made_by[:-8]):  # otherwise it is damaged
                raise OSError(errno.ESTALE, f"{top} has become the folder of another run", str(place))
            *way, last = place.relative_to(top).parts or (".",)
            with opened_inside(folder, way) as inside:
                yield inside, last

    def delete_all(self, names: Collection[str], folders: Collection[str] = ()) -> None:
        """See `Folder`."""
        for name in names:
            self.delete(name)
        for folder in folders:
            with suppress(FileNotFoundError), self._entered(folder) as (top, place):
                remove_empty(top, place)

    def delete_if_empty(self) -> None:
        """See `Folder`."""
        with suppress(OSError):
            self.path.rmdir()

    def inside(self, folder: str) -> "LocalFolder":
        """See `Folder`."""
        return LocalFolder(self.path / folder, self.depth + len(Path(folder).parts), self.run)

    def of_run(self, run: str) -> "LocalFolder":
        """See `Folder`."""
        return replace(self, run=run)

    def make(self, folder: str) -> None:
        """See `Folder`."""
        with suppress(FileNotFoundError), self._entered(folder):
            pass
        (self.path / folder).mkdir(parents=True, exist_ok=True)

    def place(self, name: str) -> Path:
        """See `Folder`."""
        return self.path / name

    def free_bytes(self) -> int:
        """See `Folder`."""
        return shutil.disk_usage(self.path).free

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder against other runs for the block.

        The lock ends with its process; an empty folder is deleted at the end.

        Raises
        ------
        SatIntervalsError
            Another run is active there, or the folder cannot be locked.
        """
        lock, path = self._lock(), self.path.absolute()
        try:
            _LOCKED[path] = path.stat()
            yield
        finally:
            _LOCKED.pop(path, None)
            # a process that opened it meanwhile notices the deletion, see _lock
            with suppress(OSError):
                ours, there = os.fstat(lock), (self.path / _LOCK).lstat()
                if os.path.samestat(ours, there) and not ours.st_size:
                    (self.path / _LOCK).unlink()
            os.close(lock)
            self.delete_if_empty()

    def _lock(self) -> int:
        """Open and lock the lock file; return its descriptor."""
        file = self.path / _LOCK
        end = time.monotonic() + _TIMEOUT
        while True:
            is_late = time.monotonic() > end
            try:
                self.path.mkdir(parents=True, exist_ok=True)
                lock = _opened(file, os.O_RDWR | os.O_CREAT)
            except OSError as error:
                if isinstance(error, (FileNotFoundError, FileExistsError)) and not is_late:
                    continue  # deleted by the last owner of the lock
                if isinstance(error, IsADirectoryError):
                    raise _is_folder(file) from error
                raise SatIntervalsError(f"{self} cannot be written: {error.strerror}: choose another folder") from error
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.path.samestat(os.fstat(lock), file.lstat()):
                    return lock
            except FileNotFoundError:
                pass
            except BlockingIOError as error:
                if is_late:  # before that, `is_locked` of another process may hold it
                    os.close(lock)
                    raise SatIntervalsError(
                        f"another run is active in {self}: wait for its end or choose another folder"
                    ) from error
                time.sleep(_TIMEOUT / 20)
            except OSError as error:
                os.close(lock)
                raise SatIntervalsError(
                    f"{self} cannot be locked: {error.strerror}: choose a folder on a file system with locks"
                ) from error
            os.close(lock)  # deleted or replaced before it was locked

    def is_locked(self) -> bool:
        """Return whether a run is active in the folder."""
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

    def has_lock(self) -> bool:
        """Return whether a process locks the folder, or was killed while it did."""
        with suppress(OSError):
            lock = (self.path / _LOCK).lstat()
            return stat.S_ISREG(lock.st_mode) and not lock.st_size
        return False

    @contextmanager
    def scratch(self, name: str, pattern: str) -> Iterator[Path]:
        """Yield a hidden folder for temporary files, new in this one; delete it after the block.

        Only files and folders there whose whole names match ``pattern`` are deleted; with any others it stays.
        Those of this name that killed processes left are deleted before. They are known by the lock file that is left.
        """
        for left in self.path.glob(f".{escape(name)}-*"):
            with suppress(OSError, SatIntervalsError):  # it is in use, or cannot be deleted
                if not left.is_symlink() and LocalFolder(left).has_lock():
                    with LocalFolder(left)._emptied(pattern):
                        pass
        made = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=self.path))
        with LocalFolder(made)._emptied(pattern) as folder:
            os.mkdir(_FILES, dir_fd=folder)
            yield made / _FILES

    @contextmanager
    def _emptied(self, pattern: str) -> Iterator[int]:
        """Lock and open the folder for the block; yield its descriptor, then delete its temporary files.

        They are deleted in this folder, even if a link has taken its place.
        """
        with self.locked(), opened(self.path) as folder:
            try:
                yield folder
            finally:
                try:
                    empty(folder, _FILES, pattern)
                except BaseException:  # a signal: without the lock file nobody would delete the rest
                    empty(folder, _FILES, pattern)
                    raise


def _raise_unless_missing(error: OSError) -> None:
    """Raise, since files of a folder that cannot be listed are not missing; it may have been deleted meanwhile."""
    if not isinstance(error, (FileNotFoundError, NotADirectoryError)):
        raise error


def mark(run: str) -> str:
    """Return the content of MADE: the digest of a run and its CRC-32, eight digits."""
    return f"{run}{zlib.crc32(run.encode()):08x}"


def _opened(file: Path, flags: int) -> int:
    """Open a lock file without truncating it or following a link; return its descriptor."""
    try:
        lock = os.open(file, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, f"{file.name} is a symbolic link") from error
        raise
    if not stat.S_ISREG(os.fstat(lock).st_mode):
        os.close(lock)
        raise OSError(errno.EINVAL, f"{file.name} is not a regular file")
    return lock


def _is_folder(place: Path) -> SatIntervalsError:
    return SatIntervalsError(f"{place} is a folder: move it away")
