"""What a step of a run hands to later ones, path states and matching costs: one file each, with its own checksums."""

import struct
import zlib
from collections.abc import Callable, Iterable
from functools import cache

import numpy as np

from sat_intervals.store.folder import Folder
from sat_intervals.store.manifest import sealed, unsealed

# A file is the length of its header, the header, a sealed text, and the bytes of all arrays.
_LENGTH = struct.Struct("<I")


def write_step(folder: Folder, run: str, kind: str, name: str, *arrays: np.ndarray) -> None:
    """Write arrays as a whole; ``kind`` is their folder, BORDERS or COSTS, and ``run`` the run that they belong to."""
    whole = [np.ascontiguousarray(array) for array in arrays]
    about = [[array.dtype.str, list(array.shape), zlib.crc32(array.data)] for array in whole]
    header = sealed({"arrays": about}, f"{run}/{kind}/{name}").encode()
    folder.write_bytes(
        f"{kind}/{name}", b"".join([_LENGTH.pack(len(header)), header, *(array.data for array in whole)])
    )


def read_step(
    folder: Folder, run: str, kind: str, name: str, wanted: Iterable[int] | None = None
) -> list[np.ndarray] | None:
    """Read what `write_step` wrote, or only the ``wanted`` arrays; None if the file is missing.

    None after its removal if it is damaged, or belongs to another run, tile or wavefront.
    """
    content = folder.read_bytes(f"{kind}/{name}")
    found = None if content is None else _parsed(content, f"{run}/{kind}/{name}", wanted)
    if content is not None and found is None:
        folder.delete(f"{kind}/{name}")
    return found


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
        if zlib.crc32(view[start:stop]) != checksum:
            return None
        found.append(np.frombuffer(view[start:stop], dtype).reshape(shape).copy())  # kernels take writable arrays
    return found


def intact_steps(folder: Folder, run: str, kind: str) -> Callable[[str], bool]:
    """Return a function that tells whether a file was written and is not damaged; a damaged one is removed."""
    there = folder.inside(kind).sizes().keys()

    @cache
    def is_intact(name: str) -> bool:
        return name in there and read_step(folder, run, kind, name) is not None

    return is_intact
