"""A prefix of an fsspec file system, such as an S3 bucket. Only this module imports fsspec.

Objects are written atomically. Addresses and credentials come from the service's own environment variables and files
(``AWS_ENDPOINT_URL``, ``~/.aws``) or from fsspec's.
"""

import errno
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import fsspec


@dataclass(frozen=True)
class RemoteFolder:
    """See `Folder`."""

    url: str

    def __str__(self) -> str:
        """Return the URL."""
        return self.url

    @contextmanager
    def _reached(self, name: str) -> Iterator[tuple[Any, str]]:
        """Yield the file system and the path of a name; errors of any library become OSError."""
        try:
            system, root = fsspec.url_to_fs(self.url)  # cached by fsspec per thread and service
            yield system, f"{root}/{name}"
        except (FileNotFoundError, FileExistsError):
            raise
        except Exception as error:
            raise OSError(errno.EIO, " ".join(str(error).split()) or type(error).__name__, self.url) from error

    def read(self, name: str) -> str | None:
        """See `Folder`."""
        content = self.read_bytes(name)
        return None if content is None else content.decode(errors="replace")

    def read_bytes(self, name: str) -> bytes | None:
        """See `Folder`."""
        try:
            with self._reached(name) as (system, path):
                return bytes(system.cat_file(path))
        except FileNotFoundError:
            return None

    def read_parts(self, parts: Sequence[tuple[str, int, int]]) -> list[bytes | None]:
        """See `Folder`; all at once."""
        with self._reached("") as (system, root):
            paths = [root + name for name, _, _ in parts]
            starts, stops = [start for _, start, _ in parts], [stop for *_, stop in parts]
            found = system.cat_ranges(paths, starts, stops, on_error="return")
        contents: list[bytes | None] = []
        for (name, start, stop), read in zip(parts, found, strict=True):
            if isinstance(read, Exception):  # missing, or shorter than `start`, which services refuse: now it is known
                content = self.read_bytes(name)
                contents.append(None if content is None else content[start:stop])
            else:
                contents.append(bytes(read))
        return contents

    def read_all(self, folder: str) -> dict[str, str]:
        """See `Folder`."""
        with suppress(FileNotFoundError), self._reached(folder) as (system, path):
            system.invalidate_cache(path)
            paths = [file for file in system.ls(path, detail=False) if file.endswith(".json")]
            texts = system.cat(paths, on_error="omit") if paths else {}
            return {PurePosixPath(path).stem: text.decode(errors="replace") for path, text in texts.items()}
        return {}

    def sizes(self) -> dict[str, int]:
        """See `Folder`."""
        with suppress(FileNotFoundError), self._reached("") as (system, path):
            root = path.rstrip("/")
            system.invalidate_cache(root)
            found = system.find(root, detail=True)
            return {str(PurePosixPath(file).relative_to(root)): about["size"] for file, about in found.items()}
        return {}

    def write(self, name: str, text: str) -> None:
        """See `Folder`."""
        self.write_bytes(name, text.encode())

    def write_bytes(self, name: str, content: bytes) -> None:
        """See `Folder`."""
        with self._reached(name) as (system, path):
            system.pipe_file(path, content)

    def create(self, name: str, text: str) -> bool:
        """See `Folder`; atomic if the service supports that, as S3 does."""
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
            system.rm(path)

    def delete_all(self, names: Collection[str], folders: Collection[str] = ()) -> None:
        """See `Folder`."""
        with suppress(FileNotFoundError), self._reached("") as (system, path):
            system.invalidate_cache(path.rstrip("/"))
            if names:
                system.rm([path + name for name in names])
        for folder in folders:
            with suppress(FileNotFoundError), self._reached(folder) as (system, path):
                if not system.find(path):  # a bucket has no folders, but other file systems do
                    system.rm(path, recursive=True)

    def delete_if_empty(self) -> None:
        """See `Folder`; a bucket is kept."""
        with suppress(OSError), self._reached("") as (system, path):
            if "/" in path.strip("/"):
                system.rmdir(path.rstrip("/"))

    def inside(self, folder: str) -> "RemoteFolder":
        """See `Folder`."""
        return RemoteFolder(f"{self.url}/{folder}")

    def of_run(self, run: str) -> "RemoteFolder":
        """See `Folder`; nothing can be put in the place of a prefix."""
        return self

    def make(self, folder: str) -> None:
        """See `Folder`."""
        with suppress(FileExistsError), self._reached(folder) as (system, path):
            system.mkdir(path.rstrip("/"), create_parents=False)  # with parents, s3fs would create a bucket

    def place(self, name: str) -> str:
        """See `Folder`."""
        return f"{self.url}/{name}".rstrip("/")

    def free_bytes(self) -> None:
        """See `Folder`."""


def object_tag(url: str) -> dict[str, Any]:
    """Return size in bytes and ETag of an object; empty if fsspec cannot reach it."""
    try:
        system, path = fsspec.url_to_fs(url)
        system.invalidate_cache(path)
        content = system.info(path)
    except Exception:  # of many libraries
        return {}
    tag = content.get("ETag") or content.get("etag") or content.get("LastModified")
    return {"bytes": content.get("size"), "etag": None if tag is None else str(tag)}
