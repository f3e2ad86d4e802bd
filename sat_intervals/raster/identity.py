"""Identify input files for manifests and run.json, detect changes, and keep outputs from replacing inputs."""

import hashlib
import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import lru_cache
from http.client import HTTPException
from operator import index
from pathlib import Path
from threading import Event
from typing import Any
from urllib.request import Request, urlopen

from sat_intervals.errors import ChangedInputError, RunError, SatIntervalsError, check_regular, open_regular
from sat_intervals.store.folder import object_tag

# GDAL's prefixes of object stores, and those of fsspec.
_STORES = {"/vsis3/": "s3://", "/vsigs/": "gs://", "/vsiaz/": "az://"}
# GDAL's prefix to read inside a file: an archive, or a part given by offset and size.
_INSIDE = re.compile(r"/vsi\w+/(\d+(_\d+)?,)?")
# Names that are no paths: GDAL's file systems and subdatasets, and URLs.
_NO_PATH = re.compile(r"/vsi|\w+:")
# Stamps of archives when this process read them first.
_ARCHIVES: dict[str, str] = {}
# Seconds until a server must answer.
_TIMEOUT = 30
# Attempts to hash a file that changes meanwhile.
_TRIES = 3


def identity(path: str, known: Mapping[str, Mapping[str, Any]] | None = None) -> dict[str, Any]:
    """Return what identifies a file.

    Parameters
    ----------
    path
        Local file, URL, or any name that GDAL opens.
    known
        Earlier results by path; a file with the same stamp is not hashed again.

    Returns
    -------
    For a local file: path, size in bytes, modification time, SHA-256, and a stamp of inode, size and times in
    nanoseconds (users cannot reset the inode's change time). For a file inside an archive: those of the archive. For
    HTTP and object stores: size in bytes and ETag, or modification time without one. For any other file, and for
    servers that only GDAL has credentials for: the path alone.

    Raises
    ------
    ChangedInputError
        The file is missing or being written, or is an archive that was replaced since this process read it first.
    SatIntervalsError
        The path is a pipe or a device, a server does not say which file it sends, or GDAL hides the URL in a query.
    """
    check_regular(path)
    if file := _current_file(path):
        if file == Path(path):
            file = file.resolve()  # once: a link may lead elsewhere later
            path = str(file)
        return {"path": path} | _of_file(file, (known or {}).get(path, {}))
    if path.startswith("/vsicurl?"):
        raise SatIntervalsError(f"{path}: a change of this file would not be noticed: give its URL alone")
    name = path.removeprefix("/vsicurl/")
    if name.startswith(("http://", "https://")):
        return {"path": path} | _of_url(name)
    for prefix, scheme in _STORES.items():
        if path.startswith((prefix, scheme)):
            return {"path": path} | object_tag(path.replace(prefix, scheme, 1))
    if not _NO_PATH.match(path):  # GDAL lists links to nothing, too
        raise ChangedInputError(f"{path} cannot be read: it is missing, or a link to nothing: restore or remove it")
    return {"path": path}


def stamp_of(path: str) -> str | None:
    """Return the stamp of a local file as `identity` gives it, size and ETag of a remote one.

    None if a server gives none or does not answer, "missing" for a local file that does not exist.
    """
    if file := _current_file(path):
        return local_stamp(file)
    if not _NO_PATH.match(path):
        return "missing"
    now = identity(path)
    if now.get("etag"):
        return f"{now['bytes']}-{now['etag']}"
    return None if "://" in path or path.startswith("/vsi") else "missing"


def local_file(path: str) -> Path | None:
    """Return the local file behind a GDAL name, such as the archive in ``/vsizip/{a.zip}/left.tif``; None if remote."""
    name = path
    while found := _INSIDE.match(name):
        name = name[found.end() :]
    if name == path:
        return Path(path) if os.path.isfile(path) else None
    place = Path(name.replace("{", "").replace("}", ""))
    return next((file for file in (place, *place.parents) if os.path.isfile(file)), None)


def _current_file(path: str) -> Path | None:
    """Return the `local_file`; raise if it is an archive that was replaced: GDAL may keep its old index."""
    file = local_file(path)
    if file is not None and file != Path(path):
        stamp = local_stamp(file)
        if _ARCHIVES.setdefault(str(file), stamp) != stamp:
            raise ChangedInputError(
                f"{file} was replaced since this process read it first, and GDAL may read it at old places: extract it "
                "or start new processes"
            )
    return file


def _of_file(file: Path, before: Mapping[str, Any]) -> dict[str, Any]:
    status, stamp = file.stat(), local_stamp(file)
    stamp, sha256 = (stamp, before["sha256"]) if before.get("stamp") == stamp else _hashed(file)
    modified = datetime.fromtimestamp(status.st_mtime, UTC).isoformat()
    return {"bytes": status.st_size, "modified": modified, "sha256": sha256, "stamp": stamp}


def local_stamp(file: str | Path) -> str:
    """Return inode, size and times of a file: any change of the file changes them."""
    status = os.stat(file)
    return f"{status.st_ino:x}-{status.st_size:x}-{status.st_mtime_ns:x}-{status.st_ctime_ns:x}"


def _hashed(file: str | Path) -> tuple[str, str]:
    """Return stamp and SHA-256 of a file; try again if it changes meanwhile."""
    for _ in range(_TRIES - 1):
        with suppress(ChangedInputError):
            stamp = local_stamp(file)
            return stamp, _sha256(file, stamp)
    stamp = local_stamp(file)
    return stamp, _sha256(file, stamp)


