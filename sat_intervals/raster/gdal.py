"""What every use of GDAL here needs: an image without georeferencing taken as it is, and errors in one line."""

import errno
import re
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from rasterio import Env
from rasterio._err import CPLE_BaseError, CPLE_OutOfMemoryError
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetReader, DatasetWriter

# rasterio.shutil.copy lets the last two through; SystemError is its word for a failure that GDAL does not explain.
GDAL_ERRORS = (RasterioError, CPLE_BaseError, SystemError)

# rasterio warns whenever it opens an image without georeferencing, which an epipolar image may well be. Datasets are
# opened by their classes, not by rasterio.open, so that the warning counts as given in this package: the filter is
# for this package alone. `warnings.catch_warnings` would not do: threads that use it undo each other's filters.
_QUIET = ("ignore", None, NotGeoreferencedWarning, re.compile(re.escape(__name__)), 0)
_LOCK = threading.Lock()


@contextmanager
def reading(path: str, **options: Any) -> Iterator[DatasetReader]:
    """A raster open for reading; from any thread."""
    _accept_no_georeferencing()
    # rasterio casts the no-data value to see whether the type holds it: -1.8e308, of ArcGIS, is no float32
    with Env(), np.errstate(over="ignore"), DatasetReader(path, **options) as dataset:
        yield dataset


def create(path: str, **options: Any) -> DatasetWriter:
    """A new GeoTIFF; to be called inside a `rasterio.Env`."""
    _accept_no_georeferencing()
    return DatasetWriter(path, "w", driver="GTiff", **options)


def reason(error: BaseException) -> str:
    """What GDAL said first of a failure, in one line."""
    while error.__cause__ is not None:
        error = error.__cause__
    return "GDAL names no cause" if isinstance(error, SystemError) else " ".join(str(error).split())


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an allocation failed, by the first cause of an error."""
    while error.__cause__ is not None:
        error = error.__cause__
    is_told = re.search("out of memory|(cannot|unable to|failed to) allocate", str(error), re.IGNORECASE)
    return isinstance(error, CPLE_OutOfMemoryError) or getattr(error, "errno", None) == errno.ENOMEM or bool(is_told)


def _accept_no_georeferencing() -> None:
    """Set the filter where it is missing: others, such as pytest between tests, restore the filters they knew."""
    with _LOCK:
        if _QUIET not in warnings.filters:
            warnings.filterwarnings("ignore", category=NotGeoreferencedWarning, module=_QUIET[3].pattern)
