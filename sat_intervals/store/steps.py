"""What a step of a run hands to later ones, path states and matching costs: one file each, with its own checksum."""

import io
import struct
import zlib
from collections.abc import Iterable

import numpy as np

from sat_intervals.store.folder import Folder
from sat_intervals.store.removal import BORDERS, COSTS

__all__ = ["BORDERS", "COSTS", "read_step", "whole_steps", "write_step"]

_CHECKSUM = struct.Struct("<I")


def write_step(folder: Folder, run: str, kind: str, name: str, *arrays: np.ndarray) -> None:
    """Write arrays as a whole; ``kind`` is BORDERS or COSTS, and ``run`` names the run that they belong to."""
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


def whole_steps(folder: Folder, run: str, kind: str, names: Iterable[str]) -> set[str]:
    """Which files were written and are not damaged; damaged ones are removed."""
    there = folder.inside(kind).sizes().keys()
    return {name for name in names if name in there and read_step(folder, run, kind, name) is not None}
