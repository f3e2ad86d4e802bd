"""What an interrupted run left in its tiles: the inputs that it described and the search range that it found."""

from pathlib import Path
from typing import Any

from sat_intervals.store.manifest import MANIFEST, unsealed
from sat_intervals.store.place import place_of
from sat_intervals.store.removal import SEARCH


def inputs_before(home: Path, store: str | None) -> dict[str, Any]:
    """Return the inputs in the manifest of existing tiles; empty if it cannot be read."""
    try:
        return dict((unsealed(place_of(home, store).read(MANIFEST)) or {}).get("inputs", {}))
    except (OSError, TypeError, ValueError):
        return {}


def search_before(home: Path, store: str | None, of: str) -> dict[str, Any] | None:
    """Return what `Store.write_search` wrote with existing tiles; None if it cannot be read or is of other images."""
    try:
        return unsealed(place_of(home, store).read(SEARCH), of)
    except (OSError, ValueError):
        return None
