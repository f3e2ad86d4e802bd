"""The one family of errors this package raises for what a user can put right; and the check that a path is a file."""

import os
import stat

_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class SatIntervalsError(ValueError):
    """Base of every error of the package: one line that names what clashes and the way out."""


class RunError(SatIntervalsError):
    """A run that failed on its way, by no fault of its arguments; what is done is kept for the next try."""


def check_regular(path: str | os.PathLike[str]) -> None:
    """Refuse a local pipe, socket or device, which could be waited for without end.

    Names of nothing, of folders and of what is elsewhere pass: whoever opens them knows better what to say.

    Raises
    ------
    SatIntervalsError
        With the path and what it is.
    """
    try:
        kind = _KINDS.get(stat.S_IFMT(os.stat(path).st_mode))
    except (OSError, ValueError):
        return
    if kind:
        raise SatIntervalsError(f"{os.fspath(path)} is {kind}: give a regular file")
