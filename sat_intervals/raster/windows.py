"""Read any window of an image, with the states of its pixels."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rasterio.enums import Resampling

from sat_intervals.errors import InputError
from sat_intervals.kernels.resampling import Step, reduced
from sat_intervals.kernels.row_offsets import shift_rows
from sat_intervals.products import MASKED, NO_DATA
from sat_intervals.raster.images import Image, opened
from sat_intervals.tiling import View, Views, Window

# Types whose values are all exact in float32.
_FLOAT32_HOLDS = {"uint8", "int8", "uint16", "int16", "float16", "float32"}
_EXACT = 2**53  # integers up to this are exact in float64
_STRIP = 1 << 23  # pixels that are read at once to be reduced
# Shares by which floats may differ from a no-data value as people write it, the second one above the third number.
_DIGITS = {"float32": 1e-6}
_FEW_DIGITS = 1e-3
_LARGE = 1e38


def read_views(images: Iterable[Image], windows: Iterable[Window]) -> Views:
    """Read a window of each image; see `read_window`."""
    return tuple(View(window, *read_window(image, window)) for image, window in zip(images, windows, strict=True))


def read_window(image: Image, window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Read a window, perhaps outside the image, at the rows that row offsets lead to, and the states of its pixels.

    Pixels are ``(height, width)``, float32 if that is exact for the file's type, else float64; 0 where not usable.
    States are uint8: 0 = usable; bit NO_DATA = outside the image, no-data value, the file's mask or alpha, NaN or
    infinity; bit MASKED = the user's mask. Thread-safe: the file is opened each time (0.15 ms; a tile takes some ms).
    """
    if image.rows is None or 0 in (window.height, window.width):
        return _read_window(image, window)
    row, rows, *places = image.rows.read(window.row, window.column, window.height, window.width)
    pixels, state = shift_rows(*_read_window(image, Window(row, window.column, rows, window.width)), *places)
    return pixels, state


def read_reduced_views(images: Iterable[Image], windows: Iterable[Window], reductions: Iterable[int]) -> Views:
    """Read a window of each image, reduced: windows count reduced pixels; pixels that are not usable are NaN."""
    views = []
    for image, window, size in zip(images, windows, reductions, strict=True):
        place = Window(*(size * one for one in (window.row, window.column, window.height, window.width)))
        pixels = read_reduced(image, place, Step(size, size))
        views.append(View(window, pixels, np.isnan(pixels) * np.uint8(NO_DATA)))
    return tuple(views)


