"""Read and write layers that fit in memory, and tags: which run or image a file was made from."""

import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from rasterio import Env
from rasterio.crs import CRS
from rasterio.io import DatasetWriter, MemoryFile
from rasterio.shutil import copy
from rasterio.transform import Affine

from sat_intervals.raster import gdal
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.images import opened
from sat_intervals.raster.publishing import new_file
from sat_intervals.tiling import Window

_LEFT = "LEFT_SHA256"  # tag of what belongs to a left image

_LOG = logging.getLogger(__name__)


def north_up(crs: str | int, x: float, y: float, pixel: float) -> Georeferencing:
    """Return the georeferencing of a north-up image with square pixels and its upper left corner at ``x, y``."""
    return Georeferencing(crs=CRS.from_user_input(crs), transform=Affine(pixel, 0.0, x, 0.0, -pixel, y))


def write_layer(
    path: str | os.PathLike[str],
    pixels: np.ndarray,
    nodata: float,
    georeferencing: Georeferencing,
    tags: Mapping[str, str] = MappingProxyType({}),
    **options: Any,
) -> None:
    """Write ``(rows, columns)`` as a tiled, compressed GeoTIFF of one band; replaces an existing file.

    ``options`` are further ones of rasterio, such as ``rpcs``.
    """
    height, width = pixels.shape
    kind = {"count": 1, "height": height, "width": width, "dtype": pixels.dtype.name, "nodata": nodata}
    kind |= {"tiled": True, "compress": "deflate", **georeferencing.creation_options(), **options}
    # made in memory: GDAL closes a file without an error when the disk is full
    with new_file(path) as temporary, Env(), MemoryFile() as memory:
        with gdal.create(memory.name, **kind) as dataset:
            dataset.update_tags(**tags)
            dataset.write(pixels, 1)
        temporary.write_bytes(memory.getbuffer())


def png_of(
    pixels: np.ndarray, nodata: float | None = None, describe: Callable[[DatasetWriter], None] = lambda dataset: None
) -> bytes:
    """Return a picture: ``(bands, rows, columns)``, grey or colours, and opacity; ``describe`` adds what is not one."""
    count, height, width = pixels.shape
    kind = {"count": count, "height": height, "width": width, "dtype": pixels.dtype.name, "nodata": nodata}
    with Env(GDAL_PAM_ENABLED="NO"), MemoryFile() as plain, MemoryFile() as made:
        with gdal.create(plain.name, **kind) as dataset:
            dataset.write(pixels)
            describe(dataset)
        copy(plain.name, made.name, driver="PNG", WRITE_METADATA_AS_TEXT="YES")
        return bytes(made.getbuffer())


def read_layers(path: str | os.PathLike[str], window: Window | None = None, band: int | None = None) -> np.ndarray:
    """Read ``(bands, rows, columns)`` of a file or a window inside it, or ``(rows, columns)`` of one band from 1."""
    with opened(str(path), window) as dataset:
        return np.asarray(dataset.read(band, window=window and window.slices))


def read_known(path: str | os.PathLike[str]) -> np.ndarray:
    """Read all bands of a file, ``(bands, rows, columns)``; NaN where there is no data."""
    with opened(str(path)) as dataset:
        return np.where(dataset.read_masks() != 0, dataset.read(), np.nan)


def read_shape(path: str | os.PathLike[str]) -> tuple[int, int, int]:
    """Return the numbers of bands, rows and columns of a file."""
    with opened(str(path)) as dataset:
        return dataset.count, dataset.height, dataset.width


def read_tags(path: str | os.PathLike[str]) -> dict[str, str]:
    """Read the tags of a file as a whole."""
    with opened(str(path)) as dataset:
        return dict(dataset.tags())


def is_surface_of(surface: Path, run: str) -> bool:
    """Return whether a surface model has points of a run, by the time when it finished."""
    return run in read_tags(surface).get("RUNS", "").split()


def tag_of_left(left: Mapping[str, Any]) -> dict[str, str]:
    """Return the tag by which `tags_beside` recognises the left image of an `identity`; empty without its SHA-256."""
    return {_LEFT: left["sha256"]} if "sha256" in left else {}


def tags_beside(path: str | Path, left: Mapping[str, Any]) -> dict[str, str]:
    """Return the tags of a raster; warn if it was made for another image than that of the `identity` ``left``."""
    tags = read_tags(path)
    if (made_for := tags.get(_LEFT)) and made_for != left.get("sha256", made_for):
        _LOG.warning("%s was made for another left image than %s: check that it is of this pair", path, left["path"])
    return tags
