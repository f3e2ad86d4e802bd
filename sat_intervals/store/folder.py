"""Folders of a store: local ones, and prefixes of fsspec file systems."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Protocol

from sat_intervals.store.local import MADE, LocalFolder, mark
from sat_intervals.store.remote import RemoteFolder, object_tag

__all__ = ["MADE", "Folder", "LocalFolder", "RemoteFolder", "folder_at", "mark", "object_tag"]


class Folder(Protocol):
    """Interface of a store's folder; names are relative to it, with ``/`` between their parts.

    Invalid UTF-8 is read as U+FFFD, so that a damaged text only fails its checksum.
    """

    def read(self, name: str) -> str | None:
        """Read the text of a file, None if it does not exist."""

    def read_bytes(self, name: str) -> bytes | None:
        """Read the content of a file, None if it does not exist."""

    def read_parts(self, parts: Sequence[tuple[str, int, int]]) -> list[bytes | None]:
        """Read the bytes ``[start, stop)`` of some files, fewer if one is shorter, None if it does not exist."""

    def read_all(self, folder: str) -> dict[str, str]:
        """Read the texts of all JSON files in a folder, by name without suffix."""

    def sizes(self) -> dict[str, int]:
        """Return the sizes in bytes of all files and links to folders, recursively, by name."""

    def write(self, name: str, text: str) -> None:
        """Write a file atomically."""

    def write_bytes(self, name: str, content: bytes) -> None:
        """Write a file that exists only when it is complete."""

    def create(self, name: str, text: str) -> bool:
        """Write a file atomically unless it exists; return whether it was written."""

    def delete(self, name: str) -> None:
        """Delete a file if it exists."""

    def delete_all(self, names: Collection[str], folders: Collection[str] = ()) -> None:
        """Delete files, then those of the folders that contain no file."""

    def delete_if_empty(self) -> None:
        """Delete this folder if it is empty."""

    def inside(self, folder: str) -> "Folder":
        """Return a subfolder."""

    def of_run(self, run: str) -> "Folder":
        """Return the folder, in which nothing is written or deleted once MADE has the mark of another run.

        Writing and deleting then raise OSError (ESTALE).
        """

    def make(self, folder: str) -> None:
        """Create a folder if the file system needs that."""

    def place(self, name: str) -> Path | str:
        """Return the path or URL of a name."""

    def free_bytes(self) -> int | None:
        """Return the free space in bytes, None if unknown."""


def folder_at(place: str | Path) -> Folder:
    """Return the folder at a path or URL."""
    protocol, _, path = str(place).rpartition("://")
    if protocol in ("", "file", "local"):
        return LocalFolder(Path(path).absolute())
    return RemoteFolder(str(place).rstrip("/"))
