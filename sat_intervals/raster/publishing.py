"""Give files their names once they are whole: every command writes its files with `new_file`."""

import fcntl
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from io import BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import as_json
from sat_intervals.raster import gdal
from sat_intervals.raster.files import File
from sat_intervals.store.remote import RemotePath, disk_of, is_there, path_of

_REMEDY = "free disk space or choose another folder"
# Errors of the path: more space does not help.
_OF_PATH = FileExistsError, FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError
# Bytes of compressed pixels in those of the pixels, at most: noisy bands take a quarter, see `blocks`.
_SHARE = 0.5


class OutputError(SatIntervalsError):
    """An output that cannot be written."""


def check_free(path: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Raise OutputError if a file exists that may not be replaced, or a folder has its name."""
    path = path_of(path)
    is_used = is_there(path)
    if is_used and path.is_dir():
        raise OutputError(f"{path} is a folder: choose another name")
    if is_used and not overwrite:
        raise OutputError(f"{path} exists: choose another name or --overwrite")


@contextmanager
def new_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield an empty temporary file beside a path, to be written in place; rename it at the end, or delete it.

    Of a path in a bucket it is on a disk, see `disk_of`, and is uploaded.
    The next call replaces what a killed process left. Raise OutputError if another process is writing the file.
    """
    with failing(path := path_of(path)), unfinished(path) as file:
        yield file.temporary
        file.flush()
        file.commit()


def write_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a small file with `new_file`."""
    with new_file(path) as temporary:
        temporary.write_bytes(content)


def write_record(path: str | os.PathLike[str], content: Any) -> None:
    """Write a record with `new_file`, as JSON."""
    write_file(path, f"{as_json(content)}\n".encode())


@dataclass
class Unfinished:
    """A file that is written in place under a temporary name."""

    path: Path
    temporary: Path
    stream: BufferedWriter
    is_committed: bool = False

    def flush(self) -> None:
        """Flush the content to the disk."""
        os.fsync(self.stream.fileno())

    def commit(self) -> None:
        """Give the file its name."""
        if isinstance(self.path, RemotePath):
            self.path.upload(self.temporary)
            return
        os.replace(self.temporary, self.path)
        self.is_committed = True
        _flush_folder(self.path.parent)


@contextmanager
def unfinished(path: Path) -> Iterator[Unfinished]:
    """Lock a temporary file beside a path for the block; delete it at the end unless it was committed."""
    temporary = _temporary(path)
    with ExitStack() as stack:
        with failing(path):
            if isinstance(path, RemotePath):
                temporary.parent.mkdir(parents=True, exist_ok=True)
            stream = stack.enter_context(open(temporary, "ab"))
            _lock(stream.fileno(), temporary, path)
            stream.truncate(0)
        file = Unfinished(path, temporary, stream)
        try:
            yield file
        finally:
            if not file.is_committed:
                temporary.unlink(missing_ok=True)


@contextmanager
def failing(path: Path) -> Iterator[None]:
    """Turn errors of writing a file into an OutputError with its final name; errors of other folders pass."""
    try:
        yield
    except (*gdal.GDAL_ERRORS, OSError) as error:
        name = getattr(error, "filename", None)
        if name is not None and path_of(name) not in (path, _temporary(path), *path.parents):
            raise
        reason = getattr(error, "strerror", None) or gdal.reason(error)
        of_path = "choose another name or folder" if isinstance(error, _OF_PATH) else _REMEDY
        what = f"{reason}: {'check server and credentials' if '://' in str(name) else of_path}"
        if gdal.is_out_of_memory(error):
            what = f"not enough memory ({gdal.reason(error)}): give the process more memory"
        raise OutputError(f"{path} cannot be written: {what}") from error


def _temporary(path: Path) -> Path:
    return disk_of(path.parent) / f".{path.name}.part"


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


def pixel_bytes(files: Sequence[File]) -> int:
    """Return the bytes of a pixel of all files, not compressed."""
    return sum(len(file.bands) * np.dtype(file.dtype).itemsize for file in files)


def file_bytes(files: Sequence[File], height: int, width: int) -> int:
    """Return the size of files with their overviews, at most."""
    return round(height * width * pixel_bytes(files) * _SHARE * 4 / 3)


def part_bytes(files: Sequence[File], height: int, width: int) -> int:
    """Return the size of the parts of files, at most; pixels of overviews are not compressed there."""
    return file_bytes(files, height, width) + height * width * pixel_bytes(files) // 3


def check_space(folder: Path, needed: int, what: str) -> None:
    """Raise OutputError if a folder has not enough free space for ``what``, which may need so many bytes."""
    folder = disk_of(folder)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise OutputError(f"{folder} has {_size(free)} free, {what} may need {_size(needed)}: {_REMEDY}")


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB"
