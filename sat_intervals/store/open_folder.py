"""Write and delete in open folders, so that nothing that takes the place of one meanwhile is lost."""

import errno
import os
import re
import shutil
import stat
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

# Empty folders deleted at once.
_AT_ONCE = 16
_FLAGS = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW


@contextmanager
def opened(folder: Path) -> Iterator[int]:
    """Open a folder that is not a link; yield its descriptor."""
    descriptor = os.open(folder, _FLAGS)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


@contextmanager
def opened_inside(folder: int, names: Sequence[str]) -> Iterator[int]:
    """Open a folder inside an open one, by the names on the way to it, none of which may be a link; yield as above."""
    with ExitStack() as way:
        for name in names:
            descriptor = os.open(name, _FLAGS, dir_fd=folder)
            way.callback(os.close, descriptor)
            folder = descriptor
        yield folder


def write_new(name: str, content: bytes, folder: int, *, is_flushed: bool) -> None:
    """Write a new file in an open folder."""
    with open(name, "xb", opener=lambda path, flags: os.open(path, flags, 0o666, dir_fd=folder)) as stream:
        stream.write(content)
        if is_flushed:
            stream.flush()
            os.fsync(stream.fileno())


def flush_names(folder: int) -> None:
    """Flush new names in an open folder to the disk, where its file system does that."""
    try:
        os.fsync(folder)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise


def read_small(name: str, folder: int) -> str | None:
    """Read the beginning of a file in an open folder; None if there is no regular file."""
    try:
        file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ELOOP, errno.ENXIO):
            return None
        raise
    try:
        return os.read(file, 1024).decode(errors="replace") if stat.S_ISREG(os.fstat(file).st_mode) else None
    finally:
        os.close(file)


def empty(folder: int, name: str, pattern: str) -> None:
    """Delete what has names of this pattern in a folder inside an open one, and that folder if it gets empty."""
    with suppress(OSError):
        files = os.open(name, _FLAGS, dir_fd=folder)
        try:
            for file in filter(re.compile(pattern).fullmatch, os.listdir(files)):
                try:
                    os.unlink(file, dir_fd=files)
                except OSError:
                    shutil.rmtree(file, ignore_errors=True, dir_fd=files)
        finally:
            os.close(files)
        os.rmdir(name, dir_fd=folder)


def remove_empty(folder: int, name: str) -> None:
    """Delete a folder inside an open one, and those in it, as far as they contain no file. Links are not followed."""
    with suppress(OSError), ThreadPoolExecutor(_AT_ONCE) as threads:  # each takes milliseconds on some disks
        for _, folders, _, place in os.fwalk(name, topdown=False, dir_fd=folder):
            list(threads.map(partial(_remove, folder=place), folders))
        _remove(name, folder)


def _remove(name: str, folder: int) -> None:
    with suppress(OSError):
        os.rmdir(name, dir_fd=folder)
