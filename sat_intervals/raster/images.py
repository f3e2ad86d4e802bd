"""Open images, and check that two make an epipolar pair."""

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.io import DatasetReader

from sat_intervals.errors import InputError
from sat_intervals.kernels.row_offsets import RowOffsets
from sat_intervals.raster import gdal
from sat_intervals.raster.georeferencing import Georeferencing, horizontal_name
from sat_intervals.raster.identity import files_of, identity, in_zip
from sat_intervals.tiling import Window

# Mask flags of bands without a mask of their own: GDAL derives one from nothing, the no-data value or the alpha band.
_NO_MASK = ([MaskFlags.all_valid], [MaskFlags.nodata], [MaskFlags.per_dataset, MaskFlags.alpha])
_SAME_SIZE = 1e-6  # relative difference below which pixel sizes are equal up to rounding

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Image:
    """One band of a raster file, with all that a worker needs to read any window of it; picklable."""

    path: str  # local file (absolute), URL, or any name that GDAL opens
    band: int  # counted from 1
    height: int
    width: int
    dtype: str  # NumPy name of the file's type
    nodata: float | None  # the user's, else the file's
    use_mask: bool  # whether the file has a mask, inside or in a .msk file
    alpha: int | None  # band that is 0 where there is no data, counted from 1
    mask: str | None  # the user's mask: a file of the same size, not 0 where the image must not be used
    georeferencing: Georeferencing
    nodata_given: bool = False  # whether ``nodata`` is the user's
    rows: RowOffsets | None = None  # how far rows of a right image lie from those of the left one; taken out on reading


def open_image(
    path: str | os.PathLike[str],
    *,
    band: int | None = None,
    nodata: float | None = None,
    mask: str | os.PathLike[str] | None = None,
) -> Image:
    """Open an image without reading a pixel.

    Parameters
    ----------
    path
        Local file, URL, or any name that GDAL opens.
    band
        Counted from 1; required if there are several, not counting an alpha band. An alpha band that is named is read
        as an image.
    nodata
        Replaces the file's value; a value that the file's type cannot hold matches no pixel. Mask and alpha band of the
        file still apply, and NaN and infinity are always no data.
    mask
        File of the same size; its first band is not 0 where the image must not be used.

    Raises
    ------
    InputError
        The file has no usable band, or the mask has another size.
    """
    name = _absolute(path)
    mask = None if mask is None else _absolute(mask)
    with opened(name) as dataset:
        colours = dataset.colorinterp
        alphas = [number for number in dataset.indexes if colours[number - 1] == ColorInterp.alpha and number != band]
        others = [number for number in dataset.indexes if number not in alphas]
        band = _chosen(name, others, alphas, band)
        image = Image(
            path=name,
            band=band,
            height=dataset.height,
            width=dataset.width,
            dtype=dataset.dtypes[band - 1],
            nodata=dataset.nodatavals[band - 1] if nodata is None else float(nodata),
            use_mask=dataset.mask_flag_enums[band - 1] not in _NO_MASK,
            alpha=alphas[0] if alphas else None,
            mask=mask,
            georeferencing=Georeferencing.of(dataset),
            nodata_given=nodata is not None,
        )
        if colours[band - 1] == ColorInterp.palette:
            remedy = "expand it with gdal_translate -expand gray"
            raise InputError(f"{name}: band {band} has a colour table, so values are no grey levels: {remedy}")
        if dataset.driver == "GTiff" and (pages := len(dataset.subdatasets)) > 1:
            _LOG.warning("%s has %d pages: the first is used; name another as GTIFF_DIR:2:%s", name, pages, name)
    if alphas and len(others) > 1:
        remedy = f"if it is an image band, give gdal_edit.py -colorinterp_{alphas[0]} undefined"
        _LOG.warning("%s: band %d is read as alpha, 0 is no data: %s", name, alphas[0], remedy)
    if "complex" in image.dtype:
        raise InputError(f"{name}: band {band} is {image.dtype}, matching needs real values: give its amplitude")
    if mask is not None:
        with opened(mask) as dataset:
            check_size(mask, dataset.shape, image, "give a mask of the image's size")
    return image


def check_size(path: str, shape: tuple[int, int], image: Image, remedy: str) -> None:
    """Raise if a raster has another number of rows or columns than an image."""
    if shape != (image.height, image.width):
        sizes = f"{shape[0]} x {shape[1]} pixels, {image.path} {image.height} x {image.width}"
        raise InputError(f"{path} has {sizes}: {remedy}")


