"""A prefix of a file system that fsspec knows, such as a bucket of S3. The only home of fsspec.

Objects are written whole, and a name is there as soon as its object is. Addresses and credentials of the service come
from its own environment variables and files (``AWS_ENDPOINT_URL``, ``~/.aws``) or fsspec's.
"""

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import fsspec

from sat_intervals.errors import SatIntervalsError
from sat_intervals.folders import lease


@dataclass(frozen=True)
class RemoteFolder:
    """See `Folder`; the lock is a `lease`."""

    url: str

    def __str__(self) -> str:
        """How users call it."""
        return self.url

    @contextmanager
    def _reached(self, name: str) -> Iterator[tuple[Any, str]]:
        """The file system and its path of a name; whatever it raises, of many libraries, is an OSError."""
        try:
            system, root = fsspec.url_to_fs(self.url)  # one a thread and service: fsspec keeps them
            yield system, f"{root}/{name}"
        except (FileNotFoundError, FileExistsError):
            raise
        except Exception as error:
            raise OSError(errno.EIO, " ".join(str(error).split()) or type(error).__name__, self.url) from error

    def read(self, name: str) -> str | None:
        """See `Folder`."""
        try:
            with self._reached(name) as (system, path):
                return str(system.cat_file(path).decode())
        except FileNotFoundError:
            return None

    def read_all(self, folder: str) -> dict[str, str]:
        """See `Folder`."""
        paths = self._files(folder)
        with self._reached(folder) as (system, _):
            texts = system.cat(paths) if paths else {}
        return {PurePosixPath(path).stem: text.decode() for path, text in texts.items()}

    def names(self, folder: str) -> set[str]:
        """See `Folder`."""
        return {PurePosixPath(path).stem for path in self._files(folder)}

    def _files(self, folder: str) -> list[str]:
        with suppress(FileNotFoundError), self._reached(folder) as (system, path):
            system.invalidate_cache(path)
            return [file for file in system.ls(path, detail=False) if file.endswith(".json")]
        return []

    def files(self, folder: str) -> set[str]:
        """See `Folder`."""
        with suppress(FileNotFoundError), self._reached(folder) as (system, path):
            system.invalidate_cache(path)
            return {str(PurePosixPath(file).relative_to(path)) for file in system.find(path)}
        return set()

    def write(self, name: str, text: str) -> None:
        """See `Folder`."""
        with self._reached(name) as (system, path):
            system.pipe_file(path, text.encode())

    def create(self, name: str, text: str) -> bool:
        """Write a file unless it is there, in one step where the service offers that, as S3 does; whether it was."""
        try:
            with self._reached(name) as (system, path):
                system.pipe_file(path, text.encode(), mode="create")
        except FileExistsError:
            return False
        return True

    def delete(self, name: str) -> None:
        """See `Folder`."""
        with suppress(FileNotFoundError), self._reached(name) as (system, path):
            system.invalidate_cache(path)
            system.rm(path, recursive=True)

    def inside(self, folder: str) -> "RemoteFolder":
        """See `Folder`."""
        return RemoteFolder(f"{self.url}/{folder}")

    def make(self, folder: str) -> None:
        """See `Folder`."""
        with suppress(FileExistsError), self._reached(folder) as (system, path):
            system.mkdir(path.rstrip("/"), create_parents=False)  # with parents, s3fs would make a bucket of any name

    def place(self, name: str) -> str:
        """See `Folder`."""
        return f"{self.url}/{name}".rstrip("/")

    def free_bytes(self) -> None:
        """See `Folder`."""

    @contextmanager
    def locked(self, waiting: Callable[[], None] = lambda: None) -> Iterator[Callable[[], None]]:
        """See `Folder`."""
        try:
            self.make("")
            held = lease.taken(self, waiting)
        except OSError as error:
            raise SatIntervalsError(
                f"{self} cannot be used: {error.strerror or error}: check the URL, the credentials, and that the "
                "package of its file system is installed (sat-intervals[remote] for s3://)"
            ) from error
        with held:
            yield held.check

    def is_locked(self) -> bool:
        """See `Folder`."""
        return lease.is_fresh(self)


def object_tag(url: str) -> dict[str, Any]:
    """Size in bytes and ETag of an object; nothing where fsspec does not reach it."""
    try:
        system, path = fsspec.url_to_fs(url)
        content = system.info(path)
    except Exception:  # of many libraries
        return {}
    tag = content.get("ETag") or content.get("etag") or content.get("LastModified")
    return {"bytes": content.get("size"), "etag": None if tag is None else str(tag)}
