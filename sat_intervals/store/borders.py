"""Path states that tiles hand to their neighbours: one file for each tile and wavefront, with its own checksum."""

import struct
import zlib
from collections.abc import Iterable

import numpy as np

from sat_intervals.store.folder import Folder
from sat_intervals.store.removal import BORDERS

# CRC-32 of the states, rows, columns, disparities in whole vectors.
_HEADER = struct.Struct("<4I")


def write_border(folder: Folder, name: str, column: np.ndarray, row: np.ndarray) -> None:
    """Write the states of a tile, ``(rows, 2, size)`` and ``(columns, 2, size)`` uint16, as a whole."""
    states = column.astype("<u2").tobytes() + row.astype("<u2").tobytes()
    header = _HEADER.pack(zlib.crc32(states), column.shape[0], row.shape[0], column.shape[2])
    folder.write_bytes(f"{BORDERS}/{name}", header + states)


def read_border(folder: Folder, name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Read what `write_border` wrote; None if the file is missing, and None after its removal if it is damaged."""
    content = folder.read_bytes(f"{BORDERS}/{name}")
    if content is None:
        return None
    header, states = content[: _HEADER.size], content[_HEADER.size :]
    if len(header) == _HEADER.size:
        checksum, rows, columns, size = _HEADER.unpack(header)
        if zlib.crc32(states) == checksum and len(states) == 4 * (rows + columns) * size:
            both = np.frombuffer(states, "<u2").astype(np.uint16).reshape(rows + columns, 2, size)
            return both[:rows], both[rows:]
    folder.delete(f"{BORDERS}/{name}")
    return None


def whole_borders(folder: Folder, names: Iterable[str]) -> set[str]:
    """Which borders were written and are not damaged; damaged ones are removed."""
    there = folder.inside(BORDERS).sizes().keys()
    return {name for name in names if name in there and read_border(folder, name) is not None}
