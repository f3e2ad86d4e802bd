"""Open and create rasters with GDAL: no warning about missing georeferencing, and errors in one line."""

import errno
import os
import re
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
from rasterio import Env
from rasterio._err import CPLE_BaseError, CPLE_OutOfMemoryError
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetReader, DatasetWriter

# rasterio.shutil.copy raises the last two; SystemError stands for a failure that GDAL does not explain.
GDAL_ERRORS = (RasterioError, CPLE_BaseError, SystemError)

# rasterio warns about every image without georeferencing, which epipolar images often lack. Datasets are opened by
# their classes, not by rasterio.open, so that the warning comes from this module and the filter applies to it alone.
# `warnings.catch_warnings` is not thread-safe.
_QUIET = ("ignore", None, NotGeoreferencedWarning, re.compile(re.escape(__name__)), 0)
_LOCK = threading.Lock()

# GDAL's prefixes of files on servers, with and without a URL in the form of a query.
_REMOTE = "vsicurl/", "vsicurl?", "vsis3/", "vsigs/", "vsiaz/", "vsiadls/", "vsioss/", "vsiswift/", "vsiwebhdfs/"
# With these, all files of an image are read as they are now, whatever the environment of a worker, and damage is an
# error: rasterio ignores a failure without a message, and returns zeros.
_STRICT = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "FALSE",  # otherwise masks beside an image are not seen
    "GDAL_READDIR_LIMIT_ON_OPEN": "1000000",  # of a bucket, GDAL takes the first names for all
    "GDAL_PAM_ENABLED": "YES",  # otherwise no-data values in .aux.xml are not seen
    "CPL_VSIL_CURL_NON_CACHED": ":".join(f"/{name}" for name in _REMOTE),  # a later run may find another file there
    "GDAL_HTTP_MAX_RETRY": os.environ.get("GDAL_HTTP_MAX_RETRY", "3"),  # a busy server seems to have no mask
    "GDAL_HTTP_RETRY_DELAY": os.environ.get("GDAL_HTTP_RETRY_DELAY", "1"),  # seconds; doubles each time
    "GDAL_NUM_THREADS": "1",  # a failure in another thread has no message in this one
    "VRT_NUM_THREADS": "1",
    "GDAL_PNG_WHOLE_IMAGE_OPTIM": "NO",  # reads what is missing from memory that was never written
}
_ENDPOINTS = "AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL"  # for fsspec
# A source of a VRT that cannot be opened fails without a message in each other dataset until the first is closed.
_OF_SOURCES = threading.RLock()


@contextmanager
def reading(path: str, **options: Any) -> Iterator[DatasetReader]:
    """Open a raster for reading; thread-safe. Only one thread of a process reads VRTs."""
    _accept_no_georeferencing()
    # rasterio casts the no-data value to the type: -1.8e308, of ArcGIS, overflows float32
    with Env(**_STRICT, **_server()), np.errstate(over="ignore"):
        dataset = DatasetReader(path, **options)
        with _OF_SOURCES if dataset.driver == "VRT" else nullcontext(), dataset:
            yield dataset


def _server() -> dict[str, str]:
    """Return GDAL's options for the S3 server that fsspec asks."""
    scheme, _, address = next(filter(None, map(os.environ.get, _ENDPOINTS)), "").partition("://")
    if not address or "AWS_S3_ENDPOINT" in os.environ:
        return {}
    hosting = os.environ.get("AWS_VIRTUAL_HOSTING", "FALSE")
    return {"AWS_S3_ENDPOINT": address.rstrip("/"), "AWS_HTTPS": str(scheme != "http"), "AWS_VIRTUAL_HOSTING": hosting}


def create(path: str, **options: Any) -> DatasetWriter:
    """Create a GeoTIFF; call it inside a `rasterio.Env`."""
    _accept_no_georeferencing()
    return DatasetWriter(path, "w", driver="GTiff", endianness="LITTLE", **options)


def reason(error: BaseException) -> str:
    """Return GDAL's first message about a failure, in one line."""
    while error.__cause__ is not None:
        error = error.__cause__
    return "GDAL gives no cause" if isinstance(error, SystemError) else " ".join(str(error).split())


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether the first cause of an error is a failed allocation."""
    while error.__cause__ is not None:
        error = error.__cause__
    message = re.search("out of memory|(cannot|unable to|failed to) allocate", str(error), re.IGNORECASE)
    return isinstance(error, CPLE_OutOfMemoryError) or getattr(error, "errno", None) == errno.ENOMEM or bool(message)


def _accept_no_georeferencing() -> None:
    """Add the filter if it is missing; other code, such as pytest between tests, may reset the filters."""
    with _LOCK:
        if _QUIET not in warnings.filters:
            warnings.filterwarnings("ignore", category=NotGeoreferencedWarning, module=_QUIET[3].pattern)
