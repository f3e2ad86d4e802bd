"""Disk space that files need at most."""

import errno
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sat_intervals.raster.files import File
from sat_intervals.raster.old_publishing import OutputError

WAY_OUT = "free disk space or choose another folder"
# Errors of the path: more space does not help.
_OF_PATH = FileExistsError, NotADirectoryError, PermissionError
# Bytes of compressed pixels in those of the pixels, at most: noisy bands take a quarter, see `blocks`.
_SHARE = 0.5


def pixel_bytes(files: Sequence[File]) -> int:
    """Return the bytes of a pixel of all files, not compressed."""
    return sum(len(file.bands) * np.dtype(file.dtype).itemsize for file in files)


def file_bytes(files: Sequence[File], height: int, width: int) -> int:
    """Return the size of files with their overviews, at most."""
    share = sum(pixel_bytes([file]) * (1 if file.compression == "none" else _SHARE) for file in files)
    return round(height * width * share * 4 / 3)


def part_bytes(files: Sequence[File], height: int, width: int) -> int:
    """Return the size of the parts of files, at most; pixels of overviews are not compressed there."""
    return file_bytes(files, height, width) + height * width * pixel_bytes(files) // 3


def check_space(folder: Path, needed: int, what: str) -> None:
    """Raise if a folder has not enough free space for ``what``, which may need so many bytes.

    Raises
    ------
    OutputError
        Gives free and needed space.
    """
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise OutputError(f"{folder} has {_size(free)} free, {what} may need {_size(needed)}: {WAY_OUT}")


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB"


def way_out(error: Exception) -> str:
    """Return what to do about an error of writing."""
    if isinstance(error, FileNotFoundError):  # the folder was moved away meanwhile, or nothing can be made there
        return "rerun the command or choose another folder"
    if isinstance(error, IsADirectoryError):
        return "move it away"
    if getattr(error, "errno", None) == errno.ESTALE:
        return "rerun the command"
    return "choose another folder" if isinstance(error, _OF_PATH) else WAY_OUT
