"""Pixels in: any window of an image, with the states of its pixels."""

import numpy as np
from rasterio.windows import Window as RasterioWindow

from sat_intervals.products import MASKED, NO_DATA
from sat_intervals.raster.images import Image, InputError, opened
from sat_intervals.tiling import Window

# Types whose every value is a float32.
_FLOAT32_HOLDS = {"uint8", "int8", "uint16", "int16", "float16", "float32"}
# Integers up to this are floats of 64 bits.
_EXACT = 2**53


def read_window(image: Image, window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of a window, which may lie partly or wholly outside the image, and what they are good for.

    Any thread or process may call it: the file is opened each time (0.15 ms, against some ms for the pixels of a tile).

    Returns
    -------
    pixels
        ``(height, width)``, float32 where that holds every value of the file's type, else float64; 0 where not usable.
    state
        ``(height, width)`` uint8: 0 = usable; bit NO_DATA = outside the image, no-data value, the file's mask or alpha,
        NaN or infinity; bit MASKED = the user's mask.

    Raises
    ------
    InputError
        Pixels that cannot be read, as in a file cut short; it names the file and the rows and columns.
    """
    inside = window.clipped(Window(0, 0, image.height, image.width))
    pixels = np.zeros((window.height, window.width), np.float32 if image.dtype in _FLOAT32_HOLDS else np.float64)
    state = np.full(pixels.shape, NO_DATA, np.uint8)
    if inside.height and inside.width:
        place = inside.relative_to(window).slices
        values, state[place] = read_inside(image, inside)
        _check_exact(image.path, values, state[place] == 0)
        np.copyto(pixels[place], values, where=state[place] == 0)
    return pixels, state


def _check_exact(path: str, values: np.ndarray, usable: np.ndarray) -> None:
    """Refuse integers of which float64 would make one what are several."""
    if values.dtype.kind in "iu" and values.dtype.itemsize == 8:
        large = usable & ((values > _EXACT) | (values < -_EXACT if values.dtype.kind == "i" else False))
        if large.any():
            raise InputError(
                f"{path} has {values.dtype} values such as {values[large][0]}, beyond 2^53, which lose their texture "
                "as float64: subtract an offset, or give their no-data value"
            )


def read_inside(image: Image, window: Window, shape: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Values in the file's type, and states, of a window that lies inside the image; with ``shape`` so many picked."""
    area = RasterioWindow(window.column, window.row, window.width, window.height)
    with opened(image.path, window) as dataset:
        values = dataset.read(image.band, window=area, out_shape=shape)
        usable = np.isfinite(values) & _differs(values, image.nodata)
        # Asked for one by one, since GDAL's mask of a band is but the first there is of: mask, no-data value, alpha.
        if image.use_mask:
            usable &= dataset.read_masks(image.band, window=area, out_shape=shape) != 0
        if image.alpha is not None:
            usable &= dataset.read(image.alpha, window=area, out_shape=shape) != 0
    state = np.where(usable, 0, NO_DATA).astype(np.uint8)
    if image.mask is not None:
        with opened(image.mask, window) as dataset:
            state[dataset.read(1, window=area, out_shape=shape) != 0] |= MASKED
    return values, state


def _differs(values: np.ndarray, nodata: float | None) -> np.ndarray:
    """Where values are not the no-data value as their type holds it: 0.1 is no float32, and 300 no uint8 at all."""
    if nodata is None:
        return np.ones(values.shape, bool)
    with np.errstate(over="ignore", invalid="ignore"):
        stored = np.asarray(nodata).astype(values.dtype)
    held = values.dtype.kind == "f" or stored == nodata
    return np.asarray(values != stored) if held else np.ones(values.shape, bool)
