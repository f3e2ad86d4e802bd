"""Give files their names once they are whole: every command writes its files with `new_file`."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sat_intervals.errors import SatIntervalsError

# Errors of the path: more space does not help.
_OF_PATH = FileExistsError, NotADirectoryError, PermissionError


class OutputError(SatIntervalsError):
    """An output that cannot be written."""


def check_free(path: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Raise OutputError if a file exists that may not be replaced, or a folder has its name."""
    if os.path.isdir(path):
        raise OutputError(f"{path} is a folder: choose another name")
    if os.path.lexists(path) and not overwrite:
        raise OutputError(f"{path} exists: choose another name or --overwrite")


@contextmanager
def new_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary name beside a path, for the block to write the file; rename it at the end, or delete it.

    The temporary file exists, is empty, and must be written in place. The next call replaces what a killed process
    left of it.

    Raises
    ------
    OutputError
        The file cannot be written, or another process is writing it.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.part")
    with _failing(path, temporary), open(temporary, "ab") as stream:
        _lock(stream.fileno(), temporary, path)
        try:
            stream.truncate(0)
            yield temporary
            os.fsync(stream.fileno())
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        _flush_folder(path.parent)


def write_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a small file with `new_file`."""
    with new_file(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def _failing(path: Path, temporary: Path) -> Iterator[None]:
    """Turn errors of writing a file into an OutputError with its final name."""
    try:
        yield
    except OSError as error:
        if error.filename not in (None, str(temporary), str(path)):
            raise
        raise OutputError(f"{path} cannot be written: {error.strerror or error}: {way_out(error)}") from error


def way_out(error: OSError) -> str:
    """Return what to do about an error of writing."""
    if isinstance(error, (FileNotFoundError, IsADirectoryError, *_OF_PATH)):
        return "choose another name or folder"
    return "free disk space or choose another folder"


def _lock(descriptor: int, temporary: Path, path: Path) -> None:
    with suppress(FileNotFoundError):  # renamed by the process that has written it
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(descriptor), temporary.stat()):
                return
        except BlockingIOError:
            pass
        except OSError:  # a file system without locks
            return
    raise OutputError(f"{path} is being written by another command: wait for its end")


def _flush_folder(folder: Path) -> None:
    """Flush new names to the disk, where its file system does that."""
    descriptor = os.open(folder, os.O_RDONLY)
    with suppress(OSError):
        os.fsync(descriptor)
    os.close(descriptor)
