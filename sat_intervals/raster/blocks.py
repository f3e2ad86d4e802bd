"""Compress rows of blocks of GeoTIFFs with GDAL, in memory."""

import struct
import zlib
from functools import cache
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
import rasterio
from rasterio import Env
from rasterio.io import MemoryFile

from sat_intervals.raster import gdal
from sat_intervals.raster.files import File

BLOCK = 512
"""Side of a block in pixels, and largest side of the smallest overview."""
COLUMNS = 4 * BLOCK
"""Columns compressed at a time: padded copies stay small."""
AROUND = 8
"""Bytes around each block in a file: its size before it, and a copy of its last four bytes after it."""

# Every GeoTIFF reader supports DEFLATE. On the bands of a Pleiades pair level 1 writes 5.4 Mpx per second and core, 49
# bits per pixel; level 6: 3.2 and 46; no compression: 9.1 and 186. Predictors are slower and larger (4.3 and 63), since
# bounds are integers and V-fits are fractions of small ones, whose bytes repeat.
# Each band has blocks of its own: with the bands of a pixel side by side files are 16 % larger, in 1.4 times the time.
# Of noisy bands ZSTD 3 writes 34 bits a pixel in 1.4 times the time of DEFLATE 1 (37).
_LEVELS = {"deflate": {"zlevel": 1}, "zstd": {"zstd_level": 3}}
_PREDICTORS = {"NO": 1, "FLOATING_POINT": 3}


class CompressedRow(NamedTuple):
    """A compressed row of blocks as in a file: sizes of the blocks alone, bytes with what is around each."""

    sizes: list[int]
    content: bytes


def factors(height: int, width: int) -> list[int]:
    """Return the factors of a file's levels: 1, and those of its overviews, see `halved`."""
    return [1, *(2**level for level in range(1, 32) if max(height, width) > BLOCK << (level - 1))]


def halved(bands: np.ndarray) -> np.ndarray:
    """Return ``(bands, rows, columns)`` at half the size: means of the known of 4 values, or every other flag."""
    # A value whose 4 have less than 2 known is unknown, so that shares of what is known stay.
    if bands.dtype.kind != "f":
        return bands[:, ::2, ::2]
    rows, columns = (-(-size // 2) for size in bands.shape[1:])
    total, count = np.zeros((len(bands), rows, columns), bands.dtype), np.zeros((len(bands), rows, columns), np.uint8)
    for part in (bands[:, row::2, column::2] for row in (0, 1) for column in (0, 1)):
        known, inner = np.isfinite(part), np.s_[:, : part.shape[1], : part.shape[2]]
        total[inner] += np.where(known, part, 0)
        count[inner] += known
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(count > 1, total / count, np.nan), bands.dtype)


def compressed(bands: np.ndarray, file: File) -> CompressedRow:
    """Compress ``(bands, at most BLOCK rows, columns)``: from left to right, a block of each band."""
    sizes: list[int] = []
    content = BytesIO()  # its value is not a copy
    for first in range(0, bands.shape[2], COLUMNS):
        for block in _compressed(bands[:, :, first : first + COLUMNS], file):
            sizes.append(len(block))
            content.writelines((struct.pack("<I", len(block)), block, block[-4:]))
    return CompressedRow(sizes, content.getvalue())


def _compressed(bands: np.ndarray, file: File) -> list[memoryview]:
    count, rows, columns = bands.shape
    whole = np.zeros((count, BLOCK, -(-columns // BLOCK) * BLOCK), file.dtype)  # what is beyond the image is equal, too
    whole[:, :rows, :columns] = bands
    kind = {"height": BLOCK, "width": whole.shape[2], "count": count, "dtype": file.dtype, "nodata": file.nodata}
    options = tiled(file, BLOCK) | _LEVELS[file.compression] | {"num_threads": 1}
    with Env(), MemoryFile() as memory:
        with gdal.create(memory.name, **kind, **options) as dataset:
            dataset.write(whole)
        with gdal.reading(memory.name) as dataset:
            places = [
                [int(dataset.get_tag_item(f"BLOCK_{name}_{x}_0", "TIFF", bidx=band)) for name in ("OFFSET", "SIZE")]
                for x in range(whole.shape[2] // BLOCK)
                for band in dataset.indexes
            ]
        content = memoryview(memory.read())
    return [content[offset : offset + size] for offset, size in places]


def tiled(file: File, side: int) -> dict[str, Any]:
    """Return the options of GDAL for blocks of a file with so many pixels a side."""
    return {
        "tiled": True,
        "blockxsize": side,
        "blockysize": side,
        "interleave": "band",
        "compress": file.compression,
        "predictor": _PREDICTORS[file.predictor],
    }


@cache
def codec_versions(compression: str) -> dict[str, Any]:
    """Return what decides the bytes of blocks of a run: versions, and checksums of some compressed numbers."""
    numbers = np.random.default_rng(0).integers(0, 99, (1, 99, 99))
    made = compressed(numbers, File("", "uint16", None, (), compression=compression)).content
    return {"rasterio": rasterio.__version__, "gdal": rasterio.__gdal_version__, "codec": zlib.crc32(made)}