def acquired(path: str) -> datetime | None:
    """Return when an image was taken, by its tags; None without."""
    with opened(path) as dataset:
        tags = dataset.tags() | dataset.tags(ns="IMAGERY")
    for name in ("ACQUISITIONDATETIME", "NITF_IDATIM", "TIFFTAG_DATETIME"):
        digits = "".join(filter(str.isdigit, tags.get(name, "")))[:8]
        with suppress(ValueError):
            return datetime.strptime(digits, "%Y%m%d")
    return None


def describe(image: Image, known: Mapping[str, Mapping[str, Any]] | None = None) -> dict[str, Any]:
    """Return what decides the pixels of an image, for run.json and the manifest; ``known``: see `identity`."""
    crs = image.georeferencing.crs
    return {
        **_identities(image.path, known),
        "height": image.height,
        "width": image.width,
        "band": image.band,
        "dtype": image.dtype,
        "nodata": None if image.nodata is None else repr(image.nodata),
        "crs": crs.to_string() if crs else None,
        "use_mask": image.use_mask,
        "alpha": image.alpha,
        "mask": _identities(image.mask, known) if image.mask else None,
    }


def _identities(name: str, known: Mapping[str, Mapping[str, Any]] | None) -> dict[str, Any]:
    """Return the identity of a raster and of the other files that decide its pixels."""
    return {**identity(name, known), "files": [identity(file, known) for file in files_of(name)[1:]]}


def check_pair(left: Image, right: Image, count: int) -> None:
    """Raise if rows do not correspond, or ``count`` disparities cannot be searched; widths and origins may differ."""
    pair = f"{left.path} and {right.path}"
    if left.height != right.height:
        raise InputError(
            f"{pair} have {left.height} and {right.height} rows, but rows must correspond: resample the pair together"
        )
    here, there = left.georeferencing, right.georeferencing
    here_crs, there_crs = here.crs or here.gcps_crs, there.crs or there.gcps_crs
    if here_crs and there_crs and here_crs != there_crs and horizontal_name(here_crs) != horizontal_name(there_crs):
        names = f"{here_crs.to_string()} and {there_crs.to_string()}"
        raise InputError(f"{pair} have different CRS, {names}: resample the pair together")
    if here.transform and there.transform and not np.allclose(here.pixel_size, there.pixel_size, _SAME_SIZE, 0):
        names = "{:.9g} x {:.9g} and {:.9g} x {:.9g}".format(*here.pixel_size, *there.pixel_size)
        raise InputError(f"{pair} have different pixel sizes, {names}: resample the pair together")
    if count > right.width:
        raise InputError(f"{right.path} has {right.width} columns, fewer than the {count} disparities: search fewer")


@contextmanager
def opened(path: str, window: Window | None = None) -> Iterator[DatasetReader]:
    """Open a raster for reading and turn GDAL's errors into `InputError`; ``window`` is for the message."""
    try:
        with gdal.reading(path) as dataset:
            yield dataset
    except gdal.GDAL_ERRORS as error:
        reason = gdal.reason(error).removeprefix(f"{path}: ").rstrip(".")
        if window is None:
            raise InputError(
                f"{path} cannot be read: {reason}: give the path of a raster, such as a GeoTIFF"
            ) from error
        raise InputError(
            f"{path} cannot be read at {window.in_words}: {reason}: the file may be truncated, give a complete copy"
        ) from error


def _absolute(path: str | os.PathLike[str]) -> str:
    """Return the absolute path of a local file, also of a zip archive, and other GDAL names unchanged."""
    # ``link/..`` is the folder above the target of the link, which `os.path.abspath` takes for that above the link.
    name = os.fspath(path)
    if (inside := in_zip(name)) and inside.at:
        return f"/vsizip/{{{Path(str(inside.root.filename)).absolute()}}}/{inside.at}"  # paths have no double slash
    return str(Path(name).absolute()) if os.path.exists(name) else name


def _chosen(path: str, bands: list[int], alphas: list[int], band: int | None) -> int:
    """Return the number of the band to match."""
    if not bands:
        raise InputError(f"{path} has no image band: give a raster, or one of its subdatasets")
    there = f"band {bands[0]} only" if len(bands) == 1 else f"bands {bands[0]} to {bands[-1]}"
    alpha = f" (band {alphas[0]} is read as alpha)" if alphas else ""
    if band is None and len(bands) > 1:
        raise InputError(
            f"{path} has {there}{alpha}: give a file of one band (gdal_translate -b), or --band if there is one"
        )
    if band is not None and band not in bands:
        raise InputError(f"{path} has no image band {band}, it has {there}{alpha}: choose with --band")
    return bands[0] if band is None else band
