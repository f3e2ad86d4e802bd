"""The manifest of a store: everything that decides the bytes of its tiles."""

import hashlib
import json
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

from sat_intervals.errors import SatIntervalsError
from sat_intervals.store.folder import Folder
from sat_intervals.tiling import Grid, Window

MANIFEST = "manifest.json"
# Key of the checksum of all other keys.
SEAL = "crc32"
# Other commands than match and batch have no --overwrite.
_WAY_OUT = "start again with --overwrite or move it away"
# Keys of a file that do not matter if its SHA-256 agrees.
_IGNORED = ("modified", "stamp")
# Characters of a value that a message shows.
_LONGEST = 80


class StoreError(SatIntervalsError):
    """A store of another run, or one that cannot be used."""


def sealed(content: Mapping[str, Any], of: str = "") -> str:
    """Return an object as JSON with a checksum, so that damage is detected, see `unsealed`.

    ``of`` says what the object belongs to, so that one of another run or tile is not taken for it.
    """
    return json.dumps({**content, SEAL: _checksum(content, of)}, indent=1)


def unsealed(text: str | None, of: str = "") -> dict[str, Any] | None:
    """Return the object of a `sealed` text; None for any other text and for None."""
    try:
        content = json.loads(text or "")
    except (ValueError, RecursionError):
        return None
    is_whole = isinstance(content, dict) and content.pop(SEAL, None) == _checksum(content, of)
    return content if is_whole else None


def _checksum(content: Mapping[str, Any], of: str) -> int:
    return zlib.crc32((of + json.dumps(content)).encode())


def parsed(manifest: str, folder: Folder) -> dict[str, Any]:
    """Parse the manifest of a folder; one without a checksum is from another version.

    Raises
    ------
    StoreError
        It is not a manifest, or damaged.
    """
    try:
        there = json.loads(manifest)
        if not isinstance(there, dict):
            raise ValueError("it is not an object")
        if SEAL in there and unsealed(manifest) is None:
            raise ValueError("it is damaged")
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{folder}/{MANIFEST} cannot be read, {error}: {_WAY_OUT}") from error
    there.pop(SEAL, None)
    return there


def grid_of(manifest: Mapping[str, Any], folder: Folder) -> Grid:
    """Return the grid of tiles of a manifest.

    Raises
    ------
    StoreError
        It is not a manifest of a run.
    """
    try:
        return Grid(Window(**manifest["region"]), int(manifest["settings"]["tiles"]["size"]))
    except (LookupError, TypeError, ValueError) as error:
        raise StoreError(f"{folder}/{MANIFEST} is not a manifest of a run: {_WAY_OUT}") from error


def check_same(there: str, folder: Folder, manifest: Mapping[str, Any]) -> None:
    """Raise if the manifest in a folder differs from that of the run.

    Raises
    ------
    StoreError
        Lists every value that differs.
    """
    if changed := list(differences(parsed(there, folder), json.loads(json.dumps(manifest)))):
        raise StoreError(
            f"{folder} holds the tiles of another run: {'; '.join(changed)} "
            "(use the same settings and inputs to resume, or --overwrite to start again)"
        )


def digest(manifest: Mapping[str, Any]) -> str:
    """Return a name of 32 digits; manifests without `differences` have the same."""

    def without_times(there: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in there.items() if key not in _IGNORED}

    same = json.dumps(json.loads(json.dumps(manifest), object_hook=without_times), sort_keys=True)
    return hashlib.sha256(same.encode()).hexdigest()[:32]


def differences(there: Any, wanted: Any, path: str = "") -> Iterator[str]:
    """Describe each value in which two manifests differ, with its path; modification times are ignored."""
    if isinstance(there, dict) and isinstance(wanted, dict):
        for key in sorted((there.keys() | wanted.keys()) - set(_IGNORED)):
            yield from differences(there.get(key), wanted.get(key), f"{path}.{key}".lstrip("."))
    elif isinstance(there, list) and isinstance(wanted, list) and len(there) == len(wanted):
        for place, pair in enumerate(zip(there, wanted, strict=True)):
            yield from differences(*pair, f"{path}.{place}")
    elif there != wanted:
        yield f"{path} was {_short(there)}, now {_short(wanted)}"


def _short(value: Any) -> str:
    """Return a value as JSON, cut where a line would get too long for a message, as of a whole calibration."""
    text = json.dumps(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
