"""Intervals of a surface model against reference heights, strip by strip, whatever the size."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.figures import Histogram
from sat_intervals.raster import Georeferencing, read_heights, read_layers, read_place
from sat_intervals.tiling import Window

_ROWS = 512
# Ends of classes: degrees of the reference's slope, metres of the interval's width.
SLOPES = (0.0, 5.0, 15.0, 30.0, 45.0, 90.0)
WIDTHS = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, np.inf)
# Errors and widths are counted in centimetres within so many metres.
_LARGEST = 500
# NMAD, the robust standard deviation: of a normal distribution it is sigma (Hoehle and Hoehle 2009).
_NORMAL = 1.4826


class _Class:
    """Figures of some cells."""

    def __init__(self) -> None:
        self._count = self._inside = 0
        self._errors, self._widths = Histogram(-_LARGEST, _LARGEST, 100), Histogram(0, _LARGEST, 100)

    def add(self, error: np.ndarray, width: np.ndarray, inside: np.ndarray) -> None:
        self._count += error.size
        self._inside += int(inside.sum())
        self._errors.add(error)
        self._widths.add(width)

    def report(self) -> dict[str, Any]:
        deviation = self._errors.deviation()
        return {
            "count": self._count,
            "accuracy": self._inside / self._count if self._count else None,
            "median_width": self._widths.median(),
            "bias": self._errors.median(),
            "nmad": None if deviation is None else _NORMAL * deviation,
        }


def evaluate_surface(surface: str | Path, reference: str | Path) -> dict[str, Any]:
    """Judge the intervals of a surface model.

    Parameters
    ----------
    surface
        A file that `make_surface` wrote.
    reference
        Heights above the same datum in any CRS; of each cell counts the one nearest to its centre.

    Returns
    -------
    For ``all`` cells with an interval and a reference, by ``slope`` of the reference (degrees) and by ``width`` of the
    interval (metres): ``count``, ``accuracy`` (the share of reference heights inside the interval), ``median_width``,
    ``bias`` (median of height - reference) and ``nmad`` of height - reference, in metres; None of no cells. Classes
    have their ends in ``from`` and ``to``.

    Raises
    ------
    SatIntervalsError
        Files that cannot be read, or do not meet.
    """
    surface, reference = Path(surface), Path(reference)
    shape, place = read_place(surface)
    read_place(reference)
    whole = _Class()
    slopes, widths = ([_Class() for _ in ends[1:]] for ends in (SLOPES, WIDTHS))
    for window in _strips(shape):
        height, lower, upper = read_layers(surface, window)[:3].astype(np.float64)
        truth, slope = _truth(reference, place, shape, window)
        judged = np.isfinite(truth) & np.isfinite(lower) & np.isfinite(height)
        error, width = (height - truth)[judged], (upper - lower)[judged]
        inside = ((lower <= truth) & (truth <= upper))[judged]
        whole.add(error, width, inside)
        for classes, ends, values in ((slopes, SLOPES, slope[judged]), (widths, WIDTHS, width)):
            for kind, (first, last) in zip(classes, pairwise(ends), strict=True):
                chosen = (first <= values) & (values < last)
                kind.add(error[chosen], width[chosen], inside[chosen])
    report = whole.report()
    if not report["count"]:
        raise SatIntervalsError(f"no cell of {surface} has a height in {reference}: give a reference of the same place")
    return {"all": report, "slope": _by(slopes, SLOPES), "width": _by(widths, WIDTHS)}


def _by(classes: list[_Class], ends: tuple[float, ...]) -> list[dict[str, Any]]:
    return [
        {"from": first, "to": None if np.isinf(last) else last, **kind.report()}
        for kind, (first, last) in zip(classes, pairwise(ends), strict=True)
    ]


def _strips(shape: tuple[int, int]) -> Iterator[Window]:
    for row in range(0, shape[0], _ROWS):
        yield Window(row, 0, min(_ROWS, shape[0] - row), shape[1])


def _truth(path: Path, place: Georeferencing, shape: tuple[int, int], window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Reference heights of a window of cells and their slope in degrees, NaN beside cells without one."""
    around = window.grown(1, 1).clipped(Window(0, 0, *shape))
    heights = read_heights(path, place, shape, around)
    assert place.pixel_size is not None
    padded = np.pad(heights, [(1, 1), (1, 1)], mode="edge")
    across, down = place.pixel_size
    rise_across = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * across)
    rise_down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * down)
    slope = np.degrees(np.arctan(np.hypot(rise_across, rise_down)))
    inner = window.relative_to(around).slices
    return heights[inner], slope[inner]
