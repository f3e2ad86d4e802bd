"""Draw a surface model: hillshade, height, interval width, confidence."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import PowerNorm
from matplotlib.ticker import MaxNLocator

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import SURFACE
from sat_intervals.raster import Georeferencing, is_surface, read_place, read_small_layers, read_tags
from sat_intervals.show.canvas import (
    DPI,
    INK,
    NOTHING,
    add_histogram,
    fitting,
    limits,
    page,
    pointed_ends,
    say_empty,
)

_LONGEST = 5.5  # inches of the longer side of a map
_STRETCHED = 5.0  # largest ratio of the sides of a map
_SUN = np.array([-0.5, 0.5, np.sqrt(0.5)])  # direction to the sun (east, north, up): north-west, 45 degrees high
_FLATTENED = 0.3  # factor on heights before slopes: noise of 0.1 m is steep between cells of 0.5 m
_NO_DATA = "#a8c4dd"
# Percentile of half widths at the end of their scale, which is at most so many times their median: a strip of wide
# intervals then leaves the others their colours.
_MOST, _TIMES = 98, 12
_BAND = {band.name: index for index, band in enumerate(SURFACE)}


def draw_surface(surface: Path, target: Path, dpi: int = DPI) -> None:
    """Draw hillshade, height, interval width and confidence, or agreement of runs, from the overviews."""
    shape, place = read_place(surface)
    if not is_surface(surface):
        raise SatIntervalsError(f"{surface} is not a surface model of sat-intervals dsm: move it or make it again")
    assert place.transform is not None
    assert place.pixel_size is not None
    tall = float(np.clip(shape[0] / shape[1], 1 / _STRETCHED, _STRETCHED))
    width = min(_LONGEST, _LONGEST / tall)
    inches = width * tall, width
    drawn = fitting(shape, inches, dpi)
    bands = read_small_layers(surface, drawn)
    height = bands[_BAND["height"]].astype(np.float64)
    halves = (bands[_BAND["height_upper"]] - bands[_BAND["height_lower"]]) / 2
    agreement = bands[_BAND["agreement"]]
    across, down = (
        size * whole / part for size, whole, part in zip(place.pixel_size, shape[::-1], drawn[::-1], strict=True)
    )
    relief = _relief(height, across, down)
    left, top = place.transform.c, place.transform.f
    extent = (left, left + shape[1] * place.pixel_size[0], top - shape[0] * place.pixel_size[1], top)
    last = ("Agreement of runs", "1 where intervals overlap", agreement)
    if not np.isfinite(agreement).any():
        last = ("Confidence", "0 to 1", bands[_BAND["confidence"]])
    step = "" if drawn == shape else f", {drawn[0]} x {drawn[1]} of them drawn"
    caption = (
        f"{surface.name}: {shape[0]} x {shape[1]} cells of {place.pixel_size[0]:g} m{step}, "
        f"{_figures(height, halves)}\n{_frame(surface, place)}"
    )
    with page(target, (2 * (inches[1] + 1.4), 2 * (inches[0] + 0.7) + 0.3), dpi, caption) as figure:
        panels = figure.subplots(2, 2).ravel()
        _draw(panels[0], extent, relief, ("Hillshade, sun in the north-west; blue: no data", ""), "gray", (0, 1))
        panels[0].set_facecolor(_NO_DATA)  # flat ground is grey too
        _draw(panels[1], extent, height, ("Height", "m"), "viridis", limits(height, (0, 1)))
        name = "Half width of the interval", "m, square-root scale"
        end = _end_of_scale(halves)
        bar = _draw(panels[2], extent, halves, name, "magma", (0, end), 0.5)
        assert bar
        add_histogram(bar, halves, end, step=end / 40)
        _draw(panels[3], extent, last[2], last[:2], "cividis", (0, 1))


def _figures(height: np.ndarray, halves: np.ndarray) -> str:
    """Return filled share and median half width for the caption."""
    filled = f"{100 * np.isfinite(height).mean():.1f} % filled"
    known = halves[np.isfinite(halves)]
    return f"{filled}, median +-{np.median(known):.2f} m" if known.size else filled


def _frame(surface: Path, place: Georeferencing) -> str:
    """Return the CRS and what heights refer to."""
    assert place.crs is not None
    code = place.crs.to_epsg()
    return f"{f'EPSG:{code}' if code else place.crs.to_string()[:60]}, heights {read_tags(surface).get('HEIGHTS', '')}"


def _end_of_scale(halves: np.ndarray) -> float:
    """Return the end of the scale of half widths in metres; 1 without any."""
    known = halves[np.isfinite(halves)]
    if not known.size:
        return 1.0
    middle, most = np.percentile(known, (50, _MOST))
    return float(min(most, _TIMES * middle)) or 1.0


def _relief(height: np.ndarray, across: float, down: float) -> np.ndarray:
    """Return the hillshade, 0 to 1, NaN beside holes, by central differences; cells of ``across`` x ``down`` m."""
    if min(height.shape) < 2:
        return np.full(height.shape, np.nan)
    down_slope, across_slope = np.gradient(_FLATTENED * height, down, across)
    normal = np.stack([-across_slope, down_slope, np.ones_like(height)])
    return np.asarray(np.tensordot(_SUN, normal / np.linalg.norm(normal, axis=0), axes=1).clip(0, 1))


def _draw(
    panel: Axes,
    extent: tuple[float, float, float, float],
    values: np.ndarray,
    name: tuple[str, str],
    colours: str,
    shown: tuple[float, float],
    power: float = 1.0,
) -> Colorbar | None:
    """Draw a layer in map coordinates, titled ``name[0]``; with a colour bar if there is a unit, ``name[1]``."""
    panel.set_facecolor(NOTHING)
    drawn = panel.imshow(values, extent=extent, cmap=colours, norm=PowerNorm(power, *shown), interpolation="nearest")
    panel.set_title(name[0])
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_locator(MaxNLocator(3))
    panel.ticklabel_format(style="plain", useOffset=False)
    panel.tick_params(labelsize=8, colors=INK)
    panel.set_xlabel("easting (m)", fontsize=8, color=INK)
    panel.set_ylabel("northing (m)", fontsize=8, color=INK)
    say_empty(panel, values, "no value")
    if not name[1]:
        return None
    assert panel.figure is not None
    bar = panel.figure.colorbar(drawn, ax=panel, extend=pointed_ends(values, *shown), shrink=0.9, aspect=25, pad=0.02)
    bar.set_label(name[1])
    bar.ax.tick_params(labelsize=8)
    return bar
