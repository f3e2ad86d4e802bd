"""Identify input files, list those that a raster is read from, and keep outputs from replacing them."""

import hashlib
import os
import re
import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from html import unescape
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

from rasterio.io import DatasetReader

from sat_intervals.errors import ChangedInputError, SatIntervalsError
from sat_intervals.raster import gdal
from sat_intervals.store.remote import RemotePath, object_tag, path_of

_INSIDE = re.compile(r"/vsi\w+/\{?")  # GDAL's prefix to read inside an archive
_NO_PATH = re.compile(r"/vsi|\w+:")  # names that are no paths: GDAL's file systems and subdatasets, and URLs
_TIMEOUT = 30  # seconds until a server must answer
# What cannot change pixels at full resolution, or says of them what `describe` says, too.
_BESIDE = ".ovr", ".aux.xml"


def identity(path: str, known: Mapping[str, Mapping[str, Any]] | None = None) -> dict[str, Any]:
    """Return what identifies a file; ``known`` are earlier results by path, which need no hash for the same time.

    For a local file, or its archive: path, size in bytes, modification time and SHA-256. For HTTP and object stores:
    size in bytes and ETag or modification time. For other files, and servers that do not answer: the path alone.
    """
    if file := local_file(path):
        if file == Path(path):
            file = file.resolve()
            path = str(file)
        return {"path": path} | _of_file(file, (known or {}).get(path, {}))
    name = path.removeprefix("/vsicurl/")
    if name.startswith(("http://", "https://")):
        return {"path": path} | _of_url(name)
    if isinstance(there := path_of(path), RemotePath):
        return {"path": path} | object_tag(str(there))
    if not _NO_PATH.match(path):
        raise ChangedInputError(f"{path} cannot be read: it is missing, a folder, or a link to nothing: restore it")
    return {"path": path}


def identities(record: Any) -> dict[str, dict[str, Any]]:
    """Return the identities in a record, at any depth, by path."""
    parts = record.values() if isinstance(record, dict) else record if isinstance(record, list) else ()
    found = {path: one for part in parts for path, one in identities(part).items()}
    return found | ({record["path"]: record} if isinstance(record, dict) and "path" in record else {})


def relative_in(folder: Path, record: Any) -> Any:
    """Return a record of identities; paths inside a folder become relative, ``./left.tif``: the folder may be moved."""
    inside = os.path.join(_resolved(folder), "")
    return _with_paths(record, lambda path: f"./{path.removeprefix(inside)}" if path.startswith(inside) else path)


def absolute_in(folder: Path, record: Any) -> Any:
    """Return a record of `relative_in` for the place where its folder is now."""
    inside = os.path.join(_resolved(folder), "")
    return _with_paths(record, lambda path: inside + path[2:] if path.startswith("./") else path)


def _resolved(name: str | Path) -> str:
    """Return the path of a file or folder without links, or its URL."""
    return str(path_of(name).resolve())


def _with_paths(record: Any, changed: Callable[[str], str]) -> Any:
    if isinstance(record, dict):
        return {key: changed(one) if key == "path" else _with_paths(one, changed) for key, one in record.items()}
    return [_with_paths(one, changed) for one in record] if isinstance(record, list) else record


def local_file(path: str) -> Path | None:
    """Return the local file behind a GDAL name, such as the archive in ``/vsizip/a.zip/left.tif``; None if remote."""
    is_inside = _INSIDE.match(path)
    place = Path(path[is_inside.end() :].replace("}", "", 1) if is_inside else path)
    places = (place, *place.parents) if is_inside else (place,)
    return next((file for file in places if os.path.isfile(file)), None)


def in_zip(name: str) -> zipfile.Path | None:
    """Return a file in a local zip archive, by its GDAL name; None if it is none."""
    archive = local_file(name) if name.startswith("/vsizip/") else None
    if archive is None or not zipfile.is_zipfile(archive):
        return None
    return zipfile.Path(archive, name.partition(str(archive))[2].strip("}/"))


