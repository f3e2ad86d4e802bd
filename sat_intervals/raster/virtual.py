"""Find the sources of virtual rasters, which GDAL lists only in part."""

import os
import re
from xml.etree import ElementTree

from rasterio.io import DatasetReader

from sat_intervals.errors import InputError

# Names of GDAL that contain that of a file: ``vrt://file?bands=1``, ``GTIFF_DIR:1:file``, and texts of virtual rasters.
_IN_ANOTHER = re.compile(r"vrt://|[A-Z0-9_]+:|\s*<|/vsisparse/")
# Elements of a virtual raster that name a file, and the metadata that do so: positions of a warped one.
_TAGS, _POSITIONS = ("SourceFilename", "SourceDataset", "DEMPath"), ("X_DATASET", "Y_DATASET")


def is_in_another(name: str) -> bool:
    """Return whether a name of GDAL contains that of a file."""
    return _IN_ANOTHER.match(name) is not None


def sources(path: str, dataset: DatasetReader) -> list[str]:
    """Return the names of all sources of an open raster: those of bands, masks and positions of a virtual one.

    They are taken from the text that GDAL writes of the raster, in one spelling, however its own is spelled.

    Raises
    ------
    InputError
        A source has no name that can be watched.
    """
    positions = {key.upper(): value for key, value in dataset.tags(ns="GEOLOCATION").items()}
    names = [positions[key] for key in _POSITIONS if key in positions]
    # needed only where GDAL warps
    found = [place for name in names for place in (_beside(path, name), name) if os.path.exists(place)]
    if dataset.driver == "VRT":
        for element in ElementTree.fromstring(_text(path, dataset)).iter():
            if (kind := element.get("subClass")) in ("VRTRawRasterBand", "VRTProcessedDataset"):
                raise InputError(
                    f"{path} has a {kind}, of which GDAL does not report missing data or changed files: convert it "
                    "with gdal_translate"
                )
            if element.get("key") == "ROOT_PATH" and not _is_own_folder(path, element.text):
                raise InputError(f"{path} has sources in another folder than it says: convert it with gdal_translate")
            if element.tag in _TAGS and element.text:
                is_relative = element.get("relativeToVRT") == "1"
                found.append(_resolved(path, element.text) if is_relative else element.text)
    return found


def _is_own_folder(path: str, folder: str | None) -> bool:
    return not folder or os.path.realpath(folder) == os.path.dirname(os.path.realpath(path))


def _text(path: str, dataset: DatasetReader) -> str:
    try:
        return str(dataset.tags(ns="xml:VRT")["xml:VRT"])
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not in UTF-8: write it with gdalbuildvrt") from error


def _resolved(path: str, name: str) -> str:
    """Return the name of a relative source as seen from the working directory; ``A:b.tif`` may be a file, too."""
    beside = _beside(path, name)
    return beside if os.path.exists(beside) or not is_in_another(name) else name


def _beside(path: str, name: str) -> str:
    """Return a name in the folder of a virtual raster; GDAL follows a link to it first."""
    return os.path.join(os.path.dirname(os.path.realpath(path) if os.path.isfile(path) else path), name)
