"""Which files in a folder are those of a run's tiles: these go with the run, all others stay."""

import json
import re
from contextlib import suppress

from sat_intervals.store.folder import Folder
from sat_intervals.store.manifest import MANIFEST, StoreError, grid_of, parsed, unsealed
from sat_intervals.store.zarr_arrays import MADE_BY

ARRAYS, RECORDS, FAILURES = "arrays.zarr", "records", "failures"
NORMALIZATION = "normalization.json"
_GROUP = f"{ARRAYS}/zarr.json"
_OF_RUN = re.compile(rf"{MANIFEST}|{NORMALIZATION}|{ARRAYS}/(u?int\d+/|right/|seams/|histogram/)?zarr\.json")
_OF_TILE = re.compile(
    rf"(?:{RECORDS}|{FAILURES})/(\d+)_(\d+)\.json"
    rf"|{ARRAYS}/(?:u?int\d+/c/0|right/c|seams/c|histogram/c)/(\d+)/(\d+)(?:/0)*"
)
# Folders of a run. Where one of these names is a link, files of the user would be written over behind it.
_FOLDER = re.compile(
    rf"{RECORDS}|{FAILURES}|{ARRAYS}(?:/(?:u?int\d+(?:/c(?:/0(?:/\d+)?)?)?|(?:right|seams|histogram)(?:/c(?:/\d+)?)?))?"
)
# What a death in the middle of a write leaves: names of `LocalFolder` and of zarr, and those that they were to become.
_UNFINISHED = re.compile(r"(?:(?<=/)|^)\.([^/]+)\.[0-9a-f]{32}$"), re.compile(r"()\.[0-9a-f]{32}\.partial$")


def drop(folder: Folder) -> None:
    """Delete the tiles of a run in a folder, and the folder where nothing else is in it.

    A folder without signs of a run keeps everything.
    """
    names = _names(folder)
    if is_of_run(folder):
        # The manifest first: without it nothing of the rest counts. The group last: it tells of a removal cut short.
        folder.delete(MANIFEST)
        folder.delete_all(names.keys() - {MANIFEST, _GROUP}, (RECORDS, FAILURES))
        folder.delete_all([_GROUP], [ARRAYS])
    folder.delete_if_empty()


def check_free(folder: Folder) -> None:
    """Refuse a folder in which a run would write over files that no run made, or through a link.

    Raises
    ------
    StoreError
        With the names of some.
    """
    if taken := sorted(name for name in folder.sizes() if _FOLDER.fullmatch(name)):
        raise StoreError(
            f"{folder}/{taken[0]} is a file or a symbolic link, where a folder of the tiles must be: move it away or "
            "choose another folder"
        )
    names = {name for name, size in _names(folder).items() if size}
    if not names or is_of_run(folder):
        return
    if there := sorted(names & folder.sizes().keys()):  # else another run removed its tiles meanwhile
        raise StoreError(
            f"{folder} holds files that no run made, such as {', '.join(there[:3])}: move them away or choose "
            "another folder"
        )


def _names(folder: Folder) -> dict[str, int]:
    """Bytes of the files that have names of a run's, by name; where there is a manifest, of its tiles only."""
    grid = None
    with suppress(StoreError):
        grid = grid_of(parsed(folder.read(MANIFEST) or "", folder), folder)

    def is_named(name: str) -> bool:
        for unfinished in _UNFINISHED:
            name = unfinished.sub(r"\1", name)
        if _OF_RUN.fullmatch(name) or (found := _OF_TILE.fullmatch(name)) is None:
            return _OF_RUN.fullmatch(name) is not None
        row, column = (int(number) for number in found.groups() if number is not None)
        return grid is None or (row < grid.rows and column < grid.columns)

    return {name: size for name, size in folder.sizes().items() if is_named(name)}


def is_of_run(folder: Folder) -> bool:
    """Whether a manifest, the arrays' description or a record tells that a run made this; one of them is enough."""
    with suppress(StoreError):
        if {"layout", "kernels"} <= parsed(folder.read(MANIFEST) or "", folder).keys():
            return True
    with suppress(ValueError, AttributeError):
        if json.loads(folder.read(_GROUP) or "").get("attributes") == MADE_BY:
            return True
    return any(unsealed(text) is not None for text in folder.read_all(RECORDS).values())
