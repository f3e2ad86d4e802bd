"""Parts of the final files: rows of compressed blocks, and what overviews are made of.

The worker that makes a part writes its contents and then its record, with sizes and checksums. A part is done if its
record is intact and its contents have these sizes. The names of parts have a digest of all that decides their bytes,
such as the median and the versions of the codecs: parts made with other settings do not belong to the run.
"""

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sat_intervals.errors import RunError
from sat_intervals.store.folder import Folder, folder_at
from sat_intervals.store.manifest import MANIFEST, digest, sealed, unsealed
from sat_intervals.store.removal import PARTS, final_name, is_part
from sat_intervals.store.tiles import DamagedTilesError, Store

PartKey = tuple[int, int]
"""Level of a file, 0 for its pixels, and row of blocks from the top."""

# Digits of a name that are the same for all runs of a folder.
_OWNER_DIGITS = 8


@dataclass(frozen=True)
class Parts:
    """The parts of a run in the folder of its tiles.

    Attributes
    ----------
    folder
        Folder of the tiles.
    owner
        Folder of the run if ``folder`` is in a store that runs share, otherwise empty: no run uses another's parts.
    made_by
        Digest of all that decides their bytes.
    """

    folder: Folder
    owner: str
    made_by: str

    @property
    def _owner(self) -> str:
        return digest({"owner": self.owner})[:_OWNER_DIGITS]

    @property
    def _run(self) -> str:
        return self._owner + self.made_by[_OWNER_DIGITS:]

    def _name(self, key: PartKey) -> str:
        return f"{self._run}_{key[0]}_{key[1]}"

    def done(self) -> dict[PartKey, dict[str, Any]]:
        """Return the records of the parts that are done."""
        texts, sizes = self.folder.read_all(PARTS), self.folder.inside(PARTS).sizes()
        found = {}
        for name, text in texts.items():
            run, *key = name.split("_")
            record = unsealed(text, name) if run == self._run else None
            if record and all(sizes.get(f"{name}_{kind}") == size for kind, (size, _) in record["files"].items()):
                level, row = map(int, key)
                found[level, row] = record
        return found

    @property
    def _current(self) -> str:
        """Return the name of the file that says which parts are being made: there may be some of other settings."""
        return f"{PARTS}/{self._owner}_current"

    def begin(self) -> None:
        """Note that the parts of this run are being made, for `strips_done`."""
        self.folder.write(self._current, self._run)
        if self.folder.read(MANIFEST) is None:  # another run removed the tiles meanwhile
            self.folder.delete(self._current)

    def strips_done(self) -> int:
        """Return the number of finished strips of the owner's run that began last, whatever the settings."""
        run = self.folder.read(self._current)
        names = self.folder.inside(PARTS).sizes()
        return sum(name.startswith(f"{run}_0_") and name.endswith(".json") for name in names)

    def record(self, key: PartKey) -> dict[str, Any] | None:
        """Return the record of a part; None if it is missing or damaged."""
        name = self._name(key)
        return unsealed(self.folder.read(f"{PARTS}/{name}.json"), name)

    def write(self, key: PartKey, kind: str, content: bytes) -> list[int]:
        """Write a content of a part; return its size and CRC-32."""
        self.folder.write_bytes(f"{PARTS}/{self._name(key)}_{kind}", content)
        return _checksum(content)

    def write_record(self, key: PartKey, record: Mapping[str, Any]) -> None:
        """Write the record of a part, with the checksums of its contents in ``files``; the part is then done."""
        name = self._name(key)
        self.folder.write(f"{PARTS}/{name}.json", sealed(record, name))
        if self.folder.read(MANIFEST) is None:  # another run removed the tiles meanwhile
            names = (f"{PARTS}/{name}{end}" for end in (".json", *(f"_{kind}" for kind in record["files"])))
            self.folder.delete_all([*names], [PARTS])
            self.folder.delete_if_empty()

    def read(self, key: PartKey, kind: str, file: Sequence[int]) -> bytes | None:
        """Read a content with this size and checksum; None if it is missing or damaged: the part is no longer done.

        Raises
        ------
        RunError
            It cannot be read.
        """
        name = self._name(key)
        try:
            content = self.folder.read_bytes(f"{PARTS}/{name}_{kind}")
        except OSError as error:
            raise RunError(
                f"the part {name}_{kind} in {self.folder} cannot be read: {error.strerror or error}; rerun the same "
                "command: it resumes"
            ) from error
        if content is None or _checksum(content) != list(file):
            self.folder.delete(f"{PARTS}/{name}.json")
            return None
        return content

    def label(self, key: PartKey, kind: str = "") -> str:
        """Return how messages name a part, or one of its contents."""
        return "_".join([*map(str, key), *filter(None, [kind])])

    def damaged(self, labels: Iterable[str]) -> DamagedTilesError:
        """Return the error for parts that must be made again."""
        return DamagedTilesError(
            f"parts {', '.join(labels)} in {self.folder} are damaged or missing: rerun the same command: it makes them "
            "again"
        )

    def drop(self) -> None:
        """Delete the parts of all runs of the owner, such as those of earlier settings; call it after publishing."""
        names = (f"{PARTS}/{name}" for name in self.folder.inside(PARTS).sizes())
        owned = f"{PARTS}/{self._owner}"
        self.folder.delete_all(
            [name for name in names if is_part(name) and final_name(name).startswith(owned)], [PARTS]
        )


def parts_in(store: Store, made_by: str = "") -> Parts:
    """Return the parts of a run with these tiles."""
    is_shared = store.folder != folder_at(store.home)
    return Parts(store.folder, str(store.home.absolute()) if is_shared else "", made_by)


def _checksum(content: bytes) -> list[int]:
    """Return size in bytes and CRC-32 of a content; that of a file is combined from those of its parts."""
    return [len(content), zlib.crc32(content)]
