"""Compare surfaces of two dates cell by cell: differences, their deviations, and what they are without a change."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.comparison import Comparison, check_common, registered
from sat_intervals.kernels.significance import MEDIAN, SCALE, Correlation, correlation_of, probability, ratio_of
from sat_intervals.kernels.slopes import rises
from sat_intervals.raster.epochs import Epoch, open_epoch
from sat_intervals.raster.surfaces import check_reference, covered_window, resolution_of
from sat_intervals.tiling import Grid, Window, strips

_STRIP = 1 << 20  # cells compared at a time, some hundred bytes each
_BLOCK, _BLOCKS = 256, 64  # cells along a block that statistics are of, and their number
_CHANGED = 0.01  # probability up to which they leave differences out


class Difference(NamedTuple):
    """Height after - before of cells, and standard deviations of its lower and upper side: metres.

    ``slopes``: metres of height for a metre to the east, and to the north, ``(2, rows, columns)``.
    """

    height: np.ndarray
    down: np.ndarray
    up: np.ndarray
    slopes: np.ndarray

    @property
    def ratio(self) -> np.ndarray:
        """Return the difference in standard deviations of the side of 0."""
        return np.asarray(self.height / np.where(self.height > 0, self.down, self.up))


@dataclass(frozen=True)
class Pair:
    """Surfaces of two dates on the grid of the first.

    shift: ``(2, 3)`` metres to the east, north and up that the second one is moved by, and their standard deviation.
    median: that of absolute ratios; ``correlation`` of those without a change, see `kernels.significance`.
    """

    before: Epoch
    after: Epoch
    shift: np.ndarray
    median: float = 0.0
    correlation: Correlation = Correlation(1.0, [0.0], [1.0])  # noqa: RUF009 (nothing changes it)

    @property
    def scale(self) -> float:
        """Return the scale of Student's distribution."""
        return float(max(SCALE, self.median / MEDIAN))

    def strips(self) -> Iterator[Window]:
        """Yield windows of whole rows from the top."""
        return strips(*self.before.shape, _STRIP)

    def read(self, window: Window) -> Difference:
        """Read a window of both."""
        (east, north, up), deviation = self.shift.tolist()
        around = window.grown(1, 1).clipped(Window(0, 0, *self.before.shape))
        inner = window.relative_to(around).slices
        ground = self.before.read(around)
        height, lower, upper = ground[:, *inner]
        then, then_lower, then_upper = up + self.after.drawn(
            self.before.place.shifted(window).moved(-east, -north), height.shape
        )
        one, other = self.before.deviations, self.after.deviations
        cell = self.before.place.affine
        slopes = np.stack([rises(ground[0], 1)[inner] / cell.a, rises(ground[0], 0)[inner] / cell.e])
        shift = deviation[2] ** 2 + (deviation[0] * slopes[0]) ** 2 + (deviation[1] * slopes[1]) ** 2
        return Difference(
            then - height,
            np.sqrt(((upper - height) / one) ** 2 + ((then - then_lower) / other) ** 2 + shift),
            np.sqrt(((height - lower) / one) ** 2 + ((then_upper - then) / other) ** 2 + shift),
            slopes,
        )

    def bands(self, found: Difference) -> np.ndarray:
        """Return difference, bounds of the coverage of the first surface, significance: ``(4, rows, columns)``."""
        half = ratio_of(1 - self.before.coverage, self.scale)
        bounds = found.height - half * found.down, found.height + half * found.up
        return np.stack([found.height, *bounds, probability(found.ratio, self.scale)])


def open_pair(
    before: str | Path, after: str | Path, sigma: float | None, *, registers: bool
) -> tuple[Pair, dict[str, Any] | None, list[str]]:
    """Open surfaces of two dates and measure what differs without a change.

    Returns the registration, too, which moves the second, see `Registration.report`, and warnings.
    """
    one, other = open_epoch(before, sigma), open_epoch(after, sigma)
    if sigma is not None and one.sigma is None and other.sigma is None:
        raise SatIntervalsError("both surfaces have bounds: leave sigma out")
    if one.level and other.level and one.level != other.level:
        raise SatIntervalsError(
            f"{one.path} has heights {one.level}, {other.path} {other.level}: make both with the same --geoid"
        )
    check_reference(other.path, one.path)
    check_reference(one.path, other.path)
    resolution, area = resolution_of(other.path, one.place), covered_window(other.path, one.place, one.shape)
    given = Comparison(one.path, other.path, one.shape, one.place, resolution, 1, area)
    moved, warnings = registered(given) if registers else (given, [])
    deviation = moved.registration["deviation"] if moved.registration else [0.0] * 3
    if None in deviation:
        warnings.append(
            "a part of the shift cannot be determined and counts as 0 without an error: flat ground, few common cells, "
            "or surfaces many cells apart"
        )
    pair = Pair(one, other, np.array([moved.shift, [sigma or 0.0 for sigma in deviation]]))
    blocks = list(Grid(area, _BLOCK))
    parts = [pair.read(block.core) for block in blocks[:: -(-len(blocks) // _BLOCKS)]]
    heights, ratios = (
        np.concatenate([part[np.isfinite(part)] for part in of_parts])
        for of_parts in ([part.height for part in parts], [part.ratio for part in parts])
    )
    warnings += check_common(given, ratios.size, float(np.median(heights)) - moved.shift[2] if ratios.size else None)
    pair = replace(pair, median=float(np.median(np.abs(ratios))))
    limit = ratio_of(_CHANGED, pair.scale)
    still = [np.where(np.abs(part.ratio) < limit, part.ratio, np.nan) for part in parts]
    pair = replace(pair, correlation=correlation_of(still, one.place.pixel_size[0]))
    return pair, moved.registration, warnings
