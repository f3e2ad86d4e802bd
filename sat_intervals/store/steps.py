"""What steps of a run hand to later ones: path states, pixels and costs; one file each, with its own checksums."""

import struct
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import cache

import google_crc32c
import numpy as np

from sat_intervals.store.folder import Folder
from sat_intervals.store.manifest import MANIFEST, StoreError, sealed, unsealed
from sat_intervals.store.removal import BORDERS, COSTS, PIXELS, final_name

# A file is the length of its header, the header, a sealed text, and the bytes of all arrays. Every tile reads those of
# its neighbours: processors have an instruction for CRC-32C, which takes a third of the time of CRC-32.
_LENGTH = struct.Struct("<I")


@dataclass(frozen=True)
class Steps:
    """Files of the steps of a run.

    Attributes
    ----------
    folder
        Folder of the tiles.
    run
        Digest of the manifest: what belongs to another run is not taken for a part of this one.
    """

    folder: Folder
    run: str

    def write(self, kind: str, name: str, *arrays: np.ndarray) -> None:
        """Write arrays as a whole; ``kind`` is their folder, such as BORDERS."""
        whole = [np.ascontiguousarray(array) for array in arrays]
        about = [[array.dtype.str, list(array.shape), _checksum(array)] for array in whole]
        header, file = sealed({"arrays": about}, f"{self.run}/{kind}/{name}").encode(), f"{kind}/{name}"
        self.folder.write_bytes(file, b"".join([_LENGTH.pack(len(header)), header, *(array.data for array in whole)]))
        if self.folder.read(MANIFEST) is None:  # another run removed the tiles meanwhile
            self.folder.delete(file)

    def read(self, kind: str, name: str, wanted: Iterable[int] | None = None) -> list[np.ndarray] | None:
        """Read what `write` wrote, or only the ``wanted`` arrays.

        None if the file is missing, damaged, or of another run, tile or wavefront. It is not deleted: another worker
        may just have written it again.
        """
        content = self.folder.read_bytes(f"{kind}/{name}")
        return None if content is None else _parsed(content, f"{self.run}/{kind}/{name}", wanted)

    def intact(self, kind: str) -> Callable[[str], bool]:
        """Return a function that returns whether a file was written and is not damaged."""
        there = self.folder.inside(kind).sizes().keys()

        @cache
        def is_intact(name: str) -> bool:
            return name in there and self.read(kind, name) is not None

        return is_intact

    def drop_sources(self, tiles: Collection[str]) -> None:
        """Delete pixels and precomputed costs of tiles, which nothing needs once all are matched."""
        names = ((kind, name) for kind in (PIXELS, COSTS) for name in self.folder.inside(kind).sizes())
        # Not the folders: damaged tiles need them again.
        self.folder.delete_all([f"{kind}/{name}" for kind, name in names if final_name(name) in tiles])

    def missing_bytes(self, needed: int) -> int:
        """Return the bytes that a run has yet to write of those that it needs for its steps."""
        kinds = (BORDERS, PIXELS, COSTS) if needed else ()
        return max(0, needed - sum(sum(self.folder.inside(kind).sizes().values()) for kind in kinds))

    def check_space(self, needed: int) -> None:
        """Raise if the disk has no room for the bytes that a run needs for its steps and does not have yet.

        Raises
        ------
        StoreError
            Gives free and needed space.
        """
        needed = self.missing_bytes(needed)
        free = self.folder.free_bytes()
        if free is not None and free < needed:
            raise StoreError(
                f"{self.folder} has {free / 1e6:,.1f} MB free, what tiles hand to each other needs {needed / 1e6:,.1f} "
                "MB: free disk space and rerun; or, with --overwrite, choose another --store or --overlap 100"
            )


def _parsed(content: bytes, of: str, wanted: Iterable[int] | None) -> list[np.ndarray] | None:
    """Return the wanted arrays of a file; None if it is damaged or belongs to something else."""
    if len(content) < _LENGTH.size:
        return None
    place = _LENGTH.size + _LENGTH.unpack_from(content)[0]
    header = unsealed(content[_LENGTH.size : place].decode(errors="replace"), of)
    if header is None:
        return None
    places = []
    for dtype, shape, checksum in header["arrays"]:
        size = np.dtype(dtype).itemsize * int(np.prod(shape))
        places.append((place, place + size, dtype, shape, checksum))
        place += size
    if place != len(content):
        return None
    found, view = [], memoryview(content)
    for start, stop, dtype, shape, checksum in places if wanted is None else [places[i] for i in wanted]:
        array = np.frombuffer(view[start:stop], dtype).reshape(shape)
        if _checksum(array) != checksum:
            return None
        found.append(array.copy())  # kernels take writable arrays
    return found


def _checksum(array: np.ndarray) -> int:
    """Return the CRC-32C of the bytes of an array, which are not copied."""
    return int(google_crc32c.value(array.reshape(-1).view(np.uint8)))