def read_reduced(image: Image, window: Window, step: Step) -> np.ndarray:
    """Read means of blocks of ``step`` pixels, float32, see `reduced`; in strips, since all may not fit in memory."""
    small = np.full((window.height // step.rows, window.width // step.columns), np.float32(np.nan))
    inside = window.clipped(Window(0, 0, image.height, image.width)).relative_to(window)
    first, last = inside.column // step.columns, min(small.shape[1], -(-inside.column_stop // step.columns))
    column, width = window.column + first * step.columns, max(0, last - first) * step.columns
    rows = max(1, _STRIP // (step.rows * max(1, width)))
    for row in range(inside.row // step.rows, min(len(small), -(-inside.row_stop // step.rows)), rows):
        part = small[row : row + rows, first:last]
        strip = Window(window.row + row * step.rows, column, len(part) * step.rows, width)
        part[:] = reduced(*read_window(image, strip), step)
    return small


def _read_window(image: Image, window: Window) -> tuple[np.ndarray, np.ndarray]:
    inside = window.clipped(Window(0, 0, image.height, image.width))
    pixels = np.zeros((window.height, window.width), _pixel_type(image))
    state = np.full(pixels.shape, NO_DATA, np.uint8)
    if inside.height and inside.width:
        place = inside.relative_to(window).slices
        values, state[place] = read_inside(image, inside)
        _check_exact(image.path, values, state[place] == 0)
        unusable = state[place] != 0
        with np.errstate(over="ignore", invalid="ignore"):
            pixels[place] = values
        if unusable.any():
            pixels[place][unusable] = 0
    return pixels, state


def _pixel_type(image: Image) -> type[np.floating[Any]]:
    return np.float32 if image.dtype in _FLOAT32_HOLDS else np.float64


@dataclass(frozen=True)
class Layer:
    """A raster as large as a run's region or its left image, read by windows of the region."""

    image: Image
    row: int
    column: int

    def read(self, window: Window) -> np.ndarray:
        """Read a window of the region as floats, NaN where no data."""
        place = Window(self.row + window.row, self.column + window.column, window.height, window.width)
        pixels, state = read_window(self.image, place)
        return np.where(state == 0, pixels, np.nan)


def kept_view(image: Image, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of a view, in the file's type if that holds them, and the states, empty if all are usable."""
    held = view.pixels.astype(image.dtype) if image.rows is None else view.pixels
    return held, view.state if view.state.any() else view.state[:0]


def restored_view(image: Image, window: Window, pixels: np.ndarray, state: np.ndarray) -> View:
    """Return the view of a window that `kept_view` took apart."""
    return View(window, pixels.astype(_pixel_type(image)), state if state.size else np.zeros(pixels.shape, np.uint8))


def _check_exact(path: str, values: np.ndarray, usable: np.ndarray) -> None:
    """Raise if integers are not exact in float64."""
    if values.dtype.kind in "iu" and values.dtype.itemsize == 8:
        large = usable & ((values > _EXACT) | (values < -_EXACT if values.dtype.kind == "i" else False))
        if large.any():
            raise InputError(
                f"{path} has {values.dtype} values such as {values[large][0]}, beyond 2^53, which are not exact as "
                "float64: subtract an offset, or give their no-data value"
            )


def read_inside(image: Image, window: Window, shape: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Read values, in the file's type, and states of a window inside the image, sampled to ``shape`` if given."""
    area = window.slices
    with opened(image.path, window) as dataset:
        values = dataset.read(image.band, window=area, out_shape=shape)
        usable = np.isfinite(values) & _differs(values, image.nodata)
        # GDAL's mask of a band uses only the first of mask, no-data value and alpha: combine them here.
        if image.use_mask:
            usable &= dataset.read_masks(image.band, window=area, out_shape=shape) != 0
        if image.alpha is not None:
            usable &= dataset.read(image.alpha, window=area, out_shape=shape) != 0
    state = ~usable * np.uint8(NO_DATA)
    if image.mask is not None:
        with opened(image.mask, window) as dataset:
            state[dataset.read(1, window=area, out_shape=shape) != 0] |= MASKED
    return values, state


def _differs(values: np.ndarray, nodata: float | None) -> np.ndarray:
    """Return where values differ from the no-data value; uint8 never equals 300."""
    # A float32 may differ by what seven written digits leave out, and any float by more near the largest ones.
    if nodata is None:
        return np.ones(values.shape, bool)
    with np.errstate(over="ignore", invalid="ignore"):
        if values.dtype.kind == "f" and np.isfinite(nodata):
            share = _FEW_DIGITS if abs(nodata) > _LARGE else _DIGITS.get(values.dtype.name, 0.0)
            near = share * abs(nodata)
            return ~((values >= nodata - near) & (values <= nodata + near))
        stored = np.asarray(nodata).astype(values.dtype)
    held = values.dtype.kind == "f" or stored == nodata
    return np.asarray(values != stored) if held else np.ones(values.shape, bool)


def read_small_layers(path: str | os.PathLike[str], shape: tuple[int, int]) -> np.ndarray:
    """Read all bands of a file as ``(bands, *shape)`` in the file's type, by nearest neighbour, through overviews."""
    with opened(str(path)) as dataset:
        return np.asarray(dataset.read(out_shape=(dataset.count, *shape)))


def read_small_image(image: Image, window: Window, shape: tuple[int, int]) -> np.ndarray:
    """Read a window inside an image as ``shape`` pixels, averaged, through overviews; NaN where not usable."""
    _, state = read_inside(image, window, shape)
    with opened(image.path, window) as dataset:
        means = dataset.read(image.band, window=window.slices, out_shape=shape, resampling=Resampling.average)
    return np.where(state == 0, means, np.nan)
