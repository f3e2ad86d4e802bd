"""What a step of a run hands to later ones, path states and matching costs: one file each, with its own checksum."""

import io
import struct
import zlib
from collections.abc import Callable
from functools import cache

import numpy as np

from sat_intervals.store.folder import Folder

_CHECKSUM = struct.Struct("<I")


def write_step(folder: Folder, run: str, kind: str, name: str, *arrays: np.ndarray) -> None:
    """Write arrays as a whole; ``kind`` is their folder, BORDERS or COSTS, and ``run`` the run that they belong to."""
    content = io.BytesIO()
    content.write(_CHECKSUM.pack(0))
    for array in arrays:
        np.lib.format.write_array(content, array, allow_pickle=False)
    with content.getbuffer() as written:
        _CHECKSUM.pack_into(written, 0, _checksum(written[_CHECKSUM.size :], run, kind, name))
    folder.write_bytes(f"{kind}/{name}", content.getvalue())


def read_step(folder: Folder, run: str, kind: str, name: str) -> list[np.ndarray] | None:
    """Read what `write_step` wrote; None if the file is missing.

    None after its removal if it is damaged, or belongs to another run, tile or wavefront.
    """
    content = folder.read_bytes(f"{kind}/{name}")
    if content is None:
        return None
    payload = memoryview(content)[_CHECKSUM.size :]
    if not payload or _CHECKSUM.unpack_from(content) != (_checksum(payload, run, kind, name),):
        folder.delete(f"{kind}/{name}")
        return None
    stream, arrays = io.BytesIO(payload), []
    while stream.tell() < len(payload):
        arrays.append(np.lib.format.read_array(stream, allow_pickle=False))
    return arrays


def _checksum(payload: memoryview, *of: str) -> int:
    return zlib.crc32(payload, zlib.crc32("/".join(of).encode()))


def intact_steps(folder: Folder, run: str, kind: str) -> Callable[[str], bool]:
    """Return a function that tells whether a file was written and is not damaged; a damaged one is removed."""
    there = folder.inside(kind).sizes().keys()

    @cache
    def is_intact(name: str) -> bool:
        return name in there and read_step(folder, run, kind, name) is not None

    return is_intact
