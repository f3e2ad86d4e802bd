"""Location of a run's tiles: in its folder, or in a store named by a file there.

The folder of a run, and so that file, may come from someone else. It is followed only into the store that the user
names too, and only folders named after their own manifest or mark are deleted there.
"""

import json
import os
from contextlib import suppress
from pathlib import Path

from sat_intervals.store.folder import MADE, Folder, folder_at, mark
from sat_intervals.store.manifest import MANIFEST, StoreError, digest, parsed

# File in the folder of a run that names the location of its tiles, if they are elsewhere.
PLACE = ".sat-intervals.store"
# File beside tiles in a store that names the `home` whose run made them.
HOME = ".sat-intervals.home"


class ElsewhereError(StoreError):
    """Tiles in a store that the user did not name; the message is ``problem`` and the way out."""

    def __init__(self, problem: str, way_out: str) -> None:
        super().__init__(f"{problem}: {way_out}")
        self.problem = problem


def place_of(home: Path, store: str | None) -> Folder:
    """Return the folder of a run's tiles.

    Parameters
    ----------
    home
        Folder of the tiles in the folder of the run.
    store
        The store that the user names, or None.

    Raises
    ------
    ElsewhereError
        The file in ``home`` names another store. Nothing was read there.
    """
    noted = folder_at(home).read(PLACE)
    try:
        place = json.loads(noted) if noted else None
    except (ValueError, RecursionError):
        place = None
    if noted is None:
        return folder_at(home)
    if not isinstance(place, str) or "/" not in place:
        raise StoreError(f"{home / PLACE} cannot be read: give the same --store as before to resume, or --overwrite")
    above, _, name = place.rpartition("/")
    if store is None or above != str(folder_at(store)) or name in ("", ".", ".."):
        raise ElsewhereError(
            f"{home / PLACE} places the tiles of the run in {place}{f', not in {store}' if store else ''}",
            f"if that is your store, give --store {above}; match --overwrite starts again and keeps them there",
        )
    return folder_at(place)


def run_of(folder: Folder) -> str:
    """Return the run that made a folder of a store: the digest of its manifest, with which its name ends; "" if none.

    Without a manifest that can be read, the mark of the folder has that digest: a removal deletes the manifest first,
    and a power loss may empty it.
    """
    made_by = folder.read(MADE) or ""
    run = made_by[:-8] if made_by == mark(made_by[:-8]) else ""
    with suppress(StoreError):
        run = digest(parsed(folder.read(MANIFEST) or "", folder))
    return run if str(folder).endswith(run) else ""


def is_of_another(folder: Folder, home: Path) -> bool:
    """Return whether another folder made the tiles in a folder of a store and still names it: this one is a copy."""
    try:
        maker = json.loads(folder.read(HOME) or "null")
        is_elsewhere = os.path.isabs(maker) and os.path.realpath(maker) != os.path.realpath(home)
        return is_elsewhere and folder_at(maker).read(PLACE) == json.dumps(str(folder))
    except PermissionError:  # that of another user, who may still need them
        return True
    except (NotADirectoryError, ValueError, TypeError, RecursionError):  # the note is missing or damaged
        return False
