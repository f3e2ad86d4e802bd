"""List the files that a raster is read from."""

import os
import re
from contextlib import suppress
from html import unescape
from pathlib import Path

from rasterio.io import DatasetReader

from sat_intervals.errors import ChangedInputError
from sat_intervals.raster import gdal

# What cannot change pixels at full resolution, or says of them what `describe` says, too.
_BESIDE = ".ovr", ".aux.xml"


def files_of(path: str) -> list[str]:
    """Return a raster and all other files that GDAL reads its pixels from: sources of virtual rasters, and masks."""
    try:
        with gdal.reading(path) as dataset:
            listed = [file for file in dataset.files if not _is_same(file, path)] + _sources(path, dataset)
    except gdal.GDAL_ERRORS as error:  # it could be opened before
        raise ChangedInputError(f"{path} cannot be read: {gdal.reason(error)}: restore it") from error
    found = dict.fromkeys([path])
    while listed:
        file = listed.pop(0)
        if file in found or file.lower().endswith(_BESIDE):
            continue
        found[file] = None
        with suppress(*gdal.GDAL_ERRORS), gdal.reading(file) as dataset:  # other files are no rasters
            listed += dataset.files + _sources(file, dataset)
    return [path, *sorted(found.keys() - {path})]


def _sources(path: str, dataset: DatasetReader) -> list[str]:
    """Return local sources that a virtual raster names and GDAL does not list, such as those of its mask."""
    text = dataset.tags(ns="xml:VRT").get("xml:VRT", "") if dataset.driver == "VRT" else ""
    named = re.findall(r'<SourceFilename(?: relativeToVRT="(\d)")?[^>]*>([^<]+)', text)
    files = [os.path.join(os.path.dirname(path) if relative == "1" else "", unescape(name)) for relative, name in named]
    listed = {os.path.realpath(file) for file in dataset.files}
    return [file for file in files if os.path.isfile(file) and os.path.realpath(file) not in listed]


def _is_same(file: str, name: str) -> bool:
    """Return whether GDAL lists a raster of this name as a file."""
    scheme, is_url, place = name.partition("://")
    is_listed = bool(is_url) and scheme != "vrt" and file.startswith("/vsi") and file.endswith(place)
    return is_listed or Path(file).resolve() == Path(name).resolve()
