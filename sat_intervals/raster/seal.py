"""Keep the CRC-32 of a GeoTIFF in its ghost area, where GDAL ignores the lines that it does not know.

Tools that make another file of it copy its tags, but not this area. Files beside it, which GDAL reads too, are refused.
"""

import os
import re
import zlib
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

from sat_intervals.errors import SatIntervalsError

_SIZE = re.compile(rb"GDAL_STRUCTURAL_METADATA_SIZE=(\d{6}) bytes\n")
# An even number of bytes: directories begin at even places.
_LINE, _ZEROS = b"SAT_INTERVALS_CRC_32=", b"00000000"
_SEAL = re.compile(_LINE + rb"([0-9a-f]{8})\n")
# Bytes of a file among which the line is.
_BEGINNING = 1024
# Endings, in any case, of files that GDAL reads with a raster: after its whole name, and instead of its own.
SIDECARS, _OF_STEM = (".aux.xml", ".aux", ".msk", ".ovr"), (".aux", ".rpb", ".rpc", "_rpc.txt", ".imd")
# World files, which it reads with a raster without a transform of its own.
_WORLD_FILES = ".wld", ".tab"
# Elements and keys of a file of GDAL beside a raster that has only statistics, as QGIS and ArcGIS write. Names of bands
# are repeated.
_STATISTICS = {
    *("PAMDataset", "PAMRasterBand", "Description", "Metadata", "MDI", "Histograms", "HistItem", "HistMin", "HistMax"),
    *("BucketCount", "IncludeOutOfRange", "Approximate", "HistCounts"),
}
_SHOWN = re.compile("STATISTICS_.*|PyramidResamplingType|DataType|RepresentationType")


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
    """Return whether a local file has a CRC-32 in it, and its bytes agree."""
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


def _checksums(path: str | Path) -> tuple[int, int] | None:
    """Return the CRC-32 in a file, and that of its bytes; None without one in it."""
    with open(path, "rb") as stream:
        beginning = stream.read(_BEGINNING)
        if not (seal := _SEAL.search(beginning)):
            return None
        checksum = zlib.crc32(beginning[: seal.start(1)] + _ZEROS + beginning[seal.end(1) :])
        while block := stream.read(1 << 20):
            checksum = zlib.crc32(block, checksum)
    return int(seal[1], 16), checksum


def check_beside(path: str | Path, files: Iterable[str]) -> None:
    """Raise if ``files`` next to one of our rasters change what GDAL reads.

    These are masks, overviews, sensor models, world files, and an ``.aux.xml`` with more than statistics.

    Raises
    ------
    SatIntervalsError
        Names the first such file.
    """
    for file in files:
        if Path(file) != Path(path) and is_read(file):
            raise SatIntervalsError(f"{file} changes what is read from {path}: move it away")


def check_place(path: Path, *, has_transform: bool = True) -> None:
    """Raise if files next to the place of a raster would change what GDAL reads from it, see `check_beside`.

    ``has_transform`` says whether the raster has a transform of its own.
    """
    kind = path.suffix
    of_stem = _OF_STEM if has_transform else (*_OF_STEM, *_WORLD_FILES, f"{kind}w", f"{kind[:2]}{kind[-1:]}w")
    names = [f"{path.name}{ending}" for ending in SIDECARS] + [f"{path.stem}{ending}" for ending in of_stem]
    try:
        lowered = {name.lower() for name in names}
        there = [name for name in os.listdir(path.parent) if name.lower() in lowered]
    except OSError:  # GDAL asks for each name in a folder that it cannot list
        there = [name for name in names if os.path.lexists(path.with_name(name))]
    check_beside(path, sorted(str(path.with_name(name)) for name in there))


def is_read(file: str) -> bool:
    """Return whether a file of a raster decides what is read: an ``.aux.xml`` that a program wrote may not."""
    return not (file.endswith(".aux.xml") and has_statistics_only(Path(file)))


def has_statistics_only(file: Path) -> bool:
    """Return whether an ``.aux.xml`` has nothing but statistics, as QGIS and ArcGIS write it for one they show."""
    if not file.is_file():  # a pipe would block
        return False
    try:
        elements = list(ElementTree.parse(file).iter())
    except (ElementTree.ParseError, OSError):
        return False
    keys = [element.get("key", "") for element in elements if element.tag == "MDI"]
    return {element.tag for element in elements} <= _STATISTICS and all(map(_SHOWN.fullmatch, keys))
