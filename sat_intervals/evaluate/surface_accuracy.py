"""Evaluate a surface model and its intervals against reference heights, tile by tile."""

from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.accuracy import Accuracy, Heights, Ranking
from sat_intervals.evaluate.comparison import (
    Comparison,
    check_common,
    compared,
    open_comparison,
    registered,
    shared_errors,
    tiles,
)
from sat_intervals.evaluate.points import summary_of
from sat_intervals.raster import path_of, read_heights, read_layers, read_place, read_small_layers, read_tags
from sat_intervals.tiling import Window

# Limits of classes: slope of the reference in degrees, half width of the interval in metres.
SLOPES = (0.0, 5.0, 15.0, 30.0, 45.0, 90.0)
HALF_WIDTHS = (0.0, 0.5, 1.0, 2.5, 5.0, 10.0, np.inf)
# Share of the expected coverage below which a surface is of another place or upside down, not only too sure.
_POOR = 0.5
_MOST_CLASSES = 64  # largest number of values of a raster of classes
_SAMPLES, _AT_ONCE = 4000, 256  # samples of a profile, and of those read at a time


class _Ranges:
    """Figures by ranges of a value between limits."""

    def __init__(self, limits: tuple[float, ...], **judging: Any) -> None:
        self._kinds = {ends: Accuracy(**judging) for ends in pairwise(limits)}

    def add(self, cells: Heights, values: np.ndarray, of_missing: np.ndarray) -> None:
        for (first, last), kind in self._kinds.items():
            chosen, missing = ((first <= part) & (part < last) for part in (values, of_missing))
            kind.add(cells.of(chosen), int(missing.sum()))

    def report(self) -> list[dict[str, Any]]:
        return [
            {"from": first, "to": None if np.isinf(last) else last, **kind.report()}
            for (first, last), kind in self._kinds.items()
        ]


class _Figures:
    """Figures of all cells and of classes; ``judging``: what `Accuracy` takes."""

    def __init__(self, **judging: Any) -> None:
        self._judging = judging
        self._whole, self._ranking = Accuracy(**judging), Ranking()
        self._slopes, self._halves = _Ranges(SLOPES, **judging), _Ranges(HALF_WIDTHS, **judging)
        self._classes: dict[int, Accuracy] = {}
        self._has_slopes = False

    def add(self, given: Comparison, window: Window, classes: Path | None) -> None:
        """Add the cells of a tile."""
        cells, known, missing = compared(given, window)
        self._whole.add(cells, missing[0].size)
        self._ranking.add(cells)
        if given.points is None:
            self._has_slopes = True
            slope = _slope(given, window)
            self._slopes.add(cells, slope[known], slope[missing])
        self._halves.add(cells, cells.half_width, np.empty(0))
        if classes is not None:
            values = _classes(given, classes, window)
            found, absent = values[known], values[missing]
            either = np.concatenate([found, absent])
            for number in np.unique(either[np.isfinite(either)]):
                kind = self._classes.setdefault(int(number), Accuracy(**self._judging))
                kind.add(cells.of(found == number), int((absent == number).sum()))

    def report(self) -> dict[str, Any]:
        """Return the figures, see `evaluate_surface`."""
        return {
            "all": self._whole.report(),
            "slope": self._slopes.report() if self._has_slopes else [],
            "half_width": [kind | {"completeness": None, "within": None} for kind in self._halves.report()],
            "classes": [{"class": number, **self._classes[number].report()} for number in sorted(self._classes)],
            "ranking": self._ranking.report(),
        }


def evaluate_surface(
    surface: str | Path,
    reference: str | Path,
    classes: str | Path | None = None,
    *,
    registers: bool = True,
    within: float = 1.0,
    reference_sigma: float | None = None,
) -> dict[str, Any]:
    """Evaluate the heights and intervals of a surface model against reference heights.

    Parameters
    ----------
    surface
        File of `make_surface`.
    reference
        Raster of heights in metres above the same datum, in any CRS. If it is n times finer than the cells, each cell
        is compared with n x n heights; else with the one nearest to its centre, or interpolated there if the reference
        was moved. Or points, see `sat_intervals.heights.point_files`: each is compared with the cell it falls in.
    classes
        Raster of whole numbers, such as land cover, in any CRS.
    registers
        Whether the reference is first moved by its constant shift from the surface.
    within
        Metres of error up to which a height counts as found.
    reference_sigma
        Standard deviation in metres of the errors of points without a column ``sigma``. Coverage is then that of the
        true heights; all other figures are those of the points.

    Returns
    -------
    Figures of `Accuracy.report` (metres, shares) for ``all`` heights, ``before`` registration, by ``slope`` of the
    reference (degrees), ``half_width`` of the interval (metres) and ``classes``; ``ranking``, how well ``half_width``
    ranks errors, and ``relief``, the range of heights in 5 x 5 cells, alone: the area under the sparsification error
    curve, 0 is perfect; ``within``; ``registration``, see `Registration.report`; ``nominal``, the level of the
    intervals, and what it is (``nominal_is``): ``coverage``, ``alpha``, or None; ``points``, their ``count`` and
    median ``sigma``, None for a raster; ``warnings``, lines.

    Raises
    ------
    SatIntervalsError
        A file cannot be read, has no heights in common with the other, or another datum or unit.
    """
    given = open_comparison(surface, reference, sigma=reference_sigma)
    tags = read_tags(given.surface)
    nominal_is = next((name for name in ("coverage", "alpha") if name.upper() in tags), None)
    nominal = float(tags[nominal_is.upper()]) if nominal_is else None
    if classes is not None:
        read_place(path_of(classes))
    moved, warnings = registered(given) if registers else (given, [])
    is_noisy = given.points is not None and bool(given.points[:, 3].any())
    judging: dict[str, Any] = {"nominal": nominal, "within": within, "is_noisy": is_noisy}
    before, figures = Accuracy(**judging), _Figures(**judging)
    for window in tiles(given):
        figures.add(moved, window, None if classes is None else path_of(classes))
        if moved is not given:
            cells, _, missing = compared(given, window)
            before.add(cells, missing[0].size)
    report = figures.report()
    in_place = before.report() if moved is not given else report["all"]
    warnings += shared_errors(given) + check_common(given, in_place["count"], in_place["median"])
    coverage = report["all"]["coverage"]
    if nominal and coverage is not None and coverage < _POOR * nominal:
        warnings.append(
            f"the intervals contain {100 * coverage:.0f} % of the reference heights, where {100 * nominal:.0f} % are "
            "expected: check sensor models, grids and reference, and that left and right are not swapped"
        )
    return {
        "nominal": nominal,
        "nominal_is": nominal_is,
        "points": None if given.points is None else summary_of(given.points),
        "registration": moved.registration,
        "within": within,
        "warnings": warnings,
        "before": in_place,
        **report,
    }


