"""Project the points of a run to the map and accumulate them in the cells of a surface model."""

import math
import threading
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.splat import empty_cells, splat
from sat_intervals.products import POINTS
from sat_intervals.raster import Projection, read_layers
from sat_intervals.results import Run
from sat_intervals.tiling import Grid, Window

_POINT = {band.name: index for index, band in enumerate(POINTS)}
# Side of a window of points in pixels: some tens of megabytes.
WINDOW = 512


class Extent(NamedTuple):
    """A rectangle in map coordinates, in metres."""

    left: float
    bottom: float
    right: float
    top: float

    def intersects(self, other: "Extent") -> bool:
        """Return whether both share a point."""
        return (
            self.left <= other.right
            and other.left <= self.right
            and self.bottom <= other.top
            and other.bottom <= self.top
        )

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
    """The points of one run, read by windows, and the map extent of each window."""

    def __init__(self, run: Run, projection: Projection) -> None:
        self.run = run
        self._path = run.out / "points.tif"
        self._projection = projection
        self._extents: list[tuple[Window, Extent]] = []
        self.points = 0
        for tile in Grid(Window(0, 0, *run.shape), WINDOW):
            self._scan(tile.core)

    def _scan(self, window: Window) -> None:
        """Count the points of a window and find their extent."""
        bands = read_layers(self._path, window)
        longitude, latitude = bands[_POINT["longitude"]], bands[_POINT["latitude"]]
        known = np.isfinite(longitude)
        self.points += int(known.sum())
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

    def splat(self, cells: Cells, window: Window, radius: float, ended: threading.Event) -> np.ndarray:
        """Accumulate the points in a window of the cells, see `kernels.splat`; ``radius`` in metres.

        Stops early once ``ended`` is set.
        """
        gathered = empty_cells(window.height, window.width)
        place = cells.extent(window)
        for source, extent in self._extents:
            if ended.is_set():
                break
            if extent.grown(radius).intersects(place):
                bands = read_layers(self._path, source)
                known = np.isfinite(bands[_POINT["height"]])
                longitude, latitude, height, lower, upper = (
                    bands[_POINT[name]][known]
                    for name in ("longitude", "latitude", "height", "height_lower", "height_upper")
                )
                confidence = self.run.read_bands(source).confidence
                x, y = self._projection.place(longitude, latitude)
                down = self._projection.undulation(longitude, latitude)
                splat(
                    (x - place.left) / cells.resolution, (place.top - y) / cells.resolution,
                    height - down, lower - down, upper - down, confidence[known].astype(np.float64),
                    radius / cells.resolution, gathered,
                )  # fmt: skip
        return gathered
