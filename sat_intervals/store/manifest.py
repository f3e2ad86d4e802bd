"""The manifest of a store: everything that decides the bytes of its tiles."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

from sat_intervals.errors import SatIntervalsError
from sat_intervals.store.folder import Folder

MANIFEST = "manifest.json"
# What a manifest says of a file beside its content: it does not matter where SHA-256 agrees.
_BESIDE = ("modified", "stamp")


class StoreError(SatIntervalsError):
    """A store that belongs to another run, or cannot be written."""


def parsed(manifest: str, folder: Folder) -> dict[str, Any]:
    """The manifest in a folder.

    Raises
    ------
    StoreError
        For what is none.
    """
    try:
        return dict(json.loads(manifest))
    except (ValueError, TypeError) as error:
        raise StoreError(f"{folder}/{MANIFEST} cannot be read, {error}: --overwrite starts afresh") from error


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
