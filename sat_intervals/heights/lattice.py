"""Ground points at the nodes of a lattice over rows, columns and disparities, and at the pixels between them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.lattice import interpolate
from sat_intervals.raster import Projection
from sat_intervals.tiling import Grid, Window

WINDOW = 512  # side of a window of pixels whose points are made at a time: a block of the files of a run


class Extent(NamedTuple):
    """A rectangle in map coordinates, in metres."""

    left: float
    bottom: float
    right: float
    top: float

    def contains(self, other: "Extent") -> bool:
        """Return whether another extent is inside."""
        return joined([self, other]) == self

    def intersects(self, other: "Extent") -> bool:
        """Return whether both share a point."""
        meets = max(self.left, other.left) <= min(self.right, other.right)
        return meets and max(self.bottom, other.bottom) <= min(self.top, other.top)

    def grown(self, margin: float) -> "Extent":
        """Return the rectangle grown by a margin on all sides."""
        return Extent(self.left - margin, self.bottom - margin, self.right + margin, self.top + margin)


def joined(extents: Iterable[Extent | None]) -> Extent | None:
    """Return the smallest extent that contains all; None without any."""
    known = [extent for extent in extents if extent]
    if not known:
        return None
    left, bottom, right, top = zip(*known, strict=True)
    return Extent(min(left), min(bottom), max(right), max(top))


@dataclass(frozen=True)
class Lattice:
    """Points of the pixels of a region of the left image, interpolated between nodes; NaN where a node is unknown.

    Attributes
    ----------
    nodes
        ``(rows, columns, disparities, values)`` float64, at least two along each axis. Values are longitude, latitude
        (degrees), height above the ellipsoid and residual (metres); or easting, northing and height, see `on_map`.
    spacing
        Pixels between nodes along rows, columns and disparities.
    region, minimum
        Pixels of the left image from the first node to the last, and disparity of the first node.
    first
        Row and column of the first of ``nodes`` if they are some of them, see `within`.
    """

    nodes: np.ndarray
    spacing: tuple[float, float, float]
    region: Window
    minimum: float
    first: tuple[int, int] = (0, 0)

    @property
    def middle(self) -> tuple[float, float]:
        """Return the medians of the first two values, longitude and latitude."""
        first, second = np.nanmedian(self.nodes[..., :2].reshape(-1, 2), axis=0)
        return float(first), float(second)

    def points(self, window: Window, disparity: np.ndarray, values: slice = slice(None)) -> np.ndarray:
        """Return ``(values, rows, columns)`` at the disparities of a window, which counts from the region's pixel 0."""
        nodes, first = self.around(window)
        return np.asarray(interpolate(np.ascontiguousarray(nodes[..., values]), self.spacing, first, disparity))

    def around(self, window: Window) -> tuple[np.ndarray, tuple[float, float, float]]:
        """Return the nodes around a window; row, column and disparity of their first, from the window's first pixel."""
        rows, columns = self.nodes_of(window)
        row, column = (start + one.start for start, one in zip(self.first, (rows, columns), strict=True))
        first = row * self.spacing[0] - window.row, column * self.spacing[1] - window.column
        return self.nodes[rows, columns], (*first, self.minimum)

    def nodes_of(self, window: Window) -> tuple[slice, slice]:
        """Return the rows and columns of the nodes around a window, of those that there are."""
        ends = (window.row, window.row_stop - 1), (window.column, window.column_stop - 1)
        rows, columns = (
            slice(max(0, min(int(first / step) - start, count - 2)), max(2, min(int(last / step) + 2 - start, count)))
            for (first, last), step, count, start in zip(
                ends, self.spacing, self.nodes.shape[:2], self.first, strict=False
            )
        )
        return rows, columns

    def within(self, window: Window) -> "Lattice":
        """Return the lattice with the nodes around a window alone."""
        rows, columns = self.nodes_of(window)
        first = self.first[0] + rows.start, self.first[1] + columns.start
        return replace(self, nodes=self.nodes[rows, columns], first=first)


