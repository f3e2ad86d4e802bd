"""List the files that a raster is read from."""

import os
import re
from contextlib import suppress
from html import unescape
from pathlib import Path

from rasterio.io import DatasetReader

from sat_intervals.errors import ChangedInputError, InputError
from sat_intervals.raster import gdal

# File systems of which GDAL does not say what it reads, and archives on servers, whose changes would not be noticed.
_UNKNOWN = re.compile(
    r"/vsi(sparse/|cached\?|\w+_streaming/)|(/?vsi(zip|tar|gzip|7z|rar|subfile)/(\d+(_\d+)?,)?\{?)+/?vsi(curl|s3|gs|az)"
)
# Bands of virtual rasters whose missing data GDAL takes for zeros.
_RAW = re.compile("VRTRawRasterBand|VRTProcessedDataset")
# What cannot change pixels at full resolution, or says of them what `describe` says, too.
_BESIDE = ".ovr", ".aux.xml"


def files_of(path: str) -> list[str]:
    """Return a raster and all other files that GDAL reads its pixels from: sources of virtual rasters, and masks."""
    try:
        with gdal.reading(path) as dataset:
            check_listed(path, dataset)
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
            check_listed(file, dataset)
            listed += dataset.files + _sources(file, dataset)
    return [path, *sorted(found.keys() - {path})]


def _sources(path: str, dataset: DatasetReader) -> list[str]:
    """Return local sources that a virtual raster names and GDAL does not list, such as those of its mask."""
    text = dataset.tags(ns="xml:VRT").get("xml:VRT", "") if dataset.driver == "VRT" else ""
    named = re.findall(r'<SourceFilename(?: relativeToVRT="(\d)")?[^>]*>([^<]+)', text)
    files = [os.path.join(os.path.dirname(path) if relative == "1" else "", unescape(name)) for relative, name in named]
    listed = {os.path.realpath(file) for file in dataset.files}
    return [file for file in files if os.path.isfile(file) and os.path.realpath(file) not in listed]


def check_listed(path: str, dataset: DatasetReader) -> None:
    """Raise if a change of the files of a raster, or missing data in them, would not be noticed."""
    is_raw = dataset.driver == "VRT" and _RAW.search(str(dataset.tags(ns="xml:VRT")))
    if dataset.driver in gdal.UNCHECKED or is_raw or any(map(os.path.isdir, (path, *dataset.files))):
        raise InputError(
            f"{path} has a format ({dataset.driver}) in which GDAL does not report missing data or changed files: "
            "convert it with gdal_translate"
        )
    if any(map(_UNKNOWN.match, (path, *dataset.files))):
        raise InputError(f"{path} is read from files whose changes would not be noticed: download or extract it")


def _is_same(file: str, name: str) -> bool:
    """Return whether GDAL lists a raster of this name as a file."""
    scheme, is_url, place = name.partition("://")
    is_listed = bool(is_url) and scheme != "vrt" and file.startswith("/vsi") and file.endswith(place)
    return is_listed or Path(file).resolve() == Path(name).resolve()
