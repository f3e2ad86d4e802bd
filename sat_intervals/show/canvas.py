"""Provide what all pictures share: page, style, colours, value ranges, histogram of widths."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster.publishing import new_file

try:
    from matplotlib import rc_context
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.colorbar import Colorbar
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
except ImportError as error:
    raise SatIntervalsError("pictures need matplotlib: pip install 'sat-intervals[plot]'") from error

DPI = 110  # dots per inch
NOTHING = "#dedede"  # pixels without a value
INK = "#555555"
_WIDEST = 90  # percentile of widths at the end of their scale: low-confidence areas are often as wide as the range
_BARS, _LEAST_SHARE = 48, 0.001  # of a histogram of widths: most bars, least share shown

_STYLE: Any = {"font.family": "DejaVu Sans", "font.size": 10, "axes.titlesize": 11, "axes.titlelocation": "left"}


@contextmanager
def page(target: Path, size: tuple[float, float], dpi: int, title: str, run: str = "") -> Iterator[Figure]:
    """Yield a figure of ``size`` inches and write it as PNG at the end; it notes the ``finished`` of its ``run``."""
    with rc_context(_STYLE):
        figure = Figure(size, layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left", color=INK)
        yield figure
        with new_file(target) as file:
            figure.savefig(file, dpi=dpi, format="png", metadata={"Software": "sat-intervals", "Comment": run})


def fitting(shape: tuple[int, int], inches: tuple[float, float], dpi: int) -> tuple[int, int]:
    """Return ``shape``, reduced to the dots of a picture of ``(height, width)`` inches."""
    rows, columns = (max(1, min(size, round(length * dpi))) for size, length in zip(shape, inches, strict=True))
    return rows, columns


def limits(values: np.ndarray, otherwise: tuple[float, float]) -> tuple[float, float]:
    """Return percentiles 1 and 99 of the finite values; ``otherwise`` if there are none."""
    known = values[np.isfinite(values)]
    if known.size == 0:
        return otherwise
    low, high = np.percentile(known, (1, 99), method="nearest")
    return (float(low), float(high)) if low < high else (float(low) - 0.5, float(high) + 0.5)


def widest(widths: np.ndarray) -> float:
    """Return the end of the colour scale of interval widths, a percentile of the finite ones; 1 if there are none."""
    known = widths[np.isfinite(widths)]
    return (float(np.percentile(known, _WIDEST, method="nearest")) if known.size else 0.0) or 1.0


def pointed_ends(values: np.ndarray, low: float, high: float) -> str:
    """Return matplotlib's ``extend``: a pointed end of a colour bar means values beyond it."""
    beyond = bool((values < low).any()), bool((values > high).any())
    return {(True, True): "both", (True, False): "min", (False, True): "max"}.get(beyond, "neither")


def add_histogram(bar: Colorbar, widths: np.ndarray, end: float, step: float) -> None:
    """Draw the histogram of interval widths, from 0 to ``end``, along the left side of their colour bar.

    Its bins are a multiple of ``step`` wide, its shares of the finite widths are on a logarithmic scale.
    """
    known = widths[np.isfinite(widths)]
    if known.size == 0:
        return
    step *= np.ceil(end / step / _BARS)
    counts, edges = np.histogram(known, np.arange(0, end + 1.5 * step, step))
    side = bar.ax.inset_axes((-4.3, 0, 4.1, 1))
    shares = np.maximum(counts / known.size, _LEAST_SHARE)
    side.stairs(shares, bar.norm(edges), baseline=_LEAST_SHARE, orientation="horizontal", fill=True, color=INK)
    side.set(xscale="log", xlim=(1, _LEAST_SHARE), ylim=(0, 1), yticks=[])
    side.set_xticks([1, 0.01], ["100 %", "1 %"], fontsize=8, color=INK)
    side.set_xticks([], minor=True)
    side.spines[:].set_visible(False)
    side.patch.set_visible(False)


def plain_logarithm(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers, such as 2, 5 and 10."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def say_empty(panel: Axes, values: np.ndarray, text: str) -> None:
    """Write ``text`` on a panel without finite values."""
    if not np.isfinite(values).any():
        panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", va="center", color=INK)
