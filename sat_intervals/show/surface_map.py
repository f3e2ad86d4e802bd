"""Draw a surface model: hillshade, height, interval width, confidence."""

from pathlib import Path

import numpy as np

from sat_intervals.products import SURFACE
from sat_intervals.raster import read_small_layers, read_tags, surface_place
from sat_intervals.show import canvas
from sat_intervals.show.legend import limits
from sat_intervals.show.relief import relief

_LONGEST = 5.5  # inches of the longer side of a map
_NO_DATA = "#a8c4dd"
# Percentile of half widths at the end of their scale, which is at most so many times their median: a strip of wide
# intervals then leaves the others their colours.
_MOST, _TIMES = 98, 12


def draw_surface(surface: Path, target: Path, dpi: int = canvas.DPI) -> None:
    """Draw hillshade, height, interval width and confidence, or agreement of runs, from the overviews."""
    shape, place = surface_place(surface)
    assert place.crs is not None
    inches = canvas.map_size(shape, _LONGEST)
    drawn = canvas.fitting(shape, inches, dpi)
    bands = dict(zip((band.name for band in SURFACE), read_small_layers(surface, drawn), strict=True))
    height = bands["height"].astype(np.float64)
    halves = (bands["height_upper"] - bands["height_lower"]) / 2
    across, down = place.pixel_size[0] * shape[1] / drawn[1], place.pixel_size[1] * shape[0] / drawn[0]
    left, top = place.affine.c, place.affine.f
    ends = left + shape[1] * place.pixel_size[0], top - shape[0] * place.pixel_size[1]
    frame = canvas.PlotFrame(left, *ends, top, canvas.GROUND)
    middle, end = _middle_and_end(halves)
    layers = [
        canvas.MapLayer("Height", "m", height, "viridis", limits(height)),
        canvas.MapLayer("Half width of the interval", "m", halves, "magma", (0, end), 0.5),
        canvas.MapLayer("Agreement of runs", "1 where intervals overlap", bands["agreement"], "cividis", (0, 1)),
    ]
    if not np.isfinite(bands["agreement"]).any():
        layers[2] = canvas.MapLayer("Confidence", "0 to 1", bands["confidence"], "cividis", (0, 1))
    layers = [layer for layer in layers if np.isfinite(layer.values).any()]
    step = "" if drawn == shape else f", {drawn[0]} x {drawn[1]} of them drawn"
    filled = f"{100 * np.isfinite(height).mean():.1f} % filled"
    code = place.crs.to_epsg()
    caption = (
        f"{surface.name}: {shape[0]} x {shape[1]} cells of {place.pixel_size[0]:g} m{step}, {filled}{middle}\n"
        f"{f'EPSG:{code}' if code else place.crs.to_string()[:60]}, heights {read_tags(surface).get('HEIGHTS', '')}"
    )
    with canvas.page(target, (2 * (inches[1] + 1.4), 2 * (inches[0] + 0.7) + 0.3), dpi, caption) as figure:
        first, *panels = figure.subplots(2, 2).ravel()
        shade = relief(height, across, down)
        canvas.draw_map(
            first, frame, shade, "Hillshade, sun in the north-west; blue: no data", cmap="gray", vmin=0, vmax=1
        )
        canvas.say_empty(first, shade, "no value")
        first.set_facecolor(_NO_DATA)  # flat ground is grey too
        for panel, layer in zip(panels, layers, strict=False):
            bar = canvas.draw_layer(panel, frame, layer)
            if layer.values is halves:
                canvas.add_histogram(bar, halves, end, step=end / 40)
        for panel in panels[len(layers) :]:
            panel.remove()


def _middle_and_end(halves: np.ndarray) -> tuple[str, float]:
    """Return the median of half widths for the caption, and the end of their scale in metres; 1 without any."""
    known = halves[np.isfinite(halves)]
    if not known.size:
        return "", 1.0
    middle, most = np.percentile(known, (50, _MOST))
    return f", median +-{middle:.2f} m", float(min(most, _TIMES * middle)) or 1.0
