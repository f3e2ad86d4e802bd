"""Resample the images of a raw pair, rows by rows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sat_intervals.heights.epipolar import MARGIN, STEP
from sat_intervals.kernels.resampling import reach, resample, resample_reduced
from sat_intervals.prepare.pair import Rows
from sat_intervals.raster import BLOCK, Image, read_window
from sat_intervals.tiling import Window, strips_of_windows

_COLUMNS = 2 * BLOCK  # columns of a tile, which is as high as a block of the files
_FAR = 4  # nodes from the image beyond which no pixel of it is between them


@dataclass(frozen=True)
class Resampled:
    """An image and the positions of its epipolar pixels, see `epipolar.Epipolar`."""

    image: Image
    nodes: np.ndarray  # (n, m, 2) rows and columns in the image, pixel centres are integers
    scale: float
    nodata: float  # of pixels without a value
    first: int = 0  # row of the first node

    def of_rows(self, rows: Window) -> "Resampled":
        """Return what some rows need."""
        first = (rows.row + MARGIN * STEP) // STEP
        last = (rows.row_stop - 1 + MARGIN * STEP) // STEP + 2
        return replace(self, nodes=self.nodes[first:last], first=first)

    def read(self, window: Window) -> np.ndarray:
        """Return a window of the epipolar image in the image's type."""
        first = window.row + (MARGIN - self.first) * STEP, window.column + MARGIN * STEP
        rows, columns = (
            slice(start // STEP, (start + size - 1) // STEP + 2)
            for start, size in zip(first, (window.height, window.width), strict=True)
        )
        around = self._around(self.nodes[rows, columns])
        if around is None:
            return np.full((window.height, window.width), self.nodata, self.image.dtype)
        pixels, state = read_window(self.image, around)
        pixels[state != 0] = np.nan
        arguments = pixels, (around.row, around.column), self.nodes, STEP, first, window.height, window.width
        values = resample(*arguments) if self.scale == 1 else resample_reduced(*arguments, self.scale)
        return stored(values, self.image.dtype, self.nodata)

    def _around(self, nodes: np.ndarray) -> Window | None:
        """Return the window of the image that is needed at positions; None if all of them are outside."""
        places = nodes[np.isfinite(nodes).all(axis=-1)]
        if not places.size:
            return None
        before, after = reach(self.scale)
        window = Window.around(places.min(axis=0) - before, places.max(axis=0) + after + 1)
        inside = window.clipped(Window(0, 0, self.image.height, self.image.width))
        return window if inside.height and inside.width else None


def nodes_near(nodes: np.ndarray, image: Image, scale: float) -> np.ndarray:
    """Return nodes, NaN where no pixel of the image is near: windows stay small, whatever a model says out there."""
    most = _FAR * STEP * scale
    inside = (nodes >= -most) & (nodes <= np.array([image.height, image.width]) + most)
    return np.where(inside.all(axis=-1, keepdims=True), nodes, np.nan)


def nodata_of(image: Image) -> float:
    """Return the no-data value of an image if its type holds it, else NaN or 0."""
    if np.dtype(image.dtype).kind == "f":
        return float("nan")
    limits = np.iinfo(image.dtype)
    return image.nodata if image.nodata is not None and limits.min <= image.nodata <= limits.max else 0.0


def stored(values: np.ndarray, dtype: str, nodata: float) -> np.ndarray:
    """Return values in a type, clipped to its range; NaN is no data, and no value is."""
    if np.dtype(dtype).kind == "f":
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    unknown = np.isnan(values)
    values = np.clip(np.rint(values), limits.min, limits.max)
    values[values == nodata] += -1 if nodata == limits.max else 1
    values[unknown] = nodata
    return values.astype(dtype)


def resampled_rows(images: Sequence[Resampled], rows: Window) -> Rows:
    """Return rows of all images, see `Pool`; runs on a worker."""
    (windows,) = strips_of_windows((rows.height, rows.width), rows.height, _COLUMNS)
    parts = [[image.read(replace(one, row=rows.row)) for one in windows] for image in images]
    return [np.concatenate(of_image, axis=1)[np.newaxis] for of_image in parts], {}
