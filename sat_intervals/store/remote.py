"""Paths in a bucket, by way of fsspec.

Addresses and credentials of a server come from its environment variables and files (``AWS_ENDPOINT_URL``, ``~/.aws``)
or from fsspec's.
"""

import errno
import hashlib
import io
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PosixPath
from typing import Any

import fsspec

# Schemes of stores that GDAL reads, too, and its prefixes.
STORES = {"s3://": "/vsis3/", "gs://": "/vsigs/", "az://": "/vsiaz/"}
# Read at once from a server: the members of a file that a strip reads follow each other.
_BLOCK = 4 << 20
# Errors that are none of the server: no such file, or file system, or its package is missing.
_CODES = {FileNotFoundError: errno.ENOENT, ValueError: errno.ENOTSUP, ImportError: errno.ENOTSUP}
# Parts of 50 MB that s3fs uploads at once, from memory.
_PARTS = {"max_concurrency": 2}


@contextmanager
def reached(place: str) -> Iterator[Any]:
    """Yield the file system of a path or URL, which fsspec keeps; errors of its libraries become OSError."""
    try:
        yield fsspec.url_to_fs(place, use_listings_cache=False)[0]
    except Exception as error:
        number = next((code for kind, code in _CODES.items() if isinstance(error, kind)), errno.EIO)
        why = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise OSError(number, why, place) from error


class _Stream(io.RawIOBase):
    """An open file of a bucket, whose reads go through `reached`, too."""

    def __init__(self, place: str) -> None:
        self._place = place
        with reached(place) as system:
            self._file = system.open(place, "rb", block_size=_BLOCK, cache_type="readahead")

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return int(self._file.seek(offset, whence))

    def readinto(self, buffer: Any) -> int:
        with reached(self._place):
            return int(self._file.readinto(buffer))


def opened_at(place: str) -> Any:
    """Open a file of a bucket for reading any part of it."""
    return _Stream(place)


class RemotePath(PosixPath):
    """A path in a bucket, with what is asked of paths of results; as text it is the URL."""

    def __str__(self) -> str:
        return super().__str__().replace(":/", "://", 1)

    @property
    def gdal_name(self) -> str:
        """Return the name by which GDAL and programs that use it open the file."""
        scheme, _, rest = str(self).partition("://")
        return STORES[f"{scheme}://"] + rest

    def absolute(self) -> "RemotePath":
        """Return the path."""
        return self

    def resolve(self, *_: Any, **__: Any) -> "RemotePath":
        """Return the path."""
        return self

    def stat(self, **_: Any) -> os.stat_result:
        """Return kind, size and the second of the last change of a file, 0 where its store does not say."""
        changed = 0
        with reached(str(self)) as system:
            found = system.info(str(self))
            if found["type"] == "file":
                with suppress(KeyError, NotImplementedError):
                    changed = int(system.modified(str(self)).timestamp())
        kind = stat.S_IFREG if found["type"] == "file" else stat.S_IFDIR
        return os.stat_result((kind, 0, 0, 0, 0, 0, found["size"] or 0, 0, changed, 0))

    def _kind(self) -> str:
        with suppress(FileNotFoundError), reached(str(self)) as system:
            return str(system.info(str(self))["type"])
        return ""

    def exists(self, **_: Any) -> bool:
        """Return whether there is a file, or a folder with one."""
        return bool(self._kind())

    def is_file(self) -> bool:
        """Return whether it is a file."""
        return self._kind() == "file"

    def is_dir(self) -> bool:
        """Return whether files are in it."""
        return self._kind() == "directory"

    def open(self, mode: str = "rb", *_: Any, **__: Any) -> Any:
        """Open it for reading bytes."""
        if mode != "rb":
            raise OSError(errno.ENOTSUP, f"is in a bucket, not opened as {mode!r}", str(self))
        return opened_at(str(self))

    def read_bytes(self) -> bytes:
        """Read it whole."""
        with reached(str(self)) as system:
            return bytes(system.cat_file(str(self)))

    def read_text(self, *how: Any, **named: Any) -> str:
        """Read it whole, by default as UTF-8."""
        return self.read_bytes().decode(*how, **named)

    def mkdir(self, *_: Any, **__: Any) -> None:
        """Do nothing: folders are there with their files."""

    def unlink(self, *_: Any, **__: Any) -> None:
        """Delete it, if it exists."""
        with suppress(FileNotFoundError), reached(str(self)) as system:
            system.rm_file(str(self))

    def upload(self, file: Path) -> None:
        """Make it a copy of a local file; it has its name once it is whole."""
        with reached(str(self)) as system:
            system.put_file(str(file), str(self), **(_PARTS if str(self).startswith("s3://") else {}))


def path_of(name: str | os.PathLike[str]) -> Path:
    """Return a path of this machine, or in a bucket: ``s3://bucket/run``, or ``/vsis3/bucket/run`` as GDAL says."""
    text = os.fspath(name)
    for scheme, prefix in STORES.items():
        if text.startswith((scheme, prefix)):
            return RemotePath(text.replace(prefix, scheme, 1))
    return Path(text)


def is_there(path: Path) -> bool:
    """Return whether a path exists; a link to nothing does, too."""
    return path.exists() if isinstance(path, RemotePath) else os.path.lexists(path)


def disk_of(folder: Path) -> Path:
    """Return where lock and unfinished files of a folder are: in it; of a bucket, among temporary files (`TMPDIR`)."""
    if not isinstance(folder, RemotePath):
        return folder
    name = hashlib.sha256(str(folder).encode()).hexdigest()[:16]
    return Path(tempfile.gettempdir()) / f"sat-intervals-{os.getuid()}" / name


def object_tag(url: str) -> dict[str, Any]:
    """Return size in bytes and ETag of an object; empty if fsspec cannot reach it."""
    try:
        with reached(url) as system:
            content = system.info(url)
    except OSError:
        return {}
    tag = content.get("ETag") or content.get("etag") or content.get("LastModified")
    return {"bytes": content.get("size"), "etag": None if tag is None else str(tag)}
