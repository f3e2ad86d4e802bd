"""Gather figures and maps of the surface model of a run."""

import base64
from typing import Any

import numpy as np

from sat_intervals.raster import read_place, read_small_layers
from sat_intervals.raster.layers import png_of
from sat_intervals.results import Results
from sat_intervals.show.legend import widest
from sat_intervals.show.relief import relief
from sat_intervals.show.styles import CUT, MAGMA

_CELLS = 1000  # rows and columns of a surface that are read


def surface_of(results: Results) -> dict[str, Any] | None:
    """Return figures of the surface model of a run, metres and shares from its overviews, and maps; None without."""
    if not results.has_current("dsm.tif"):
        return None
    (rows, columns), place = read_place(results.out / "dsm.tif")
    reduction = max(1, max(rows, columns) // _CELLS)
    small = -(-rows // reduction), -(-columns // reduction)
    height, lower, upper = read_small_layers(results.out / "dsm.tif", small)[:3].astype(np.float64)
    known, half = np.isfinite(height), (upper - lower) / 2
    low, middle, high = np.percentile(height[known], (2, 50, 98)) if known.any() else [float("nan")] * 3
    figures = {
        "surface model": f"{rows} x {columns} cells of {place.pixel_size[0]:g} m",
        "completeness, cells with a height": f"{100 * known.mean():.1f} %",
        "heights, 2 %, median, 98 %": f"{low:.2f}, {middle:.2f}, {high:.2f} m",
    }
    across, down = place.pixel_size[0] * columns / small[1], place.pixel_size[1] * rows / small[0]
    grey = 255 * relief(height, across, down)[..., np.newaxis]
    maps = [{"title": "Hillshade, sun in the north-west; hatched: no data", "png": _png(grey), "ramp": [], "ends": []}]
    if (halves := half[np.isfinite(half)]).size:
        median, most = np.percentile(halves, (50, 90))
        figures["half widths of intervals, median and 90 %"] = f"{median:.2f} m, {most:.2f} m"
        end = widest(half, CUT)
        ends = ["0 m", f"{end:.2g} m or more (square-root scale)"]
        png = _png(_coloured(np.sqrt(half / end)))
        maps.append({"title": "Half width of the intervals", "png": png, "ramp": MAGMA, "ends": ends})
    return {"figures": figures, "maps": maps}


def _coloured(shares: np.ndarray) -> np.ndarray:
    """Return ``(rows, columns, 3)`` colours, NaN where unknown, of values from 0 to 1."""
    ramp = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in MAGMA], float)
    places = np.linspace(0, 1, len(ramp))
    return np.stack([np.interp(shares, places, band) for band in ramp.T], axis=-1)


def _png(colours: np.ndarray) -> str:
    """Return a picture of grey or colours, ``(rows, columns, bands)`` up to 255, transparent where NaN, as base64."""
    known = np.isfinite(colours).all(axis=-1, keepdims=True)
    pixels = np.concatenate([np.where(known, colours, 0), 255 * known], axis=-1).round().astype(np.uint8)
    return base64.b64encode(png_of(np.moveaxis(pixels, -1, 0))).decode()
