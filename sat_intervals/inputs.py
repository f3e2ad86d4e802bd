"""Which file an input is: what the manifest of a run compares, and run.json tells."""

import hashlib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np


def identity(path: str) -> dict[str, Any]:
    """Path, size in bytes, time of the last change and SHA-256 of a local file; the path alone of any other."""
    file = Path(path)
    if not file.is_file():
        return {"path": path}
    size, modified = _size_and_time(file)
    return {"path": str(file.resolve()), "bytes": size, "modified": modified, "sha256": _digest(file)}


def is_changed(told: dict[str, Any]) -> bool:
    """Whether a local file is no longer what `identity` told; it is read only where its time differs, not its size."""
    if "sha256" not in told:
        return False
    file = Path(told["path"])
    if not file.is_file():
        return True
    size, modified = _size_and_time(file)
    return bool(size != told["bytes"] or (modified != told["modified"] and _digest(file) != told["sha256"]))


def _size_and_time(file: Path) -> tuple[int, str]:
    status = file.stat()
    return status.st_size, datetime.fromtimestamp(status.st_mtime, UTC).isoformat()


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def pixels_digest(pixels: np.ndarray, state: np.ndarray) -> str:
    """Tells the pixels that a tile was made of from any others."""
    digest = hashlib.sha256()
    for array in (pixels, state):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
