"""Project the points of a run to the map and accumulate them in the cells of a surface model."""

import math
import threading
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.points import POINT, WINDOW, read_points
from sat_intervals.kernels.disparity import median
from sat_intervals.kernels.splat import BOUNDED, LOWER, UPPER, empty_cells, mean_heights, medians, splat
from sat_intervals.products import OPEN_ABOVE, OPEN_BELOW
from sat_intervals.raster import Projection
from sat_intervals.results import Run
from sat_intervals.tiling import Grid, Window

# Pixels around a point whose median outliers are compared with.
_NEAR = 2


class Extent(NamedTuple):
    """A rectangle in map coordinates, in metres."""

    left: float
    bottom: float
    right: float
    top: float

    def intersects(self, other: "Extent") -> bool:
        """Return whether both share a point."""
        meets = max(self.left, other.left) <= min(self.right, other.right)
        return meets and max(self.bottom, other.bottom) <= min(self.top, other.top)

    def grown(self, margin: float) -> "Extent":
        """Return the rectangle grown by a margin on all sides."""
        return Extent(self.left - margin, self.bottom - margin, self.right + margin, self.top + margin)


@dataclass(frozen=True)
class Cells:
    """The grid of a surface model: north up, aligned to whole multiples of the resolution."""

    left: float
    top: float
    resolution: float
    rows: int
    columns: int

    @classmethod
    def over(cls, extent: Extent, resolution: float) -> "Cells":
        """Return the cells that cover an extent."""
        left, bottom = (math.floor(edge / resolution) for edge in (extent.left, extent.bottom))
        right, top = (math.floor(edge / resolution) + 1 for edge in (extent.right, extent.top))
        return cls(left * resolution, top * resolution, resolution, top - bottom, right - left)

    def extent(self, window: Window) -> Extent:
        """Return the extent of a window of the cells."""
        return Extent(
            self.left + window.column * self.resolution,
            self.top - window.row_stop * self.resolution,
            self.left + window.column_stop * self.resolution,
            self.top - window.row * self.resolution,
        )


