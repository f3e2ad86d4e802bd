"""Marker files in the folder of a run: which files it is to replace, and whether it has finished."""

import json
from contextlib import suppress
from pathlib import Path

from sat_intervals.store.folder import folder_at
from sat_intervals.store.manifest import StoreError

# Present while a run replaces an earlier one, with its digest and the stamps of the files that it may replace.
REPLACING = ".sat-intervals.replacing"
# Name of a run and stamps of its files, from their publication to the removal of its tiles.
FINISHED = ".sat-intervals.finished"


def finished_run(home: Path) -> tuple[str, list[str]] | None:
    """Return name and stamps of `Store.mark_finished`; None if not marked or the tiles were removed since."""
    run, *stamps = (folder_at(home).read(FINISHED) or "").split("\n")
    return (run, stamps) if run else None


def is_replacing(home: Path) -> bool:
    """Return whether an unfinished run is to replace the files of an earlier one."""
    return folder_at(home).read(REPLACING) is not None


def replaceable_files(home: Path, run: str) -> dict[str, str] | None:
    """Return the stamps of the files that the run of a digest is to replace, by name; None if it is another run."""
    mark = folder_at(home).read(REPLACING)
    if mark is None:
        return {}
    with suppress(ValueError, LookupError, TypeError, RecursionError):
        there = json.loads(mark)
        return dict(there["files"]) if there["run"] == run else None
    return None


def check_replacing(home: Path, run: str) -> None:
    """Raise if another run was killed before it replaced the files of an earlier one.

    Raises
    ------
    StoreError
        Says to overwrite them.
    """
    if replaceable_files(home, run) is None:
        raise StoreError(
            f"{home.parent} has the results of an earlier run, which another run was to replace: give --overwrite"
        )
