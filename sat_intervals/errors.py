"""Errors of the package, and the check that a path is a regular file."""

import os
import stat
from io import BufferedReader

_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class SatIntervalsError(ValueError):
    """Base class of the package's errors; the message names the file, the values and the way out."""


class InputError(SatIntervalsError):
    """An input that cannot be used."""


class RunError(SatIntervalsError):
    """A run that failed although its arguments are correct; finished tiles are kept, so it can be resumed."""


class ChangedInputError(RunError):
    """An input that was replaced or changed during a run."""


class RemovedTilesError(RunError):
    """Tiles that the run itself removed, since they cannot be trusted."""


def check_regular(path: str | os.PathLike[str], way_out: str = "give a regular file") -> None:
    """Raise if a path is a local pipe, socket or device: reading it could block forever, and it must not be replaced.

    Missing files, folders and URLs pass; opening them gives a better message.

    Raises
    ------
    SatIntervalsError
        Names the path, its kind and the way out.
    """
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return
    _check_kind(path, status, way_out)


def check_file(path: str | os.PathLike[str], way_out: str) -> None:
    """Raise if a path is no file: it is missing, a folder, or see `check_regular`."""
    check_regular(path, way_out)
    if not os.path.isfile(path):
        reason = "is a folder" if os.path.isdir(path) else "no such file"
        raise SatIntervalsError(f"{os.fspath(path)}: {reason}: {way_out}")


def open_regular(path: str | os.PathLike[str]) -> BufferedReader:
    """Open a file for reading; raise as `check_regular` also if something else takes its place meanwhile."""
    check_regular(path)
    stream = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))  # noqa: SIM115
    try:
        _check_kind(path, os.fstat(stream.fileno()), "give a regular file")
    except SatIntervalsError:
        stream.close()
        raise
    return stream


def _check_kind(path: str | os.PathLike[str], status: os.stat_result, way_out: str) -> None:
    if kind := _KINDS.get(stat.S_IFMT(status.st_mode)):
        raise SatIntervalsError(f"{os.fspath(path)} is {kind}: {way_out}")
