"""Places where a run leaves small texts and arrays: folders of this machine, prefixes of any fsspec file system."""

from pathlib import Path
from typing import Protocol

from sat_intervals.store.local import LocalFolder
from sat_intervals.store.remote import RemoteFolder, object_tag

__all__ = ["Folder", "LocalFolder", "RemoteFolder", "folder_at", "object_tag"]


class Folder(Protocol):
    """What a store needs of the place where it lies; names are relative to it, with ``/`` between their parts."""

    def read(self, name: str) -> str | None:
        """Text of a file, None where there is none."""

    def read_all(self, folder: str) -> dict[str, str]:
        """Texts of the JSON files in a folder, by name without ending."""

    def names(self, folder: str) -> set[str]:
        """Names, without ending, of the JSON files in a folder."""

    def files(self, folder: str) -> set[str]:
        """Names of all files in a folder and in those below it, relative to it."""

    def write(self, name: str, text: str) -> None:
        """Write a file that is either there as a whole or not at all."""

    def create(self, name: str, text: str) -> bool:
        """Write a file as a whole unless it is there; whether it was written."""

    def delete(self, name: str) -> None:
        """Delete a file, or a folder with all that is in it, if it is there."""

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
