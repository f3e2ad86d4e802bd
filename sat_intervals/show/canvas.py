"""What all pictures share: the page, its style and colours, the range of a map, the words on an empty one.

Every picture imports it, so it is here that matplotlib, the extra ``plot``, is found missing.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import whole_file

try:
    from matplotlib import rc_context
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError as error:
    raise SatIntervalsError("pictures need matplotlib: pip install 'sat-intervals[plot]'") from error

DPI = 110  # dots an inch
NOTHING = "#dedede"  # where there is no value
INK = "#555555"

_STYLE: Any = {"font.family": "DejaVu Sans", "font.size": 10, "axes.titlesize": 11, "axes.titlelocation": "left"}


@contextmanager
def page(path: Path, size: tuple[float, float], dpi: int, title: str) -> Iterator[Figure]:
    """A figure of ``size`` inches that becomes a PNG file at the end."""
    with rc_context(_STYLE):
        figure = Figure(size, layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left", color=INK)
        yield figure
        try:
            with whole_file(path) as new:
                figure.savefig(new, dpi=dpi, format="png", metadata={"Software": "sat-intervals"})
        except OSError as error:
            reason = error.strerror or error
            raise SatIntervalsError(f"{path} cannot be written: {reason}: make room or check its rights") from error


def fitting(shape: tuple[int, int], inches: tuple[float, float], dpi: int) -> tuple[int, int]:
    """Rows and columns of so many pixels that a picture, ``(height, width)`` inches, has the dots for."""
    rows, columns = (max(1, min(size, round(length * dpi))) for size, length in zip(shape, inches, strict=True))
    return rows, columns


def limits(values: np.ndarray, otherwise: tuple[float, float]) -> tuple[float, float]:
    """The range of all but the outermost hundredths of the values."""
    known = values[np.isfinite(values)]
    if known.size == 0:
        return otherwise
    low, high = np.percentile(known, (1, 99), method="nearest")
    return (float(low), float(high)) if low < high else (float(low) - 0.5, float(high) + 0.5)


def say_empty(panel: Axes, values: np.ndarray, text: str) -> None:
    """Tell in words why a panel is empty."""
    if not np.isfinite(values).any():
        panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", va="center", color=INK)