def _slope(given: Comparison, window: Window) -> np.ndarray:
    """Return the slope of the reference in degrees, from interpolated heights: those of pixels would form steps."""
    around = window.grown(1, 1).clipped(Window(0, 0, *given.shape))
    finer = given.finer
    heights = given.heights(*given.cells(around, finer), smooth=True)
    place = window.relative_to(around)
    first, left = place.row * finer, place.column * finer
    rows, columns = window.height * finer, window.width * finer
    padded = np.pad(heights, 1, mode="edge")[first : first + rows + 2, left : left + columns + 2]
    across = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * given.cell / finer)
    down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * given.cell / finer)
    return np.asarray(np.degrees(np.arctan(np.hypot(across, down))))


def _classes(given: Comparison, path: Path, window: Window) -> np.ndarray:
    """Return the classes of the reference heights of a tile, NaN where unknown."""
    place, shape = given.cells(window, given.finer)
    values = read_heights(path, place, shape, Window(0, 0, *shape))
    found = np.unique(values[np.isfinite(values)])
    if (found % 1).any() or found.size > _MOST_CLASSES:
        raise SatIntervalsError(
            f"{path} has values such as {found[(found % 1).argmax()]:g}, or more than {_MOST_CLASSES} of them: give a "
            "raster of classes"
        )
    return values


class Profile(NamedTuple):
    """Heights along a line: ``(n,)`` metres from its first end, NaN where unknown; and the ends."""

    distance: np.ndarray
    height: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    reference: np.ndarray
    ends: tuple[tuple[float, float], tuple[float, float]]


def read_profile(given: Comparison, line: tuple[float, float, float, float] | None = None) -> Profile:
    """Read both along a line, easting and northing of its ends in the surface's CRS; by default the middle row."""
    place = given.place.affine
    rows, columns = given.shape
    if line is None:
        y = place.f + (rows // 2 + 0.5) * place.e
        line = (place.c, y, place.c + columns * place.a, y)
    length = float(np.hypot(line[2] - line[0], line[3] - line[1]))
    part = np.linspace(0, 1, int(min(_SAMPLES, max(2, length / given.cell))), endpoint=False)
    row = np.floor((line[1] + part * (line[3] - line[1]) - place.f) / place.e).astype(int)
    column = np.floor((line[0] + part * (line[2] - line[0]) - place.c) / place.a).astype(int)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    if not inside.any():
        raise SatIntervalsError(
            f"the line from {line[0]:g}, {line[1]:g} to {line[2]:g}, {line[3]:g} does not cross {given.surface}: give "
            "eastings and northings in its CRS"
        )
    bands = np.full((4, part.size), np.nan)
    for chosen in np.array_split(np.flatnonzero(inside), -(-int(inside.sum()) // _AT_ONCE)):
        first, left = int(row[chosen].min()), int(column[chosen].min())
        window = Window(first, left, int(row[chosen].max()) + 1 - first, int(column[chosen].max()) + 1 - left)
        here = row[chosen] - first, column[chosen] - left
        bands[:3, chosen] = read_layers(given.surface, window)[:3][:, *here]
        bands[3, chosen] = given.heights(*given.cells(window))[here]
    ends = (line[0], line[1]), (line[2], line[3])
    return Profile(part * length, bands[0], bands[1], bands[2], bands[3], ends)


def error_map(given: Comparison, longest: int) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Return height - reference, at most ``longest`` cells along a side, and its left, right, bottom and top."""
    rows, columns = given.shape
    coarser = -(-max(given.shape) // longest)
    small = -(-rows // coarser), -(-columns // coarser)
    heights = read_small_layers(given.surface, small)[0].astype(np.float64)
    truth = given.heights(given.place.coarser(columns / small[1], rows / small[0]), small)
    place = given.place.affine
    extent = place.c, place.c + columns * place.a, place.f + rows * place.e, place.f
    return heights - truth, extent
