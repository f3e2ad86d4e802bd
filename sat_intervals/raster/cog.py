"""Assemble Cloud-Optimized GeoTIFFs from blocks that were compressed apart, in any order and by any worker.

GDAL compresses the blocks in memory and writes all tags into a small template file of the same kind. This module only
computes the offsets of the blocks. The layout is that of GDAL's COG driver: directories, then the smallest overview
first, each block between its size and a copy of its last four bytes. Blocks of the bands of a place follow each other.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rasterio import Env
from rasterio.io import MemoryFile
from rasterio.shutil import copy

from sat_intervals.raster import gdal
from sat_intervals.raster.blocks import AROUND, BLOCK, factors, tiled
from sat_intervals.raster.files import File
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.vertical import with_vertical

# Side of a block of the template, the smallest of GDAL's COG driver: larger ones take time and hold nothing.
_SMALL = 128
_CLASSIC = 1 << 32  # size from which a file is a BigTIFF
# Tags of a TIFF directory, its types, and their sizes in bytes.
_WIDTH, _HEIGHT, _BLOCK_WIDTH, _BLOCK_HEIGHT, _OFFSETS, _SIZES, _PLANES = 256, 257, 322, 323, 324, 325, 284
_KEYS, _TEXTS = 34735, 34737  # of a CRS
_ASCII, _SHORT, _LONG, _LONG8 = 2, 3, 4, 16
_BYTES = {1: 1, _ASCII: 1, _SHORT: 2, _LONG: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, _LONG8: 8}

Directory = dict[int, tuple[int, int, bytes]]
"""Type, count and values of each tag."""

Template = tuple[bytes, list[Directory]]
"""Ghost area and directories of a file and its first overview."""


class Part(NamedTuple):
    """A compressed row of blocks: sizes of the blocks, and where they are, for `CopyParts`."""

    sizes: Sequence[int]
    source: Any

    @property
    def length(self) -> int:
        """Return the number of bytes, with those around each block."""
        return sum(self.sizes) + AROUND * len(self.sizes)


CopyParts = Callable[[Path, Sequence[tuple[int, Part]]], None]
"""Writes parts into a file, each at its offset."""


def template(file: File, place: Georeferencing, tags: Mapping[str, str]) -> Template:
    """Return what a small Cloud-Optimized GeoTIFF with one overview has in common with a file: all other tags."""
    # It is made in memory: GDAL says nothing of some failures to write to a disk.
    kind = {"count": len(file.bands), "dtype": file.dtype, "nodata": file.nodata, "sparse_ok": True}
    options = {"COMPRESS": file.compression.upper(), "PREDICTOR": file.predictor, "BLOCKSIZE": _SMALL}
    # its bands are side by side, since the ghost area of newer versions would say that each follows the other
    kind |= tiled(file, _SMALL) | {"interleave": "pixel", "height": _SMALL + 1, "width": _SMALL + 1}
    with Env(GDAL_TIFF_ENDIANNESS="LITTLE"), MemoryFile() as small, MemoryFile() as made:
        with gdal.create(small.name, **kind, **place.creation_options()) as dataset:
            file.describe(dataset, tags)
        copy(small.name, made.name, driver="COG", SPARSE_OK="YES", OVERVIEW_RESAMPLING="NEAREST", **options)
        ghost, directories = _parsed(bytes(made.getbuffer()))
    whole = directories[0]
    level = tags.get("HEIGHTS", "")
    if file.is_of_heights and level.startswith("above") and place.crs and _KEYS in whole:
        keys, texts = with_vertical(place.crs, level, whole[_KEYS][2], whole[_TEXTS][2])
        whole |= {_KEYS: (_SHORT, len(keys) // 2, keys), _TEXTS: (_ASCII, len(texts), texts)}
    return ghost, directories


def assemble(
    path: Path, made: Template, shape: tuple[int, int], levels: Sequence[Sequence[Part]], copy_parts: CopyParts
) -> None:
    """Write a file in place from its `template` and the rows of blocks of each level, from the top; see `factors`."""
    sizes = [[size for part in level for size in part.sizes] for level in levels]
    head = header(made, shape, sizes)
    parts = [part for level in reversed(levels) for part in level]
    *offsets, size = accumulate((part.length for part in parts), initial=len(head))
    with open(path, "wb") as stream:
        stream.write(head)
        stream.truncate(size)
    copy_parts(path, list(zip(offsets, parts, strict=True)))


def header(made: Template, shape: tuple[int, int], sizes: Sequence[Sequence[int]]) -> bytes:
    """Return all that comes before the first block: `template`, rows and columns, bytes of the blocks of each level."""
    ghost, (whole, overview) = made
    directories, levels = [], []
    for factor, of_level in zip(factors(*shape), sizes, strict=True):
        height, width = (-(-side // factor) for side in shape)
        levels.append(np.reshape(of_level, (-(-height // BLOCK) * -(-width // BLOCK), -1)))
        numbers = {_WIDTH: width, _HEIGHT: height}
        changed = {tag: (_LONG, 1, struct.pack("<I", number)) for tag, number in numbers.items()}
        changed[_SIZES] = _LONG, len(of_level), levels[-1].T.astype("<u4").tobytes()
        changed[_PLANES] = _SHORT, 1, struct.pack("<H", 1 if levels[-1].shape[1] == 1 else 2)  # 2: apart
        changed |= dict.fromkeys((_BLOCK_WIDTH, _BLOCK_HEIGHT), (_SHORT, 1, struct.pack("<H", BLOCK)))
        directories.append((whole if factor == 1 else overview) | changed)
    data = sum(size + AROUND for of_level in sizes for size in of_level)
    is_big = data + len(_written(ghost, directories, levels, 0, is_big=False)) >= _CLASSIC
    start = len(_written(ghost, directories, levels, 0, is_big=is_big))
    return _written(ghost, directories, levels, start, is_big=is_big)


def _written(
    ghost: bytes, directories: Sequence[Directory], sizes: Sequence[np.ndarray], start: int, *, is_big: bool
) -> bytes:
    """Return header, ghost area and directories of a file whose blocks begin at ``start``, of ``(places, bands)``."""
    kind, dtype = (_LONG8, "<u8") if is_big else (_LONG, "<u4")
    offsets: list[bytes] = []
    for of_level in reversed(sizes):
        *places, start = accumulate(of_level.flat, lambda place, size: place + int(size) + AROUND, initial=start)
        offsets.insert(0, (np.reshape(places, of_level.shape).T + 4).astype(dtype).tobytes())
    out = bytearray(struct.pack("<2sHHHQ", b"II", 43, 8, 0, 0) if is_big else struct.pack("<2sHI", b"II", 42, 0))
    pointer, number, entry = (8, "<Q", "<HHQ8s") if is_big else (4, "<I", "<HHI4s")
    inline = struct.calcsize(number)
    out += ghost
    for directory, there in zip(directories, offsets, strict=True):
        out += bytes(len(out) % 2)
        struct.pack_into(number, out, pointer, len(out))
        tags = directory | {_OFFSETS: (kind, len(there) // inline, there)}
        after = len(out) + struct.calcsize("<Q" if is_big else "<H") + len(tags) * struct.calcsize(entry) + inline
        entries, values = bytearray(), bytearray()
        for tag, (of, count, value) in sorted(tags.items()):
            field = value
            if len(value) > inline:
                values += bytes(len(values) % 2)
                field = struct.pack(number, after + len(values))
                values += value
            entries += struct.pack(entry, tag, of, count, field)
        out += struct.pack("<Q" if is_big else "<H", len(tags)) + entries
        pointer = len(out)
        out += bytes(inline) + values
    return bytes(out)


def _parsed(made: bytes) -> Template:
    """Return the ghost area and the directories of a small TIFF."""
    (place,) = struct.unpack_from("<4xI", made)
    ghost, directories = made[8:place], []
    while place:
        (count,) = struct.unpack_from("<H", made, place)
        directory: Directory = {}
        for at in range(place + 2, place + 2 + 12 * count, 12):
            tag, kind, number = struct.unpack_from("<HHI", made, at)
            length = _BYTES[kind] * number
            start = at + 8 if length <= 4 else struct.unpack_from("<I", made, at + 8)[0]
            directory[tag] = kind, number, made[start : start + length]
        directories.append(directory)
        (place,) = struct.unpack_from("<I", made, place + 2 + 12 * count)
    return ghost, directories
