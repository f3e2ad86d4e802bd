"""Recognise and delete the files of a run's tiles in a folder; other files are kept."""

import errno
import re
from contextlib import suppress
from pathlib import Path

from sat_intervals.store.folder import MADE, Folder, folder_at
from sat_intervals.store.manifest import MANIFEST, StoreError, grid_of, parsed
from sat_intervals.store.place import HOME, PLACE, is_of_another, run_of

# Errors that mean that a link or another folder took the place of one.
_REPLACED = errno.ELOOP, errno.ESTALE
# What to do where a store on a server does not answer.
_ON_SERVER = (
    "check the URL, the credentials, and whether the package of its file system is installed (pip install "
    "'sat-intervals[remote]' for s3://)"
)

ARRAYS, RECORDS, FAILURES = "arrays.zarr", "records", "failures"
BORDERS, PIXELS, COSTS, PARTS = "borders", "pixels", "costs", "parts"
FOLDERS = RECORDS, FAILURES, BORDERS, PIXELS, COSTS, PARTS
NORMALIZATION, SEARCH = "normalization.json", "range.json"
_OF_RUN = re.compile(
    rf"{re.escape(MADE)}|{re.escape(HOME)}|{MANIFEST}|{NORMALIZATION}|{SEARCH}"
    rf"|{ARRAYS}/(u?int\d+/|right/|seams/|histogram/)?zarr\.json"
)
_PART = re.compile(rf"{PARTS}/(?:[0-9a-f]{{32}}_\d+_\d+(?:\.json|_[a-z]+)|[0-9a-f]{{8}}_current)")
_OF_TILE = re.compile(
    rf"(?:{RECORDS}|{FAILURES})/(\d+)_(\d+)\.json"
    rf"|{BORDERS}/(\d+)_(\d+)_[0-3]"
    rf"|(?:{PIXELS}|{COSTS})/(\d+)_(\d+)"
    rf"|{ARRAYS}/(?:u?int\d+/c/0|right/c|seams/c|histogram/c)/(\d+)/(\d+)(?:/0)*"
)
# Folders of a run. If one of them were a link, writing would replace the user's files behind it.
_FOLDER = re.compile(
    rf"{'|'.join(FOLDERS)}|{ARRAYS}(?:/(?:u?int\d+(?:/c(?:/0(?:/\d+)?)?)?|(?:right|seams|histogram)(?:/c(?:/\d+)?)?))?"
)
# Temporary names of `LocalFolder` and of zarr, which a killed process leaves, with the final name as group.
_UNFINISHED = re.compile(r"(?:(?<=/)|^)\.([^/]+)\.[0-9a-f]{32}$"), re.compile(r"()\.[0-9a-f]{32}\.partial$")


def drop(folder: Folder) -> bool:
    """Delete the tiles of a run in a folder, and the folder if it is then empty; return whether none are left.

    Nothing is deleted if there is no sign of a run.
    """
    names, is_dropped = _names(folder), is_of_run(folder)
    if is_dropped:
        # The manifest first, since the rest is invalid without it. The mark last, to recognise an unfinished removal.
        folder.delete(MANIFEST)
        folder.delete_all(names - {MANIFEST, MADE}, [*FOLDERS, ARRAYS])
        folder.delete(MADE)
    folder.delete_if_empty()
    return is_dropped or not names


def drop_earlier(folder: Folder | None, home: Path, *, overwrite: bool) -> None:
    """Delete the tiles of an earlier run in the folder ``home``, if there are any.

    Those in a store that cannot be reached, or that another folder made of which this is a copy, are kept.

    Raises
    ------
    StoreError
        Those in the folder of the run cannot be deleted.
    """
    if folder is None:
        return
    if folder != folder_at(home):
        with suppress(OSError):
            if overwrite and (run := run_of(folder)) and not is_of_another(folder, home):
                drop(folder.of_run(run))
        return
    try:
        drop(folder)
    except OSError as error:
        raise unusable(folder, error, "removed") from error


def unusable(folder: Folder, error: OSError, how: str) -> StoreError:
    """Return the error for a folder of tiles that cannot be ``how``, such as "used", with the way out."""
    if Path(str(folder)).is_symlink():
        return StoreError(f"{folder} is a symbolic link: move it away")
    way_out = "move it away" if error.errno in _REPLACED else "make room, check its rights or choose another folder"
    if "://" in str(folder):
        way_out = _ON_SERVER
    return StoreError(f"{folder} cannot be {how}: {error.strerror or error}: {way_out}")


def check_not_foreign(folder: Folder) -> None:
    """Raise if a run would overwrite files in a folder that no run made, or write through a link.

    Raises
    ------
    StoreError
        Names some of the files.
    """
    if taken := sorted(name for name in folder.sizes() if _FOLDER.fullmatch(name)):
        raise StoreError(
            f"{folder}/{taken[0]} is a file or a symbolic link, but a folder of tiles is needed: move it away or "
            "choose another folder"
        )
    # unfinished files of a killed run have names that no run writes again
    names = {name for name in _names(folder) if name == final_name(name)}
    if not names or is_of_run(folder):
        return
    if there := sorted(names & folder.sizes().keys()):  # otherwise another run has just removed its tiles
        raise StoreError(
            f"{folder} has files without a sign of their run, such as {', '.join(there[:3])}: move them away or choose "
            "another folder"
        )


def _names(folder: Folder) -> set[str]:
    """Return the names of files named like those of a run; with a manifest, only those of its tiles."""
    grid = None
    with suppress(StoreError):
        grid = grid_of(parsed(folder.read(MANIFEST) or "", folder), folder)

    def is_named(name: str) -> bool:
        name = final_name(name)
        is_found = bool(_OF_RUN.fullmatch(name) or _PART.fullmatch(name))
        if is_found or (found := _OF_TILE.fullmatch(name)) is None:
            return is_found
        row, column = (int(number) for number in found.groups() if number is not None)
        return grid is None or (row < grid.rows and column < grid.columns)

    return {name for name in folder.sizes() if is_named(name)}


def is_part(name: str) -> bool:
    """Return whether a name is that of a file of a part, finished or not."""
    return _PART.fullmatch(final_name(name)) is not None


def final_name(name: str) -> str:
    """Return the name that an unfinished file was to have; that of any other file is unchanged."""
    for unfinished in _UNFINISHED:
        name = unfinished.sub(r"\1", name)
    return name


def is_of_run(folder: Folder) -> bool:
    """Return whether a run made a folder: it has its mark or a manifest."""
    if folder.read(MADE) is not None:
        return True
    with suppress(StoreError):
        return {"layout", "kernels"} <= parsed(folder.read(MANIFEST) or "", folder).keys()
    return False


def has_begun(home: Path) -> bool:
    """Return whether a run made this folder of tiles; a user's folder may have the same name."""
    return is_of_run(folder_at(home)) or folder_at(home).read(PLACE) is not None
