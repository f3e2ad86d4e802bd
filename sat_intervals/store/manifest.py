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
# The key of the checksum of all others.
_SEAL = "crc32"
# What a manifest says of a file beside its content: it does not matter where SHA-256 agrees.
_BESIDE = ("modified", "stamp")


class StoreError(SatIntervalsError):
    """A store that belongs to another run, or cannot be written."""


def sealed(content: Mapping[str, Any]) -> str:
    """JSON of an object with its own checksum, so that no damage passes for content, see `unsealed`."""
    return json.dumps({**content, _SEAL: _checksum(content)}, indent=1)


def unsealed(text: str | None) -> dict[str, Any] | None:
    """What `sealed` made a text of; None for any other text, and for none."""
    try:
        content = json.loads(text or "")
    except (ValueError, RecursionError):
        return None
    is_whole = isinstance(content, dict) and content.pop(_SEAL, None) == _checksum(content)
    return content if is_whole else None


def _checksum(content: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(content).encode())


def parsed(manifest: str, folder: Folder) -> dict[str, Any]:
    """The manifest in a folder; one without a checksum is that of another version.

    Raises
    ------
    StoreError
        For what is none, or damaged.
    """
    try:
        there = json.loads(manifest)
        if not isinstance(there, dict):
            raise ValueError("it is no object")
        if _SEAL in there and unsealed(manifest) is None:
            raise ValueError("it is damaged")
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{folder}/{MANIFEST} cannot be read, {error}: --overwrite starts afresh") from error
    there.pop(_SEAL, None)
    return there


def grid_of(manifest: Mapping[str, Any], folder: Folder) -> Grid:
    """The tiles of a manifest.

    Raises
    ------
    StoreError
        For what is none.
    """
    try:
        return Grid(Window(**manifest["region"]), int(manifest["settings"]["tiles"]["size"]))
    except (LookupError, TypeError, ValueError) as error:
        raise StoreError(f"{folder}/{MANIFEST} is no manifest of a run: --overwrite starts afresh") from error


def check_same(there: str, folder: Folder, manifest: Mapping[str, Any]) -> None:
    """Refuse the manifest in a folder where it is not that of the run.

    Raises
    ------
    StoreError
        With every value that differs.
    """
    if changed := list(differences(parsed(there, folder), json.loads(json.dumps(manifest)))):
        raise StoreError(
            f"{folder} holds the tiles of another run: {'; '.join(changed)} "
            "(use the same settings and inputs to go on, --overwrite to start afresh)"
        )


def digest(manifest: Mapping[str, Any]) -> str:
    """A name of 32 digits that only manifests share in which `differences` finds none."""

    def without_times(there: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in there.items() if key not in _BESIDE}

    same = json.dumps(json.loads(json.dumps(manifest), object_hook=without_times), sort_keys=True)
    return hashlib.sha256(same.encode()).hexdigest()[:32]


def differences(there: Any, wanted: Any, path: str = "") -> Iterator[str]:
    """The values in which two manifests differ, each with its path; when a file was changed does not count."""
    if isinstance(there, dict) and isinstance(wanted, dict):
        for key in sorted((there.keys() | wanted.keys()) - set(_BESIDE)):
            yield from differences(there.get(key), wanted.get(key), f"{path}.{key}".lstrip("."))
    elif isinstance(there, list) and isinstance(wanted, list) and len(there) == len(wanted):
        for place, pair in enumerate(zip(there, wanted, strict=True)):
            yield from differences(*pair, f"{path}.{place}")
    elif there != wanted:
        yield f"{path} was {json.dumps(there)}, now {json.dumps(wanted)}"
