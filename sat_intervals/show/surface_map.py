"""Draw a surface model: hillshade, height, interval width, confidence."""

from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.products import SURFACE
from sat_intervals.raster import read_place, read_small_layers, read_tags, surface_place
from sat_intervals.show import canvas
from sat_intervals.show.legend import limits, widest
from sat_intervals.show.relief import relief

_LONGEST = 11.0  # inches of the longer side of the hillshade, of which titles and labels take a part
_SHOWN = 10.0  # inches of it at least
_SMALL = 2.8  # times that other maps are smaller
_WIDE = 1.4  # ratio of the sides of a surface from which they are below the hillshade, not beside it
_MOST_CELLS = 2000  # along a side, that have a pixel each
# Percent of half widths beyond the end of their scale, which is at most so many times their median: a strip of wide
# intervals then leaves the others their colours.
_MOST, _TIMES = 2, 12


def draw_surface(surface: Path, target: Path, dpi: int = canvas.DPI) -> None:
    """Draw the hillshade with a pixel a cell, and small height, interval width, confidence or agreement of runs."""
    shape, place = surface_place(surface)
    assert place.crs is not None
    drawn = canvas.fitting(shape, canvas.map_size(shape, 1.0), _MOST_CELLS)
    bands = dict(zip((band.name for band in SURFACE), read_small_layers(surface, drawn), strict=True))
    height = bands["height"].astype(np.float64)
    halves = (bands["height_upper"] - bands["height_lower"]) / 2
    across, down = place.pixel_size[0] * shape[1] / drawn[1], place.pixel_size[1] * shape[0] / drawn[0]
    frame = canvas.PlotFrame.on_map(place, shape)
    end, made = widest(halves, _MOST, _TIMES), bands["count"] == 0
    layers = _layers(height, halves, bands, end)
    step = "" if drawn == shape else f", {drawn[0]} x {drawn[1]} of them drawn"
    shares = f"{100 * np.isfinite(height).mean():.1f} % with a height"
    shares += (
        f", of these {100 * made.sum() / np.isfinite(height).sum():.1f} % filled or flattened" if made.any() else ""
    )
    middle = f", median +-{np.nanmedian(halves):.2f} m" if np.isfinite(halves).any() else ""
    code = place.crs.to_epsg()
    caption = (
        f"{surface.name}: {shape[0]} x {shape[1]} cells of {place.pixel_size[0]:g} m{step}, {shares}{middle}\n"
        f"{f'EPSG:{code}' if code else place.crs.to_string()[:60]}, heights {read_tags(surface).get('HEIGHTS', '')}"
    )
    size, arranged = _arrangement(shape)
    dots = max(dpi, -(-max(drawn) // _SHOWN))
    with canvas.page(target, size, int(dots), caption) as figure:
        first, *panels = figure.subplot_mosaic(**arranged).values()
        shade = relief(height, across, down)
        canvas.draw_map(
            first, frame, shade, "Hillshade, sun in the north-west; hatched: no data", cmap="gray", vmin=0, vmax=1
        )
        canvas.say_empty(first, shade, "no value")
        canvas.add_scale_bar(first, frame)
        for panel, layer in zip(panels, layers, strict=False):
            bar = canvas.draw_layer(panel, frame, layer)
            if layer.values is halves:
                canvas.add_histogram(bar, halves, end, step=end / 40)
        for panel in (first, *panels[: len(layers)]):
            panel.patch.set(facecolor="white", hatch="////", edgecolor=canvas.NOTHING, linewidth=0)
        for panel in panels[len(layers) :]:
            panel.remove()


def draw_ortho(ortho: Path, target: Path, dpi: int = canvas.DPI) -> None:
    """Draw the first band of an ortho-image with a pixel a cell."""
    shape, place = read_place(ortho)
    grey = read_small_layers(ortho, canvas.fitting(shape, canvas.map_size(shape, 1.0), _MOST_CELLS))[0]
    (tall, wide), (low, high) = canvas.map_size(shape, _LONGEST), limits(grey)
    frame, dots = canvas.PlotFrame.on_map(place, shape), max(dpi, -(-max(grey.shape) // _SHOWN))
    with canvas.page(target, (wide + 0.8, tall + 1.0), int(dots), ortho.name) as figure:
        panel = figure.subplots()
        canvas.draw_map(panel, frame, grey, "Image on the surface; grey: no data", cmap="gray", vmin=low, vmax=high)
        canvas.add_scale_bar(panel, frame)


def _layers(height: np.ndarray, halves: np.ndarray, bands: dict[str, np.ndarray], end: float) -> list[canvas.MapLayer]:
    """Return the small maps that have values; half widths have colours up to ``end``."""
    layers = [
        canvas.MapLayer("Height", "m", height, "viridis", limits(height)),
        canvas.MapLayer("Half width of the interval", "m", halves, "magma", (0, end), 0.5),
        canvas.MapLayer("Agreement of runs", "1 where intervals overlap", bands["agreement"], "cividis", (0, 1)),
    ]
    if not np.isfinite(bands["agreement"]).any():
        layers[2] = canvas.MapLayer("Confidence", "0 to 1", bands["confidence"], "cividis", (0, 1))
    return [layer for layer in layers if np.isfinite(layer.values).any()]


def _arrangement(shape: tuple[int, int]) -> tuple[tuple[float, float], dict[str, Any]]:
    """Return width and height of the page in inches, and where hillshade and small maps are."""
    tall, wide = canvas.map_size(shape, _LONGEST)
    if wide > _WIDE * tall:
        below = tall / _SMALL + 1.2
        mosaic = [["shade"] * 3, ["height", "half", "last"]]
        return (wide + 0.8, tall + below + 1.2), {"mosaic": mosaic, "height_ratios": (tall, below)}
    rows = [["shade", name] for name in ("height", "half", "last")]
    small = wide / _SMALL + 2.6  # with its colour bar
    return (wide + small + 1.3, tall + 1.2), {"mosaic": rows, "width_ratios": (wide + 0.9, small)}