@lru_cache(maxsize=1024)
def _sha256(file: str | Path, stamp: str) -> str:
    """Return the SHA-256 of a file; cached by stamp, as workers need it for every tile."""
    with open_regular(file) as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    if local_stamp(file) != stamp:
        raise ChangedInputError(f"{file} is being written: rerun the command when it is complete")
    return digest


def checksum_of(file: Path) -> dict[str, int]:
    """Return size in bytes and CRC-32 of a local file."""
    size = crc32 = 0
    with open_regular(file) as stream:
        while block := stream.read(1 << 20):
            size, crc32 = size + len(block), zlib.crc32(block, crc32)
    return {"bytes": size, "crc32": crc32}


def known_checksum(known: Mapping[str, Any]) -> dict[str, int]:
    """Return the `checksum_of` a file from a report; raises LookupError or TypeError for what is none."""
    return {key: index(known[key]) for key in ("bytes", "crc32")}


def checksum_of_text(text: str) -> dict[str, int]:
    """Return the `checksum_of` a file with this text."""
    content = text.encode()
    return {"bytes": len(content), "crc32": zlib.crc32(content)}


def _of_url(url: str) -> dict[str, Any]:
    """Return size and ETag of a URL; requests one byte, since some servers refuse HEAD.

    Raises
    ------
    SatIntervalsError
        The server says neither ETag nor time.
    """
    try:
        with urlopen(Request(url, headers={"Range": "bytes=0-0"}), timeout=_TIMEOUT) as answer:
            headers = answer.headers
    except (OSError, HTTPException):
        return {}
    size = headers.get("Content-Range", "").rpartition("/")[2] or headers.get("Content-Length", "")
    tag = headers.get("ETag") or headers.get("Last-Modified")
    if not tag:
        raise SatIntervalsError(
            f"{url}: its server sends neither ETag nor Last-Modified, so a change during the run would not be noticed: "
            "download it"
        )
    return {"bytes": int(size) if size.isdigit() else None, "etag": tag}


def is_changed(path: str, known: Mapping[str, Any]) -> bool:
    """Return whether a file differs from its `identity` of before; False if a server does not answer."""
    if "sha256" in known:
        file = _current_file(path)
        try:
            return file is None or (local_stamp(file) != known.get("stamp") and _hashed(file)[1] != known["sha256"])
        except FileNotFoundError:
            return True
    now = identity(path)
    return any(key in known and now.get(key, known[key]) != known[key] for key in ("etag", "bytes"))


def check_unchanged(files: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise if an input of a run, by name, differs from its `identity` of before; call it after reading.

    A local file is hashed only if its stamp differs; a remote one costs a request.

    Raises
    ------
    ChangedInputError
        Names the first changed file.
    """
    for name, known in files.items():
        if is_changed(name, known):
            raise ChangedInputError(
                f"{name} was replaced or changed during the run: restore it and rerun the same command: it resumes; or "
                "start again with --overwrite"
            )


@contextmanager
def compared(files: Mapping[str, Mapping[str, Any]]) -> Iterator[Callable[[], str | None]]:
    """Compare the content of inputs of a run with their `identity` during the block, in a thread.

    It reads all local files, since a memory map can change a file but not its times. The yielded function waits for the
    end and returns the name of the first file that differs, or None. It raises RunError if a file cannot be read.
    """
    is_over = Event()
    with ThreadPoolExecutor(1) as thread:
        found = thread.submit(_differing, files, is_over)
        try:
            yield found.result
        finally:
            is_over.set()


def _differing(files: Mapping[str, Mapping[str, Any]], is_over: Event) -> str | None:
    for name, known in files.items():
        if "sha256" not in known or (file := local_file(name)) is None:
            continue
        digest = hashlib.sha256()
        try:
            with open_regular(file) as stream:
                while not is_over.is_set() and (block := stream.read(1 << 20)):
                    digest.update(block)
        except OSError as error:
            raise RunError(f"{name} cannot be read: {error.strerror}: rerun the same command: it resumes") from error
        if digest.hexdigest() != known["sha256"]:
            _sha256.cache_clear()
            return name
    return None


def check_not_replaced(
    inputs: Iterable[str | Path | None], outputs: Iterable[str | Path], folders: Iterable[str | Path] = ()
) -> None:
    """Raise if an output would replace an input, or is a pipe.

    Links and other names of an input are recognised, and inputs inside folders of outputs.

    Parameters
    ----------
    inputs
        Files; remote names and None are ignored.
    outputs
        Files that are written or deleted.
    folders
        Folders whose files are written and deleted.

    Raises
    ------
    SatIntervalsError
        Names the first output that is a pipe, socket or device, or the first input that would be lost.
    """
    written: dict[object, str | Path] = {}  # by what identifies them: a batch may have thousands
    for output in outputs:
        check_regular(output, "move it away or choose another output")
        written |= dict.fromkeys(identifiers(output), output)
    parents = {os.path.realpath(folder) for folder in folders}
    for name in inputs:
        file = name if name is None or os.path.exists(name) else local_file(os.fspath(name))
        if file is None:
            continue
        for found in identifiers(file) & written.keys():
            raise SatIntervalsError(f"{name} is an input, and {written[found]} would be written: choose another output")
        for folder in map(str, Path(os.path.realpath(file)).parents):
            if folder in parents:
                raise SatIntervalsError(
                    f"{name} is an input inside {folder}, whose files are written and deleted: choose another output"
                )


def identifiers(file: str | Path) -> set[object]:
    """Return the path of a file without links and, if it exists, what it has in common with its hard links."""
    found: set[object] = {os.path.realpath(file)}
    with suppress(OSError):
        status = os.stat(file)
        found.add((status.st_dev, status.st_ino))
    return found
