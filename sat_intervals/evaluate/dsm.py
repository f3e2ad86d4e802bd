"""Evaluate the intervals of a surface model against reference heights, strip by strip."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.histogram import Histogram
from sat_intervals.raster import (
    Georeferencing,
    check_reference,
    is_surface,
    read_heights,
    read_layers,
    read_place,
    resolution_of,
)
from sat_intervals.tiling import Window, strips

# Heights evaluated at a time, some hundred bytes each.
_STRIP = 1 << 20
# Limits of classes: slope of the reference in degrees, width of the interval in metres.
SLOPES = (0.0, 5.0, 15.0, 30.0, 45.0, 90.0)
WIDTHS = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, np.inf)
# Errors and widths are counted in centimetres, up to this many metres.
_LARGEST = 500
# Factor of the NMAD, a robust standard deviation: sigma of a normal distribution (Hoehle and Hoehle 2009).
_NORMAL = 1.4826


class _Class:
    """Figures of a class of cells."""

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
    """Evaluate the intervals of a surface model.

    Parameters
    ----------
    surface
        A file that `make_surface` wrote.
    reference
        Heights above the same datum in any CRS. If it is n times finer than the cells, each cell is compared with n x n
        heights; else with the one nearest to its centre.

    Returns
    -------
    For ``all`` heights with an interval, by ``slope`` of the reference (degrees) and by ``width`` of the
    interval (metres): ``count``, ``accuracy`` (the share of reference heights inside the interval), ``median_width``,
    ``bias`` (median of height - reference) and ``nmad`` of height - reference, in metres; None without cells. ``from``
    and ``to`` are the limits of a class.

    Raises
    ------
    SatIntervalsError
        A file cannot be read, or both do not overlap, or their heights differ by too much.
    """
    surface, reference = Path(surface), Path(reference)
    shape, place = read_place(surface)
    if not is_surface(surface):
        raise SatIntervalsError(f"{surface} is not a surface model of sat-intervals dsm: is it the --reference?")
    read_place(reference)
    check_reference(reference, surface)
    assert place.pixel_size is not None
    finer = max(1, round(place.pixel_size[0] / resolution_of(reference, place)))
    whole = _Class()
    slopes, widths = ([_Class() for _ in ends[1:]] for ends in (SLOPES, WIDTHS))
    for window in strips(*shape, _STRIP // finer**2):
        height, lower, upper = (_refined(band, finer) for band in read_layers(surface, window)[:3].astype(np.float64))
        truth, slope = _truth(reference, place, shape, window, finer)
        known = np.isfinite(truth) & np.isfinite(lower) & np.isfinite(height)
        error, width = (height - truth)[known], (upper - lower)[known]
        inside = ((lower <= truth) & (truth <= upper))[known]
        whole.add(error, width, inside)
        for classes, ends, values in ((slopes, SLOPES, slope[known]), (widths, WIDTHS, width)):
            for kind, (first, last) in zip(classes, pairwise(ends), strict=True):
                chosen = (first <= values) & (values < last)
                kind.add(error[chosen], width[chosen], inside[chosen])
    report = whole.report()
    if not report["count"]:
        raise SatIntervalsError(
            f"no cell of {surface} has an interval and a height in {reference}: give a reference of the same place, "
            "and a surface of runs with intervals"
        )
    if abs(report["bias"]) >= _LARGEST:
        raise SatIntervalsError(
            f"the heights of {surface} and {reference} differ by {_LARGEST} m or more in the median: check that both "
            "are metres above the same datum"
        )
    return {"all": report, "slope": _by(slopes, SLOPES), "width": _by(widths, WIDTHS)}


def _by(classes: list[_Class], ends: tuple[float, ...]) -> list[dict[str, Any]]:
    return [
        {"from": first, "to": None if np.isinf(last) else last, **kind.report()}
        for kind, (first, last) in zip(classes, pairwise(ends), strict=True)
    ]


def _refined(band: np.ndarray, finer: int) -> np.ndarray:
    """Repeat each cell ``finer`` times along both axes."""
    return np.repeat(np.repeat(band, finer, axis=0), finer, axis=1)


def _truth(
    path: Path, place: Georeferencing, shape: tuple[int, int], window: Window, finer: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return reference heights of a window of cells, ``finer`` per side, and their slope in degrees; NaN if missing.

    The slope comes from interpolated heights: those of the nearest pixels would form steps.
    """
    place = place.refined(finer)
    shape = shape[0] * finer, shape[1] * finer
    window = Window(*(finer * side for side in (window.row, window.column, window.height, window.width)))
    around = window.grown(1, 1).clipped(Window(0, 0, *shape))
    padded = np.pad(read_heights(path, place, shape, around, smooth=True), [(1, 1), (1, 1)], mode="edge")
    assert place.pixel_size is not None
    across, down = place.pixel_size
    rise_across = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * across)
    rise_down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * down)
    slope = np.degrees(np.arctan(np.hypot(rise_across, rise_down)))
    return read_heights(path, place, shape, window), slope[window.relative_to(around).slices]
