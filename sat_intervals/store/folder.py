"""Places where a run leaves small texts and arrays: folders of this machine, prefixes of any fsspec file system."""

from collections.abc import Collection
from pathlib import Path
from typing import Protocol

from sat_intervals.store.local import LocalFolder
from sat_intervals.store.remote import RemoteFolder, object_tag

__all__ = ["Folder", "LocalFolder", "RemoteFolder", "folder_at", "object_tag"]


class Folder(Protocol):
    """What a store needs of the place where it lies; names are relative to it, with ``/`` between their parts.

    Bytes that are no UTF-8 are read as U+FFFD, so that a damaged text fails its checksum and nothing else.
    """

    def read(self, name: str) -> str | None:
        """Text of a file, None where there is none."""

    def read_bytes(self, name: str) -> bytes | None:
        """Content of a file, None where there is none."""

    def read_all(self, folder: str) -> dict[str, str]:
        """Texts of the JSON files in a folder, by name without ending."""

    def sizes(self) -> dict[str, int]:
        """Bytes of all files, and of links to folders, in it and in the folders below it, by name."""

    def write(self, name: str, text: str) -> None:
        """Write a file that is either there as a whole or not at all."""

    def create(self, name: str, text: str) -> bool:
        """Write a file as a whole unless it is there; whether it was written."""

    def delete(self, name: str) -> None:
        """Delete a file, if it is there."""

    def delete_all(self, names: Collection[str], folders: Collection[str] = ()) -> None:
        """Delete many files, and folders where no file is in them then."""

    def delete_if_empty(self) -> None:
        """Delete this folder, where nothing is in it."""

    def inside(self, folder: str) -> "Folder":
        """A folder in it."""

    def make(self, folder: str) -> None:
        """Make a folder, where folders must be made."""

    def place(self, name: str) -> Path | str:
        """What zarr finds a name by."""

    def free_bytes(self) -> int | None:
        """Room that is left, None where nobody can tell."""


def folder_at(place: str | Path) -> Folder:
    """The folder of a path or a URL."""
    protocol, _, path = str(place).rpartition("://")
    if protocol in ("", "file", "local"):
        return LocalFolder(Path(path).absolute())
    return RemoteFolder(str(place).rstrip("/"))