def _of_file(file: Path, before: Mapping[str, Any]) -> dict[str, Any]:
    status = file.stat()
    seconds, nanoseconds = divmod(status.st_mtime_ns, 10**9)
    time = datetime.fromtimestamp(seconds, UTC).replace(tzinfo=None).isoformat()
    there = {"bytes": status.st_size, "modified": f"{time}.{nanoseconds:09}+00:00"}
    if "sha256" in before and there.items() <= before.items():
        return there | {"sha256": before["sha256"]}
    with file.open("rb") as stream:
        return there | {"sha256": hashlib.file_digest(stream, "sha256").hexdigest()}


def _of_url(url: str) -> dict[str, Any]:
    """Return size and ETag of a URL; requests one byte, since some servers refuse HEAD."""
    try:
        with urlopen(Request(url, headers={"Range": "bytes=0-0"}), timeout=_TIMEOUT) as answer:
            headers = answer.headers
    except (OSError, HTTPException):
        return {}
    size = headers.get("Content-Range", "").rpartition("/")[2] or headers.get("Content-Length", "")
    tag = headers.get("ETag") or headers.get("Last-Modified")
    return {"bytes": int(size) if size.isdigit() else None, "etag": tag}


def files_of(path: str) -> list[str]:
    """Return a raster and all other files that GDAL reads its pixels from: sources of virtual rasters, and masks."""
    try:
        with gdal.reading(path) as dataset:
            listed = [file for file in dataset.files if not _is_same(file, path)] + _sources(path, dataset)
    except gdal.GDAL_ERRORS as error:  # it could be opened before
        raise ChangedInputError(f"{path} cannot be read: {gdal.reason(error)}: restore it") from error
    found = dict.fromkeys([path])
    while listed:
        file = listed.pop(0)
        if file in found or file.lower().endswith(_BESIDE):
            continue
        found[file] = None
        with suppress(*gdal.GDAL_ERRORS), gdal.reading(file) as dataset:  # other files are no rasters
            listed += dataset.files + _sources(file, dataset)
    return [path, *sorted(found.keys() - {path})]


def _sources(path: str, dataset: DatasetReader) -> list[str]:
    """Return local sources that a virtual raster names and GDAL does not list, such as those of its mask."""
    text = dataset.tags(ns="xml:VRT").get("xml:VRT", "") if dataset.driver == "VRT" else ""
    named = re.findall(r'<SourceFilename(?: relativeToVRT="(\d)")?[^>]*>([^<]+)', text)
    files = [os.path.join(os.path.dirname(path) if relative == "1" else "", unescape(name)) for relative, name in named]
    listed = {os.path.realpath(file) for file in dataset.files}
    return [file for file in files if os.path.isfile(file) and os.path.realpath(file) not in listed]


def _is_same(file: str, name: str) -> bool:
    """Return whether GDAL lists a raster of this name as a file."""
    scheme, is_url, place = name.partition("://")
    is_listed = bool(is_url) and scheme != "vrt" and file.startswith("/vsi") and file.endswith(place)
    return is_listed or Path(file).resolve() == Path(name).resolve()


def check_not_replaced(
    inputs: Iterable[str | Path | None], outputs: Iterable[str | Path], folders: Iterable[str | Path] = ()
) -> None:
    """Raise if an output, or a file in one of the ``folders``, is also an input, or a link to it; None is ignored."""
    written = {_resolved(output): output for output in outputs}
    parents = {_resolved(folder) for folder in folders}
    for name in (one for one in inputs if one is not None):
        is_path = isinstance(path_of(name), RemotePath) or os.path.exists(name)
        file = name if is_path else local_file(os.fspath(name))
        if file is None:
            continue
        if found := written.get(_resolved(file)):
            raise SatIntervalsError(f"{name} is an input, and {found} would be written: choose another output")
        for folder in map(str, path_of(_resolved(file)).parents):
            if folder in parents:
                raise SatIntervalsError(
                    f"{name} is an input inside {folder}, whose files are written and deleted: choose another output"
                )
