"""Provide what all pictures share: page, style, maps with colour scales, histogram of widths."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import Georeferencing, new_file

try:
    from matplotlib import rc_context
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import PowerNorm
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter
except ImportError as error:
    raise SatIntervalsError("pictures need matplotlib: pip install 'sat-intervals[plot]'") from error

DPI = 110  # dots per inch
NOTHING = "#dedede"  # pixels without a value
INK = "#555555"
GROUND = "easting (m)", "northing (m)"  # axes of a map
_STRETCHED = 5.0  # largest ratio of the sides of a map; pixels of longer ones are not square
_BARS, _LEAST_SHARE = 48, 0.001  # of a histogram of widths: most bars, least share shown

_STYLE: Any = {"font.family": "DejaVu Sans", "font.size": 10, "axes.titlesize": 11, "axes.titlelocation": "left"}


class PlotFrame(NamedTuple):
    """Coordinates of a map at its left, right, bottom and top edge, and the names of its axes."""

    left: float
    right: float
    bottom: float
    top: float
    names: tuple[str, str] = ("column", "row")

    @classmethod
    def of(cls, shape: tuple[int, int]) -> "PlotFrame":
        """Return the frame of rows and columns."""
        return cls(-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5)

    @classmethod
    def on_map(cls, place: Georeferencing, shape: tuple[int, int]) -> "PlotFrame":
        """Return the frame of a north-up raster."""
        grid = place.affine
        return cls(grid.c, grid.c + shape[1] * grid.a, grid.f + shape[0] * grid.e, grid.f, GROUND)


class MapLayer(NamedTuple):
    """What a map shows, and its colour scale from ``ends[0]`` to ``ends[1]``; a power of 1/2 brightens small values."""

    title: str
    unit: str
    values: np.ndarray
    colours: str
    ends: tuple[float, float]
    power: float = 1.0
    if_empty: str = "no value"


@contextmanager
def page(target: Path, size: tuple[float, float], dpi: int, title: str, run: str = "") -> Iterator[Figure]:
    """Yield a figure of ``size`` inches and write it as PNG at the end; it notes the ``finished`` of its ``run``."""
    with rc_context(_STYLE):
        figure = Figure(size, layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left", color=INK)
        yield figure
        with new_file(target) as file:
            figure.savefig(file, dpi=dpi, format="png", metadata={"Software": "sat-intervals", "Comment": run})


def map_size(shape: tuple[int, int], longest: float) -> tuple[float, float]:
    """Return height and width in inches of a map, the longer one ``longest``."""
    tall = float(np.clip(shape[0] / shape[1], 1 / _STRETCHED, _STRETCHED))
    width = min(longest, longest / tall)
    return width * tall, width


def fitting(shape: tuple[int, int], inches: tuple[float, float], dpi: int) -> tuple[int, int]:
    """Return ``shape``, reduced to the dots of a picture of ``(height, width)`` inches."""
    rows, columns = (max(1, min(size, round(length * dpi))) for size, length in zip(shape, inches, strict=True))
    return rows, columns


def draw_map(panel: Axes, frame: PlotFrame, values: np.ndarray, title: str, **options: Any) -> AxesImage:
    """Draw values as a map with its axes; ``options`` are those of matplotlib's imshow."""
    panel.set_facecolor(NOTHING)
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_locator(MaxNLocator(4, integer=True, min_n_ticks=1))
    panel.ticklabel_format(style="plain", useOffset=False)
    panel.tick_params(labelsize=8, colors=INK)
    panel.set_xlabel(frame.names[0], fontsize=8, color=INK)
    panel.set_ylabel(frame.names[1], fontsize=8, color=INK)
    panel.set_title(title)
    ratio = abs((frame.top - frame.bottom) / (frame.right - frame.left))
    aspect: Literal["equal", "auto"] = "equal" if 1 / _STRETCHED <= ratio <= _STRETCHED else "auto"
    return panel.imshow(values, extent=frame[:4], aspect=aspect, interpolation="nearest", **options)


def draw_layer(panel: Axes, frame: PlotFrame, layer: MapLayer) -> Colorbar:
    """Draw a layer as a map with a colour bar, whose ends are pointed where values are beyond them."""
    values, ends = layer.values, layer.ends
    drawn = draw_map(panel, frame, values, layer.title, cmap=layer.colours, norm=PowerNorm(layer.power, *ends))
    say_empty(panel, values, layer.if_empty)
    assert panel.figure is not None
    beyond = bool((values < ends[0]).any()), bool((values > ends[1]).any())
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(beyond, "neither")
    bar = panel.figure.colorbar(drawn, ax=panel, extend=extend, shrink=0.9, aspect=25, pad=0.02)
    bar.set_label(layer.unit if layer.power == 1 else f"{layer.unit}, square-root scale")
    bar.ax.tick_params(labelsize=8)
    return bar


def add_histogram(bar: Colorbar, widths: np.ndarray, end: float, step: float) -> None:
    """Draw shares of interval widths from 0 to ``end``, in bins of a multiple of ``step``, along their colour bar."""
    known = widths[np.isfinite(widths)]
    if known.size == 0:
        return
    step *= np.ceil(end / step / _BARS)
    counts, edges = np.histogram(known, np.arange(0, end + 1.5 * step, step))
    side = bar.ax.inset_axes((-4.3, 0, 4.1, 1))
    shares = np.maximum(counts / known.size, _LEAST_SHARE)
    side.stairs(shares, bar.norm(edges), baseline=_LEAST_SHARE, orientation="horizontal", fill=True, color=INK)
    side.set_title("share", fontsize=8, color=INK, loc="center", pad=2)
    side.set(xscale="log", xlim=(1, _LEAST_SHARE), ylim=(0, 1), yticks=[])
    side.set_xticks([1, 0.01], ["100 %", "1 %"], fontsize=8, color=INK)
    side.set_xticks([], minor=True)
    side.spines[:].set_visible(False)
    side.patch.set_visible(False)


def add_scale_bar(panel: Axes, frame: PlotFrame) -> None:
    """Draw a bar of a round length, at most a fourth of the map, in its lower left corner."""
    width, tall = frame.right - frame.left, frame.top - frame.bottom
    decade = 10 ** np.floor(np.log10(width / 4))
    length = float(max(step * decade for step in (1, 2, 5) if step * decade <= width / 4))
    x, y = frame.left + 0.03 * width, frame.bottom + 0.03 * tall
    panel.plot([x, x + length], [y, y], color="black", lw=4, solid_capstyle="butt")
    label = panel.text(x + length / 2, y + 0.012 * tall, f"{length:g} m", ha="center", va="bottom", fontsize=9)
    label.set_bbox({"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 1})


def plain_logarithm(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers, such as 2, 5 and 10."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def say_empty(panel: Axes, values: np.ndarray, text: str) -> None:
    """Write ``text`` on a panel without finite values."""
    if not np.isfinite(values).any():
        panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", va="center", color=INK)
