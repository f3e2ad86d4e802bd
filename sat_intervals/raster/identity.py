"""Which file an input is, as manifests and run.json tell; whether it still is; whether an output would replace it."""

import hashlib
import os
import re
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from functools import lru_cache
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

from sat_intervals.errors import RunError, SatIntervalsError, check_regular
from sat_intervals.store.folder import object_tag

# Names of GDAL, as rasterio takes them too, of objects in the stores that fsspec knows.
_STORES = {"/vsis3/": "s3://", "/vsigs/": "gs://", "/vsiaz/": "az://"}
# What GDAL puts before the name of a file to look inside it: an archive, or, with offset and size, a part of a file.
_INSIDE = re.compile(r"/vsi\w+/(\d+(_\d+)?,)?")
# Seconds for a server to answer.
_PATIENCE = 30
# How often a file is hashed that is touched meanwhile.
_TRIES = 3


class ChangedInputError(RunError):
    """An input that was replaced or changed while a run worked on it."""


def identity(path: str, known: Mapping[str, Mapping[str, Any]] | None = None) -> dict[str, Any]:
    """What tells a file from any other.

    Parameters
    ----------
    path
        Local file, URL, or any name that GDAL opens.
    known
        What this function said before, by path: a file of the same stamp is not hashed again.

    Returns
    -------
    Of a local file its path, size in bytes, time of the last change, SHA-256, and a stamp: inode and times in
    nanoseconds, of which no user can put back that of the last change of the inode. Of one inside an archive those of
    the archive. Of one that a server of HTTP or of objects offers, size in bytes and ETag, or time of the last change
    where it has none. The path alone of any other, and where the server answers to nobody but GDAL, who has credentials
    of its own.

    Raises
    ------
    ChangedInputError
        A file that is being written.
    SatIntervalsError
        A pipe or a device.
    """
    check_regular(path)
    if file := _local_file(path):
        name = str(file.resolve()) if file == Path(path) else path
        return {"path": name} | _of_file(file, (known or {}).get(name, {}))
    name = path.removeprefix("/vsicurl/")
    if name.startswith(("http://", "https://")):
        return {"path": path} | _of_url(name)
    for prefix, scheme in _STORES.items():
        if path.startswith((prefix, scheme)):
            return {"path": path} | object_tag(path.replace(prefix, scheme, 1))
    return {"path": path}


def stamp_of(path: str) -> str | None:
    """The stamp that `identity` tells of a file; None where it tells none."""
    file = _local_file(path)
    return _stamp(file) if file else None


def _local_file(path: str) -> Path | None:
    """The local file that a name of GDAL is read from, such as the archive of ``/vsizip/{a.zip}/left.tif``."""
    name = path
    while found := _INSIDE.match(name):
        name = name[found.end() :]
    if name == path:
        return Path(path) if os.path.isfile(path) else None
    place = Path(name.replace("{", "").replace("}", ""))
    return next((file for file in (place, *place.parents) if os.path.isfile(file)), None)


def _of_file(file: Path, before: Mapping[str, Any]) -> dict[str, Any]:
    status, stamp = file.stat(), _stamp(file)
    stamp, sha256 = (stamp, before["sha256"]) if before.get("stamp") == stamp else _hashed(file)
    modified = datetime.fromtimestamp(status.st_mtime, UTC).isoformat()
    return {"bytes": status.st_size, "modified": modified, "sha256": sha256, "stamp": stamp}


def _stamp(file: str | Path) -> str:
    """What any change of a file changes, found without reading it."""
    status = os.stat(file)
    return f"{status.st_ino:x}-{status.st_size:x}-{status.st_mtime_ns:x}-{status.st_ctime_ns:x}"


def _hashed(file: str | Path) -> tuple[str, str]:
    """Stamp and SHA-256 of a file; one that is touched meanwhile is looked at again."""
    for _ in range(_TRIES - 1):
        with suppress(ChangedInputError):
            stamp = _stamp(file)
            return stamp, _sha256(file, stamp)
    stamp = _stamp(file)
    return stamp, _sha256(file, stamp)


@lru_cache(maxsize=1024)
def _sha256(file: str | Path, stamp: str) -> str:
    """Of a file with this stamp; a worker asks for it again with every tile."""
    with open(file, "rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    if _stamp(file) != stamp:
        raise ChangedInputError(f"{file} is being written: run the command again when it is whole")
    return digest


def checksum_of(file: Path) -> dict[str, int]:
    """Bytes and CRC-32 of a local file."""
    size = crc32 = 0
    with file.open("rb") as stream:
        while block := stream.read(1 << 20):
            size, crc32 = size + len(block), zlib.crc32(block, crc32)
    return {"bytes": size, "crc32": crc32}


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


def is_changed(path: str, told: Mapping[str, Any]) -> bool:
    """Whether a file is no longer what `identity` told of it; where a server does not answer, it is not."""
    if "sha256" in told:
        file = _local_file(path)
        try:
            return file is None or (_stamp(file) != told.get("stamp") and _hashed(file)[1] != told["sha256"])
        except FileNotFoundError:
            return True
    now = identity(path)
    return any(key in told and now.get(key, told[key]) != told[key] for key in ("etag", "bytes"))


def check_unchanged(files: Mapping[str, Mapping[str, Any]]) -> None:
    """Hold that the inputs of a run, by name, still are what `identity` told of them, after something was read of them.

    Costs a look at each local file, which is hashed only where its stamp differs, and a request for each remote one.

    Raises
    ------
    ChangedInputError
        With the first that is not.
    """
    for name, told in files.items():
        if is_changed(name, told):
            raise ChangedInputError(
                f"{name} was replaced or changed while the run worked on it: put it back, and the same command goes on "
                "from the tiles that are done, or start afresh with --overwrite"
            )


def check_not_replaced(
    inputs: Iterable[str | Path | None], outputs: Iterable[str | Path], folders: Iterable[str | Path] = ()
) -> None:
    """Hold that no input is a file that is to be written, by whatever name or link, or inside a folder of outputs.

    Parameters
    ----------
    inputs
        Files; names that are none of this machine's, and None, are passed over.
    outputs
        Files that are written or deleted.
    folders
        Whose files are written and deleted.

    Raises
    ------
    SatIntervalsError
        With the first input that would be lost.
    """
    outputs, parents = list(outputs), [Path(folder).resolve() for folder in folders]
    for name in inputs:
        file = name if name is None or os.path.exists(name) else _local_file(os.fspath(name))
        if file is None:
            continue
        place = Path(file).resolve()
        for output in outputs:
            is_same = os.path.exists(output) and os.path.samefile(file, output)
            if is_same or place == Path(output).resolve():
                raise SatIntervalsError(f"{name} is an input, and {output} would be written: choose another output")
        for folder in parents:
            if folder in place.parents:
                raise SatIntervalsError(
                    f"{name} is an input inside {folder}, whose files are written and deleted: choose another output"
                )
