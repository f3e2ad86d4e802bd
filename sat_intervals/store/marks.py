"""Marker files in the folder of a run: which files it is to replace, and whether it has finished."""

import json
from contextlib import suppress
from pathlib import Path

from sat_intervals.store.folder import folder_at

# Present while a run replaces an earlier one, with the stamps of the files that it may replace.
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


def replaceable_files(home: Path) -> dict[str, str]:
    """Return the stamps of the files that an unfinished run is to replace, by name."""
    with suppress(ValueError, TypeError, RecursionError):
        return dict(json.loads(folder_at(home).read(REPLACING) or "{}"))
    return {}
