"""Where the tiles of a run are: in its own folder, or in a store that a note there names.

A folder of a run may come from somebody else, and so may its note: the tool follows it only to a place inside the store
that the user names as well, and deletes there only what bears the name of its own manifest.
"""

import json
from pathlib import Path

from sat_intervals.store.folder import Folder, folder_at
from sat_intervals.store.manifest import MANIFEST, StoreError, digest, parsed

# In the folder of the run where its tiles are elsewhere: it says where.
PLACE = ".sat-intervals.store"


class ElsewhereError(StoreError):
    """Tiles that are said to be in a store that the user did not name: what is ``said``, and the way out."""

    def __init__(self, said: str, way_out: str) -> None:
        super().__init__(f"{said}: {way_out}")
        self.said = said


def place_of(home: Path, store: str | None) -> Folder:
    """Where the tiles are of the run to whose folder ``home`` belongs.

    Parameters
    ----------
    home
        Folder of the tiles in that of the run.
    store
        The store that the user names; None without.

    Raises
    ------
    ElsewhereError
        Where the note in ``home`` names another store. Nothing was read there.
    """
    noted = folder_at(home).read(PLACE)
    try:
        place = json.loads(noted) if noted else None
    except (ValueError, RecursionError):
        place = None
    if noted is None:
        return folder_at(home)
    if not isinstance(place, str) or "/" not in place:
        raise StoreError(f"{home / PLACE} cannot be read: give the --store of before to go on, or --overwrite")
    above, _, name = place.rpartition("/")
    if store is None or above != str(folder_at(store)) or name in ("", ".", ".."):
        raise ElsewhereError(
            f"the tiles of the run in {home.parent} are said to lie in {place}{f', not in {store}' if store else ''}",
            f"if that is your store, give --store {above}; match --overwrite starts afresh and leaves them there",
        )
    return folder_at(place)


def is_own(folder: Folder) -> bool:
    """Whether a folder of a store was made by a run: its name ends with the digest of the manifest in it."""
    text = folder.read(MANIFEST)
    try:
        return text is not None and str(folder).endswith(digest(parsed(text, folder)))
    except StoreError:
        return False
