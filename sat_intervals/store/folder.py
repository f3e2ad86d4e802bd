"""A folder of intermediate files, on a disk or as a prefix of an fsspec file system such as an S3 bucket."""

import os
import uuid
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from sat_intervals.store.remote import opened_at, reached


@dataclass(frozen=True)
class Folder:
    """A folder; names are relative to it, with ``/`` between their parts.

    Any failure is an OSError, a missing file a FileNotFoundError.
    """

    place: str

    def __str__(self) -> str:
        """Return the path or URL."""
        return self.place

    @property
    def is_local(self) -> bool:
        """Return whether it is on a disk."""
        return "://" not in self.place

    def _path(self, name: str) -> str:
        return f"{self.place}/{name}"

    def opened(self, name: str) -> IO[bytes]:
        """Open a file for reading any part of it."""
        path = self._path(name)
        return open(path, "rb") if self.is_local else opened_at(path)

    def write(self, name: str, content: bytes | memoryview, *, is_flushed: bool = False) -> None:
        """Write a file that exists only when it is complete; ``is_flushed``: also after a power loss."""
        if not self.is_local:
            with reached(self.place) as system:
                system.pipe_file(self._path(name), bytes(content))
            return
        path = Path(self._path(name))
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary.open("xb") as stream:
                stream.write(content)
                if is_flushed:
                    stream.flush()
                    os.fsync(stream.fileno())
            os.replace(temporary, path)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise OSError(error.errno, error.strerror, str(path)) from error

    def sizes(self, kind: str) -> dict[str, int]:
        """Return the sizes in bytes of the finished files in a subfolder, by name."""
        with suppress(FileNotFoundError), reached(self.place) as system:
            found = system.ls(self._path(kind), detail=True)
            files = {os.path.basename(file["name"]): file["size"] for file in found if file["type"] == "file"}
            return {name: size for name, size in files.items() if not name.startswith(".")}
        return {}

    def delete(self, names: Iterable[str]) -> None:
        """Delete files, if they exist."""
        with reached(self.place) as system:
            for name in names:
                with suppress(FileNotFoundError):
                    system.rm_file(self._path(name))

    def remove(self, kind: str) -> None:
        """Delete a subfolder with all that is in it."""
        with suppress(FileNotFoundError), reached(self.place) as system:
            system.rm(self._path(kind), recursive=True)

    def remove_if_empty(self) -> None:
        """Delete the folder, if it is on a disk and empty."""
        if self.is_local:
            with suppress(OSError):
                os.rmdir(self.place)


def folder_at(place: str | Path) -> Folder:
    """Return the folder at a path or URL."""
    protocol, _, path = str(place).rpartition("://")
    is_local = protocol in ("", "file", "local")
    return Folder(str(Path(path).absolute()) if is_local else str(place).rstrip("/"))
