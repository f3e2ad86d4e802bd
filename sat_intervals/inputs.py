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
    status = file.stat()
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return {
        "path": str(file.resolve()),
        "bytes": status.st_size,
        "modified": datetime.fromtimestamp(status.st_mtime, UTC).isoformat(),
        "sha256": digest,
    }


def pixels_digest(pixels: np.ndarray, state: np.ndarray) -> str:
    """Tells the pixels that a tile was made of from any others."""
    digest = hashlib.sha256()
    for array in (pixels, state):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