def on_map(lattice: Lattice, projection: Projection, name: str) -> Lattice:
    """Return a lattice of easting, northing and height, above the projection's geoid if any; ``name`` is for errors."""
    longitude, latitude, height = np.moveaxis(lattice.nodes[..., :3], -1, 0)
    down = projection.undulation(longitude, latitude)
    x, y = projection.place(longitude, latitude)
    known = np.isfinite(longitude)
    if np.isnan(down[known]).any():
        raise SatIntervalsError(
            f"the grid of geoid heights does not cover the region of {name}, at longitudes "
            f"{np.nanmin(longitude):.4f} to {np.nanmax(longitude):.4f}, latitudes {np.nanmin(latitude):.4f} to "
            f"{np.nanmax(latitude):.4f}: give one that covers them"
        )
    if not (np.isfinite(x[known]).all() and np.isfinite(y[known]).all()):
        raise SatIntervalsError(f"places of {name} are outside the domain of {projection.crs}: give another CRS")
    return replace(lattice, nodes=np.stack([np.where(known, x, np.nan), np.where(known, y, np.nan), height - down], -1))


class Ground:
    """A lattice of `on_map`, with the map extents of its blocks between nodes."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        places = lattice.nodes[..., :2]
        self._lowest = _of_blocks(np.fmin, np.fmin.reduce(places, axis=2))
        self._highest = _of_blocks(np.fmax, np.fmax.reduce(places, axis=2))

    def extent(self, window: Window) -> Extent | None:
        """Return the extent that the points of a window have at any disparity of the lattice; None if unknown."""
        blocks = self._blocks(window)
        lowest, highest = self._lowest[blocks], self._highest[blocks]
        if np.isnan(lowest).all():
            return None
        return Extent(*map(float, (*np.nanmin(lowest, axis=(0, 1)), *np.nanmax(highest, axis=(0, 1)))))

    @property
    def pixel_area(self) -> float:
        """Return the median area of a pixel on the map in square metres."""
        places = self.lattice.nodes[:, :, 0, :2]
        across, down = np.diff(places, axis=1)[:-1], np.diff(places, axis=0)[:, :-1]
        areas = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
        return float(np.nanmedian(areas) / (self.lattice.spacing[0] * self.lattice.spacing[1]))

    def windows(self, extent: Extent) -> Iterator[Window]:
        """Yield windows of pixels that contain all points of an extent, and few others."""
        reaches = np.all((self._lowest <= extent[2:]) & (self._highest >= extent[:2]), axis=2)
        region, reached = self.lattice.region, np.nonzero(reaches)
        if not reached[0].size:
            return
        for tile in Grid(Window(0, 0, region.height, region.width), WINDOW).within(self._pixels(*reached)):
            rows, columns = self._blocks(tile.core)
            row, column = np.nonzero(reaches[rows, columns])
            if row.size:
                yield self._pixels(rows.start + row, columns.start + column).clipped(tile.core)

    def _pixels(self, *blocks: np.ndarray) -> Window:
        """Return the pixels of the region around blocks, of rows and columns that are given."""
        places = [start + of_axis for start, of_axis in zip(self.lattice.first, blocks, strict=True)]
        row, column = (int(axis.min() * step) for axis, step in zip(places, self.lattice.spacing, strict=False))
        last = [int((axis.max() + 1) * step) for axis, step in zip(places, self.lattice.spacing, strict=False)]
        region = Window(0, 0, self.lattice.region.height, self.lattice.region.width)
        return Window(row, column, last[0] + 1 - row, last[1] + 1 - column).clipped(region)

    def _blocks(self, window: Window) -> tuple[slice, slice]:
        rows, columns = self.lattice.nodes_of(window)
        return slice(rows.start, rows.stop - 1), slice(columns.start, columns.stop - 1)


def _of_blocks(least: np.ufunc, ends: np.ndarray) -> np.ndarray:
    """Return the least, or largest, known values of the four nodes around each block, ``(rows, columns, 2)``."""
    return np.asarray(least(least(ends[:-1, :-1], ends[:-1, 1:]), least(ends[1:, :-1], ends[1:, 1:])))
