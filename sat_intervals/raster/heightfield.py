"""Read a raster of reference heights in its own grid and CRS, in parts."""

import logging
import math
import re
from functools import lru_cache
from pathlib import Path

import numpy as np
from rasterio.io import DatasetReader
from rasterio.transform import Affine

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster.images import open_image, opened
from sat_intervals.raster.projection import Frame, Places, Vertical
from sat_intervals.raster.windows import read_window
from sat_intervals.tiling import Window

# Heights of the ground on Earth in metres; others are no-data values that the file does not declare.
GROUND = -600.0, 9500.0
# Names of the metre in the unit of a band, perhaps with more, as in "m above ellipsoid". Without one heights are taken
# for metres.
_METRE = re.compile(r"[\[(]?(m|met(re|er)s?|unknown)\b[^/*^\d]*|", re.IGNORECASE)
# Side of a block in cells, and blocks in memory, a megabyte each: neighbouring windows share most of theirs.
_BLOCK, _KEPT = 512, 128
# Rows and columns that are looked at for no data, the share of a value that may be it, and metres from all others.
_LOOKED = 2000
_COMMON = 0.002
_AWAY = 50.0

_LOG = logging.getLogger(__name__)


class HeightRaster:
    """The first band of a raster of heights with its scale and offset, and where its cells are."""

    def __init__(self, path: Path, crs: str | None, vertical: Vertical) -> None:
        """``crs`` replaces the CRS of the file."""
        self._image = open_image(path, band=1)
        warn_of_no_data(self._image.path)
        place = self._image.georeferencing
        with opened(self._image.path) as dataset:
            own = dataset.crs.to_wkt() if dataset.crs else None
            self._scale, self._offset = dataset.scales[0], dataset.offsets[0]
            level, unit = dataset.tags().get("HEIGHTS", ""), other_unit(dataset)
        if place.transform is None:
            raise SatIntervalsError(f"{path} has no transform from pixels to its CRS: give a georeferenced raster")
        self.frame = Frame(str(path), crs or own, vertical, level)
        if unit and self.frame.unit == 1:
            raise SatIntervalsError(
                f"{path} has heights in {unit}: convert them to metres, or correct the unit of the band"
            )
        self._to_cells: Affine = ~place.transform
        self.shape = self._image.height, self._image.width
        self.cell = math.sqrt(abs(place.transform.determinant)) * self.frame.metres  # side in metres, about
        self._block = lru_cache(_KEPT)(self._read_block)
        if min(self.shape) < 2:
            raise SatIntervalsError(f"{path} has {self.shape[0]} x {self.shape[1]} cells: give at least 2 x 2")

    def positions(self, longitude: np.ndarray, latitude: np.ndarray, height: np.ndarray) -> Places:
        """Return columns and rows (cell centres are integers) and heights of points, as in the file; see `Frame`."""
        x, y, z = self.frame.from_ellipsoid(longitude, latitude, height)
        a, b, c, d, e, f = self._to_cells[:6]
        return a * x + b * y + c - 0.5, d * x + e * y + f - 0.5, z

    def read(self, window: Window) -> np.ndarray:
        """Read a window inside the raster as float32; NaN where there is no height. Thread-safe."""
        heights = np.empty((window.height, window.width), np.float32)
        for i in range(window.row // _BLOCK, (window.row_stop - 1) // _BLOCK + 1):
            for j in range(window.column // _BLOCK, (window.column_stop - 1) // _BLOCK + 1):
                block = Window(i * _BLOCK, j * _BLOCK, _BLOCK, _BLOCK)
                common = block.clipped(window)
                heights[common.relative_to(window).slices] = self._block(i, j)[common.relative_to(block).slices]
        return heights

    def _read_block(self, i: int, j: int) -> np.ndarray:
        block = Window(i * _BLOCK, j * _BLOCK, _BLOCK, _BLOCK).clipped(Window(0, 0, *self.shape))
        pixels, state = read_window(self._image, block)
        heights = (pixels * self._scale + self._offset).astype(np.float32)
        return np.where((state == 0) & is_ground(heights * self.frame.unit), heights, np.float32(np.nan))


def is_ground(metres: np.ndarray) -> np.ndarray:
    """Return which heights the ground on Earth can have."""
    return np.asarray((metres >= GROUND[0]) & (metres <= GROUND[1]))


def warn_of_no_data(path: str | Path, window: Window | None = None) -> None:
    """Warn of a height that many cells have exactly, far from others; in a window, also of one that no ground has."""
    with opened(str(path)) as dataset:
        part = window or Window(0, 0, *dataset.shape)
        where = {"window": part.slices, "out_shape": (min(_LOOKED, part.height), min(_LOOKED, part.width))}
        heights = dataset.read(1, **where)[dataset.read_masks(1, **where) != 0]
    heights = heights[np.isfinite(heights) if window else is_ground(heights)]
    values, counts = np.unique(heights, return_counts=True)
    if values.size < 2:
        return
    value, share = values[counts.argmax()], counts.max() / heights.size
    low, high = np.quantile(heights[heights != value], (0.005, 0.995))
    away = float(max(low - value, value - high))
    if share > _COMMON and away > _AWAY:
        _LOG.warning(
            "%s: %.1f %% of its heights are exactly %.9g, %.0f m from the others: if it is no data, declare it: "
            "rio edit-info --nodata %.9g %s",
            *(path, 100 * share, value, away, value, path),
        )


def other_unit(dataset: DatasetReader) -> str | None:
    """Return the unit of the heights in the first band if it is not the metre."""
    unit = (dataset.units[0] or "").strip()
    return None if _METRE.fullmatch(unit) else unit
