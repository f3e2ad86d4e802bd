"""Parts of the final files: rows of compressed blocks, and what overviews are made of.

The worker that makes a part writes its contents and then its record, with sizes and checksums. A part is done if its
record is intact and its contents have these sizes. The names of parts have a digest of all that decides their bytes,
such as the median and the versions of the codecs: parts of other settings are no parts of a run.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sat_intervals.store.folder import Folder
from sat_intervals.store.manifest import MANIFEST, sealed, unsealed
from sat_intervals.store.removal import PARTS
from sat_intervals.store.tiles import DamagedTilesError
from sat_intervals.store.zarr_arrays import checksum

Place = tuple[int, int]
"""Level of a file, 0 for its pixels, and row of blocks from the top."""


@dataclass(frozen=True)
class Parts:
    """The parts of a run in the folder of its tiles; ``run`` is a digest of all that decides their bytes."""

    folder: Folder
    run: str

    def _name(self, place: Place) -> str:
        return f"{self.run}_{place[0]}_{place[1]}"

    def done(self) -> dict[Place, dict[str, Any]]:
        """Return the records of the parts that are done."""
        texts, sizes = self.folder.read_all(PARTS), self.folder.inside(PARTS).sizes()
        found = {}
        for name, text in texts.items():
            run, *place = name.split("_")
            record = unsealed(text, name) if run == self.run else None
            if record and all(sizes.get(f"{name}_{kind}") == size for kind, (size, _) in record["files"].items()):
                level, row = map(int, place)
                found[level, row] = record
        return found

    def record(self, place: Place) -> dict[str, Any] | None:
        """Return the record of a part; None if it is missing or damaged."""
        name = self._name(place)
        return unsealed(self.folder.read(f"{PARTS}/{name}.json"), name)

    def write(self, place: Place, contents: Mapping[str, bytes], record: Mapping[str, Any]) -> None:
        """Write contents by kind, and then the record with their checksums in ``files``; the part is then done."""
        name = self._name(place)
        for kind, content in contents.items():
            self.folder.write_bytes(f"{PARTS}/{name}_{kind}", content)
        files = {kind: checksum(content) for kind, content in contents.items()}
        self.folder.write(f"{PARTS}/{name}.json", sealed({**record, "files": files}, name))
        if self.folder.read(MANIFEST) is None:  # another run removed the tiles meanwhile
            names = (f"{PARTS}/{name}{end}" for end in (".json", *(f"_{kind}" for kind in contents)))
            self.folder.delete_all([*names], [PARTS])
            self.folder.delete_if_empty()

    def read(self, place: Place, kind: str, record: Mapping[str, Any]) -> bytes:
        """Read a content.

        Raises
        ------
        DamagedTilesError
            It is missing or damaged; the part is no longer done.
        """
        name = self._name(place)
        content = self.folder.read_bytes(f"{PARTS}/{name}_{kind}")
        if content is None or checksum(content) != list(record["files"][kind]):
            self.folder.delete(f"{PARTS}/{name}.json")
            raise DamagedTilesError(
                f"the part {name}_{kind} in {self.folder} is damaged: rerun the same command: it makes it again"
            )
        return content

    def drop(self) -> None:
        """Delete the parts of the run; call it once its files are published."""
        names = self.folder.inside(PARTS).sizes()
        self.folder.delete_all([f"{PARTS}/{name}" for name in names if name.startswith(f"{self.run}_")], [PARTS])
