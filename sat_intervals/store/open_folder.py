"""Delete in open folders, so that nothing that takes the place of one meanwhile is lost."""

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_FLAGS = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW


@contextmanager
def opened(folder: Path) -> Iterator[int]:
    """Open a folder that is not a link; yield its descriptor."""
    descriptor = os.open(folder, _FLAGS)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


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
