"""Keep files in the place of a picture or page that this tool did not make."""

from collections.abc import Iterable
from pathlib import Path

from sat_intervals.errors import SatIntervalsError

# Text near the beginning of the tool's pictures and pages.
_MARKS = b"tEXtSoftware\0sat-intervals", b'<meta name="generator" content="sat-intervals">'
_BEGINNING = 1024  # bytes


def check_made_here(paths: Iterable[Path]) -> None:
    """Raise if one of the files exists without the mark of this tool. Links are replaced, never followed: they pass.

    Raises
    ------
    SatIntervalsError
        Names the first such file.
    """
    for path in paths:
        if path.is_file() and not path.is_symlink():
            try:
                with path.open("rb") as stream:
                    beginning = stream.read(_BEGINNING)
            except OSError as error:
                raise SatIntervalsError(f"{path} exists and cannot be read: {error.strerror}: move it away") from error
            if not any(mark in beginning for mark in _MARKS):
                raise SatIntervalsError(
                    f"{path} exists and was not made by sat-intervals, or by a version that left no mark in it: move "
                    "it away"
                )
