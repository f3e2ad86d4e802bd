"""Errors of the package, and checks of files and options that raise them."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

REPORT = "sat_intervals.report"
"""Name of the logger of the warnings of a run, which commands print below their table."""


class SatIntervalsError(ValueError):
    """Base class of the package's errors; the message names the file, the values and the way out."""


class InputError(SatIntervalsError):
    """An input that cannot be used."""


class RunError(SatIntervalsError):
    """A run that failed although its arguments are correct; finished tiles are kept, so it can be resumed."""


class ChangedInputError(RunError):
    """An input that was replaced or changed during a run."""


def check_file(path: str | os.PathLike[str], remedy: str) -> None:
    """Raise if a path, which may be in a bucket, is no file: it is missing, or a folder."""
    file = path if isinstance(path, Path) else Path(path)
    try:
        reason = None if file.is_file() else "is a folder" if file.is_dir() else "no such file"
    except OSError as error:
        way = "check server and credentials" if "://" in str(file) else remedy
        raise SatIntervalsError(f"{file}: {error.strerror}: {way}") from error
    if reason:
        raise SatIntervalsError(f"{file}: {reason}: {remedy}")


def check_absent(options: Mapping[str, Any], whose: str, place: str = "") -> None:
    """Raise for the first of some options that is given, not None; ``place`` begins the message."""
    for name, value in options.items():
        if value is not None:
            raise SatIntervalsError(f"{place}{name} is for {whose}: leave it out")
