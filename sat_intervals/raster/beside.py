"""Files that GDAL reads with a raster because of their names: masks, sensor models, world files, statistics."""

import os
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster.moves import arrivals

# Endings, in any case, of files that GDAL reads with a raster: after its whole name, and instead of its own.
SIDECARS, _OF_STEM = (".aux.xml", ".aux", ".msk", ".ovr"), (".aux", ".rpb", ".rpc", "_rpc.txt", ".imd")
# World files, which it reads with a raster without a transform of its own.
_WORLD_FILES = ".wld", ".tab"
# Others, which it reads with some formats, or that have a sensor model if their content is right.
_OF_SOME = ".hdr", ".prj", ".xml"
# Images of Pleiades and SPOT, whose sensor model has the name of all their tiles, in lower case.
_PLEIADES = re.compile(r"img_(.*?)(_r\d+c\d+)?")
# Elements and keys of a file of GDAL beside a raster that has only statistics, as QGIS and ArcGIS write. Names of bands
# are repeated.
_STATISTICS = {
    *("PAMDataset", "PAMRasterBand", "Description", "Metadata", "MDI", "Histograms", "HistItem", "HistMin", "HistMax"),
    *("BucketCount", "IncludeOutOfRange", "Approximate", "HistCounts"),
}
_SHOWN = re.compile("STATISTICS_.*|PyramidResamplingType|DataType|RepresentationType")


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
    names = _names(path, _OF_STEM if has_transform else (*_OF_STEM, *_world_files(path)))
    try:
        lowered = {name.lower() for name in names}
        there = [name for name in os.listdir(path.parent) if name.lower() in lowered]
    except OSError:  # GDAL asks for each name in a folder that it cannot list
        there = [name for name in names if os.path.lexists(path.with_name(name))]
    check_beside(path, sorted(str(path.with_name(name)) for name in there))


def _names(path: Path, of_stem: Iterable[str]) -> list[str]:
    return [f"{path.name}{ending}" for ending in SIDECARS] + [f"{path.stem}{ending}" for ending in of_stem]


def _world_files(path: Path) -> list[str]:
    kind = path.suffix
    return [*_WORLD_FILES, f"{kind}w", f"{kind[:2]}{kind[-1:]}w"]


@lru_cache(maxsize=1024)
def names_beside(name: str) -> frozenset[str]:
    """Return the names, in lower case, of all files that GDAL may read with a raster of this name."""
    path = Path(name.lower())
    product = _PLEIADES.fullmatch(path.stem)
    of_product = [f"{kind}_{product[1]}.xml" for kind in ("dim", "rpc")] if product else []
    return frozenset([*_names(path, (*_OF_STEM, *_world_files(path), *_OF_SOME)), *of_product]) - {path.name}


def came_beside(files: Iterable[str], *, with_overviews: bool = False) -> dict[str, int]:
    """Return how often files came that GDAL may read with rasters, by path, see `arrivals`.

    An ``.aux.xml`` that has statistics only does not count: programs that show a raster write it anew.
    """
    counts = {}
    for file in filter(os.path.isfile, files):
        folder, name = os.path.split(os.path.abspath(file))
        names = {other for other in names_beside(name) if with_overviews or not other.endswith(".ovr")}
        for other, count in arrivals(Path(os.path.realpath(folder)), names).items():
            if is_read(place := os.path.join(folder, other)):
                counts[place] = count
    return counts


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