class PointCloud:
    """The points of one run that contribute, read by windows, and the map extent of each window.

    ``points``, ``outliers`` and ``open`` count points that contribute, outliers, and other points that are left out
    because their interval is open at an end of the search range.
    """

    def __init__(self, run: Run, projection: Projection, choices: SurfaceChoices) -> None:
        self.run = run
        self._path = run.out / "points.tif"
        self._projection = projection
        self._choices = choices
        self._extents: list[tuple[Window, Extent]] = []
        self.points = self.outliers = self.open = 0
        for tile in Grid(Window(0, 0, *run.shape), WINDOW):
            self._scan(tile.core)

    def _kept(self, window: Window) -> tuple[np.ndarray, np.ndarray, int, int]:
        """Return the bands of a window, the mask of the points that contribute, and the numbers left out."""
        bands, known = read_points(self._path, window)
        outlying = open_ended = np.zeros(known.shape, np.bool_)
        if self._choices.outliers is not None:
            outlying = known & self._outlying(window, self._choices.outliers)
        if not self._choices.keeps_open:
            validity = self.run.read_bands(window).validity.astype(np.int64)
            open_ended = known & ~outlying & (validity & (OPEN_BELOW | OPEN_ABOVE) != 0)
        return bands, known & ~outlying & ~open_ended, int(outlying.sum()), int(open_ended.sum())

    def _outlying(self, window: Window, limit: float) -> np.ndarray:
        """Return the mask of points farther than a limit (metres) from the median of the points near them."""
        around = window.grown(_NEAR, _NEAR).clipped(Window(0, 0, *self.run.shape))
        bands, known = read_points(self._path, around)
        height = np.where(known, bands[POINT["height"]], 0)
        base = np.median(height[known]) if known.any() else 0  # float32 then keeps millimetres
        away = np.abs(height - base - median((height - base).astype(np.float32), known, 2 * _NEAR + 1))
        return np.asarray((away > limit)[window.relative_to(around).slices])

    def _scan(self, window: Window) -> None:
        """Count the points of a window and find their extent."""
        bands, known, outliers, open_ended = self._kept(window)
        longitude, latitude = bands[POINT["longitude"]], bands[POINT["latitude"]]
        self.points += int(known.sum())
        self.outliers += outliers
        self.open += open_ended
        if known.any():
            longitude, latitude = longitude[known], latitude[known]
            if np.isnan(self._projection.undulation(longitude, latitude)).any():
                raise SatIntervalsError(
                    f"the grid of geoid heights does not cover the points of {self.run.out}, at longitudes "
                    f"{longitude.min():.4f} to {longitude.max():.4f}, latitudes {latitude.min():.4f} to "
                    f"{latitude.max():.4f}: give one that covers them"
                )
            x, y = self._projection.place(longitude, latitude)
            if not (np.isfinite(x).all() and np.isfinite(y).all()):
                raise SatIntervalsError(
                    f"points of {self.run.out} are outside the domain of {self._projection.crs}: give another CRS"
                )
            self._extents.append((window, Extent(x.min(), y.min(), x.max(), y.max())))

    @property
    def extent(self) -> Extent | None:
        """Return the extent of all points; None if there are none."""
        if not self._extents:
            return None
        left, bottom, right, top = zip(*(extent for _, extent in self._extents), strict=True)
        return Extent(min(left), min(bottom), max(right), max(top))

    def points_per_cell(self, resolution: float) -> float:
        """Return the mean number of points in a cell with points, by its side in metres."""
        areas = ((e.right - e.left) * (e.top - e.bottom) for _, e in self._extents)
        return max(self.points * resolution**2 / max(sum(areas), resolution**2), 1e-9)

    def splat(self, cells: Cells, window: Window, radius: float, ended: threading.Event) -> np.ndarray:
        """Accumulate the points in a window of cells, see `kernels.splat`; ``radius`` in metres; ``ended`` stops it."""
        gathered = empty_cells(window.height, window.width)
        near = []
        place, reach = cells.extent(window), radius / cells.resolution
        for source, extent in self._extents:
            if ended.is_set():
                break
            if extent.grown(radius).intersects(place):
                bands, known, _, _ = self._kept(source)
                longitude, latitude, height, lower, upper = (
                    bands[POINT[name]][known]
                    for name in ("longitude", "latitude", "height", "height_lower", "height_upper")
                )
                confidence = self.run.read_bands(source).confidence
                x, y = self._projection.place(longitude, latitude)
                down = self._projection.undulation(longitude, latitude)
                points = (
                    (x - place.left) / cells.resolution, (place.top - y) / cells.resolution,
                    height - down, lower - down, upper - down,
                )  # fmt: skip
                splat(*points, confidence[known].astype(np.float64), reach, gathered)
                if self._choices.bounds == "median":
                    near.append(_within(points, window, max(reach, 0.5)))
        if near:
            _set_medians(gathered, np.concatenate(near, axis=1), reach)
        return gathered


def _within(points: tuple[np.ndarray, ...], window: Window, reach: float) -> np.ndarray:
    """Return column, row and both bounds of the points with bounds within reach of a window: ``(4, n)``."""
    column, row, _, lower, upper = points
    inside = (-reach <= column) & (column <= window.width + reach) & (-reach <= row) & (row <= window.height + reach)
    inside &= np.isfinite(lower) & np.isfinite(upper)
    return np.stack([values[inside] for values in (column, row, lower, upper)])


def _set_medians(gathered: np.ndarray, points: np.ndarray, reach: float) -> None:
    """Replace the bounds of each cell by the medians over its points, widened to the cell's height."""
    column, row, *bounds = points
    height = mean_heights(gathered)
    for layer, bound, outwards in zip((LOWER, UPPER), bounds, (np.minimum, np.maximum), strict=True):
        median_bound = medians(column, row, bound, reach, gathered[BOUNDED])
        gathered[layer] = outwards(median_bound, height)
