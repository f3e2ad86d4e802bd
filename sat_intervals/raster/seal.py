"""Keep the CRC-32 of a GeoTIFF in its ghost area, where GDAL ignores the lines that it does not know.

Tools that make another file of it copy its tags, but not this area.
"""

import os
import re
import zlib
from collections.abc import Iterable
from pathlib import Path

from sat_intervals.config import sealing
from sat_intervals.errors import SatIntervalsError, open_regular
from sat_intervals.raster.beside import check_beside

_SIZE = re.compile(rb"GDAL_STRUCTURAL_METADATA_SIZE=(\d{6}) bytes\n")
# An even number of bytes: directories begin at even places.
_LINE, _ZEROS = b"SAT_INTERVALS_CRC_32=", b"00000000"
_SEAL = re.compile(_LINE + rb"([0-9a-f]{8})\n")
# Bytes of a file among which the line is.
_BEGINNING = 1024


def with_room(ghost: bytes) -> bytes:
    """Return a ghost area with a line for a CRC-32, which is 0."""
    size = _SIZE.match(ghost)
    assert size
    line = _LINE + _ZEROS + b"\n"
    return b"GDAL_STRUCTURAL_METADATA_SIZE=%06d bytes\n" % (int(size[1]) + len(line)) + line + ghost[size.end() :]


def sealed(head: bytes, checksum: int) -> bytes:
    """Return the beginning of a file with its CRC-32, which is that of the file `with_room`."""
    return head.replace(_LINE + _ZEROS, _LINE + b"%08x" % checksum, 1)


def is_as_made(path: Path) -> bool:
    """Return whether a local GeoTIFF or picture has a CRC-32 in it, and its bytes agree."""
    if path.suffix == ".png":
        with open_regular(path) as stream:
            return bool(sealing.is_as_made(stream.read()))
    written, there = _checksums(path) or (0, None)
    return written == there


def check_seal(path: str | Path, files: Iterable[str]) -> None:
    """Raise if the bytes of a file differ from the CRC-32 in it; one without a CRC-32, or not local, passes.

    GDAL decodes most flipped bits of a compressed block without an error. ``files``: see `check_beside`.

    Raises
    ------
    SatIntervalsError
        Names the file and both checksums, or a file beside it.
    """
    if not os.path.isfile(path) or (checksums := _checksums(path)) is None:
        return
    written, there = checksums
    if there != written:
        raise SatIntervalsError(
            f"{path} is damaged or was changed: its CRC-32 is {there:08x}, but {written:08x} was written: move it away "
            "and make it again, or copy it with gdal_translate if you changed it"
        )
    check_beside(path, files)


def seal_of(path: Path) -> str | None:
    """Return the CRC-32 in a local GeoTIFF, eight hexadecimal digits; None without one in it."""
    with open_regular(path) as stream:
        seal = _SEAL.search(stream.read(_BEGINNING))
    return seal and seal[1].decode()


def _checksums(path: str | Path) -> tuple[int, int] | None:
    """Return the CRC-32 in a file, and that of its bytes; None without one in it."""
    with open_regular(path) as stream:
        beginning = stream.read(_BEGINNING)
        if not (seal := _SEAL.search(beginning)):
            return None
        checksum = zlib.crc32(beginning[: seal.start(1)] + _ZEROS + beginning[seal.end(1) :])
        while block := stream.read(1 << 20):
            checksum = zlib.crc32(block, checksum)
    return int(seal[1], 16), checksum
