"""Which file an input is: what the manifest of a run compares, and run.json tells."""

import hashlib
from collections.abc import Mapping
from datetime import UTC, datetime
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

from sat_intervals.store.folder import object_tag

# Names of GDAL, as rasterio takes them too, of objects in the stores that fsspec knows.
_STORES = {"/vsis3/": "s3://", "/vsigs/": "gs://", "/vsiaz/": "az://"}
# Seconds for a server to answer.
_PATIENCE = 30


def identity(path: str, known: Mapping[str, Mapping[str, Any]] | None = None) -> dict[str, Any]:
    """What tells a file from any other.

    Parameters
    ----------
    path
        Local file, URL, or any name that GDAL opens.
    known
        What this function said before, by path: a file of the same size and time is not hashed again.

    Returns
    -------
    Of a local file its path, size in bytes, time of the last change and SHA-256. Of one that a server of HTTP or of
    objects offers, size in bytes and ETag, or time of the last change where it has none. The path alone of any other,
    and where the server answers to nobody but GDAL, who has credentials of its own.
    """
    file = Path(path)
    if file.is_file():
        return _of_file(file, known or {})
    name = path.removeprefix("/vsicurl/")
    if name.startswith(("http://", "https://")):
        return {"path": path} | _of_url(name)
    for prefix, scheme in _STORES.items():
        if path.startswith((prefix, scheme)):
            return {"path": path} | object_tag(path.replace(prefix, scheme, 1))
    return {"path": path}


def _of_file(file: Path, known: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    path, status = str(file.resolve()), file.stat()
    modified = datetime.fromtimestamp(status.st_mtime, UTC).isoformat()
    now = {"path": path, "bytes": status.st_size, "modified": modified}
    before = known.get(path, {})
    if all(before.get(key) == value for key, value in now.items()):
        return now | {"sha256": before["sha256"]}
    with file.open("rb") as stream:
        return now | {"sha256": hashlib.file_digest(stream, "sha256").hexdigest()}


def _of_url(url: str) -> dict[str, Any]:
    """By a request of one byte, which servers allow that refuse HEAD."""
    try:
        with urlopen(Request(url, headers={"Range": "bytes=0-0"}), timeout=_PATIENCE) as answer:
            headers = answer.headers
    except (OSError, HTTPException):
        return {}
    size = headers.get("Content-Range", "").rpartition("/")[2] or headers.get("Content-Length", "")
    tag = headers.get("ETag") or headers.get("Last-Modified")
    return {"bytes": int(size) if size.isdigit() else None, "etag": tag}


def is_changed(told: Mapping[str, Any]) -> bool:
    """Whether a file is no longer what `identity` told of it; where a server does not answer, it is not."""
    now = identity(told["path"], {told["path"]: told})
    if "sha256" in told:
        return bool(now.get("sha256") != told["sha256"])
    return bool(now.get("etag", told.get("etag")) != told.get("etag"))
