"""Find the sources of virtual rasters, which GDAL lists only in part."""

import os
import re
from collections.abc import Iterator
from typing import NamedTuple
from xml.etree import ElementTree

from rasterio.io import DatasetReader

from sat_intervals.errors import InputError

# Names of GDAL that contain that of a file: ``vrt://file?bands=1``, ``GTIFF_DIR:1:file``, and texts of virtual rasters.
_IN_ANOTHER = re.compile(r"vrt://|[A-Z0-9_]+:|\s*<|/vsisparse/")
_SCHEME = "vrt://"
# Without numbers, ``scale`` asks GDAL for the extremes of the source.
_COMPUTED = re.compile(r"[?&]scale(_\d+)?=[^,&]*(&|$)", re.IGNORECASE)
# Elements of a virtual raster that name a file, and the metadata that do so: positions of a warped one.
_TAGS, _POSITIONS = ("SourceFilename", "SourceDataset", "DEMPath"), ("X_DATASET", "Y_DATASET")


class Sources(NamedTuple):
    """What a raster is made of.

    Attributes
    ----------
    names
        Sources of the bands and masks of a virtual raster, and heights to warp them.
    positions
        Where rasters with the positions of pixels may be.
    uses_overviews
        Whether GDAL may read overviews of sources, since it reads these at another resolution.
    """

    names: list[str]
    positions: list[str]
    uses_overviews: bool


def sources_of(path: str, dataset: DatasetReader) -> Sources:
    """Return the sources of an open raster.

    They are taken from the text that GDAL writes of the raster, in one spelling, however its own is spelled.

    Raises
    ------
    InputError
        A source has no name that can be watched.
    """
    names, positions, uses_overviews = [], [], False
    own = next(iter(dataset.files), path)  # "/vsicurl/http://" for "http://"
    if path.startswith(_SCHEME):
        names.append(path.removeprefix(_SCHEME).partition("?")[0])
    if path.lstrip().startswith(("<", _SCHEME)):
        own = ""  # sources are named as from the working directory
    if path.startswith(_SCHEME) and _COMPUTED.search(path):
        raise _computed(path)
    for element in _elements(path, dataset) if dataset.driver == "VRT" else ():
        if element.find("Exponent") is not None and None in (element.find("SrcMin"), element.find("SrcMax")):
            raise _computed(path)
        if (kind := element.get("subClass")) in ("VRTRawRasterBand", "VRTProcessedDataset"):
            raise InputError(
                f"{path} has a {kind}, of which GDAL does not report missing data or changed files: convert it with "
                "gdal_translate"
            )
        if element.tag == "OOI" and element.get("key") == "ROOT_PATH" and not _is_own_folder(path, element.text):
            raise InputError(
                f"{path} has sources relative to {element.text} (ROOT_PATH): convert it with gdal_translate"
            )
        if element.text and element.get("key", "").upper() in _POSITIONS:
            positions += [_beside(own, element.text), element.text]
        if element.tag in _TAGS and element.text:
            if "relativetovrt" in element.text.lower().replace('relativetovrt="0"', ""):
                raise InputError(f"{path} has a source that is a text with relative names: write that to a file")
            names.append(_resolved(own, element) if element.get("relativeToVRT") == "1" else element.text)
        is_level = element.get("key", "").upper() == "OVERVIEW_LEVEL"
        uses_overviews |= is_level or (element.find("SourceFilename") is not None and _is_resampled(element))
    return Sources(names, positions, uses_overviews)


def _computed(path: str) -> InputError:
    return InputError(f"{path} is scaled by extremes that GDAL takes from statistics or overviews: name the extremes")


def _elements(path: str, dataset: DatasetReader) -> Iterator[ElementTree.Element]:
    """Yield the elements of a virtual raster, but not its metadata, which may be any XML."""
    try:
        root = ElementTree.fromstring(str(dataset.tags(ns="xml:VRT")["xml:VRT"]))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not in UTF-8: write it with gdalbuildvrt") from error
    except ElementTree.ParseError as error:
        raise InputError(f"{path} has metadata that are not XML ({error}): convert it with gdal_translate") from error
    for parent in [*root.iter("VRTDataset"), *root.iter("VRTRasterBand")]:
        for metadata in parent.findall("Metadata"):
            parent.remove(metadata)
    return root.iter()


def _is_own_folder(path: str, folder: str | None) -> bool:
    return not folder or os.path.realpath(folder) == os.path.dirname(os.path.realpath(path))


def _is_resampled(source: ElementTree.Element) -> bool:
    """Return whether a source is, or may be, read at another size than its own."""
    parts = source.find("SrcRect"), source.find("DstRect")
    sizes = [[float(part.get(side, "nan")) for side in ("xSize", "ySize")] for part in parts if part is not None]
    return len(sizes) < 2 or sizes[0] != sizes[1]


def _resolved(own: str, source: ElementTree.Element) -> str:
    """Return the name of a relative source as seen from the working directory; ``A:b.tif`` may be a file, too.

    GDAL follows a link to a virtual raster, but writes the source of a warped one relative to the link.
    """
    name = source.text or ""
    beside = _beside(own if source.tag == "SourceDataset" else _followed(own), name)
    return beside if os.path.exists(beside) or not _IN_ANOTHER.match(name) else name


def _beside(path: str, name: str) -> str:
    return os.path.join(os.path.dirname(path), name)


def _followed(path: str) -> str:
    """Return the target of a link, whatever the links on the way to it."""
    while os.path.islink(path):
        path = _beside(path, os.readlink(path))
    return path
