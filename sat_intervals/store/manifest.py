"""The manifest of a run: what decides the bytes of its tiles, and where they are."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.products import as_json
from sat_intervals.store.folder import Folder, folder_at
from sat_intervals.tiling import Grid, Window

MANIFEST = "manifest.json"
# Key of the folder of the tiles, None where they are beside the manifest; it does not decide their bytes.
PLACE = "place"
# Key of a file that does not matter if its SHA-256 agrees.
_IGNORED = "modified"
# Characters of a value that a message shows.
_LONGEST = 80


class StoreError(SatIntervalsError):
    """Tiles of another run, or that cannot be used."""


def read_manifest(home: Path) -> dict[str, Any] | None:
    """Read the manifest in the folder of a run's tiles, None without one; raise StoreError if it is damaged."""
    try:
        manifest = json.loads((home / MANIFEST).read_bytes())
        grid_of(manifest)
        manifest[PLACE]
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (LookupError, TypeError, ValueError) as error:
        raise StoreError(
            f"{home / MANIFEST} is damaged: start again with --overwrite, or restore it to resume"
        ) from error
    return dict(manifest)


def write_manifest(home: Path, manifest: Mapping[str, Any]) -> None:
    """Write the manifest of a run."""
    folder_at(home).write(MANIFEST, as_json(manifest).encode(), is_flushed=True)


def grid_of(manifest: Mapping[str, Any]) -> Grid:
    """Return the grid of tiles of a manifest."""
    return Grid(Window(**manifest["region"]), int(manifest["settings"]["tiles"]["size"]))


def place_of(home: Path, manifest: Mapping[str, Any]) -> Folder:
    """Return the folder of the tiles of a manifest in ``home``."""
    return folder_at(manifest[PLACE] or home)


def digest(content: Any) -> str:
    """Return a name of 32 digits; contents without `differences` have the same."""

    def kept(there: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in there.items() if key not in (_IGNORED, PLACE)}

    same = json.dumps(json.loads(as_json(content, indent=None), object_hook=kept), sort_keys=True)
    return hashlib.sha256(same.encode()).hexdigest()[:32]


def differences(there: Any, wanted: Any, path: str = "") -> Iterator[str]:
    """Describe each value in which two contents differ, with its path."""
    if isinstance(there, dict) and isinstance(wanted, dict):
        for key in sorted((there.keys() | wanted.keys()) - {_IGNORED}):
            yield from differences(there.get(key), wanted.get(key), f"{path}.{key}".lstrip("."))
    elif isinstance(there, list) and isinstance(wanted, list) and len(there) == len(wanted):
        for place, pair in enumerate(zip(there, wanted, strict=True)):
            yield from differences(*pair, f"{path}.{place}")
    elif there != wanted:
        yield f"{path} was {_short(there)}, now {_short(wanted)}"


def changes(what: str, before: Any, now: Any) -> list[str]:
    """Return the differences of inputs from their description; raise RunError if a server does not answer now."""
    found = list(differences(before, now))
    if silent := [change for change in found if change.endswith("now null")]:
        raise RunError(f"{what} cannot be compared now ({silent[0]}): rerun the same command when its server answers")
    return found


def _short(value: Any) -> str:
    """Return a value as JSON, cut where a line would get too long, as of a whole calibration."""
    text = as_json(value, indent=None)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
