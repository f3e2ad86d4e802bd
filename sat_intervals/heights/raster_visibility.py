"""Disparities of a raster of heights: the first height that each pixel's line of sight, of `Lattice`, meets."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from sat_intervals.heights.lattice import Lattice
from sat_intervals.kernels.visibility import seen_disparities, tops
from sat_intervals.raster import HeightRaster, Projection
from sat_intervals.tiling import Window

# Side of a tile in pixels, fewer for fine references: at most this many cells of the reference below its pixels.
_TILE = 256
_LEAST = 32
_CELLS = 1024
_THREADS = 3  # tiles at once: their windows of a fine reference are most of the memory
# Degrees: a pixel on a steeper patch between four heights has no disparity, as the place of a wall is known to a cell.
_STEEPEST = 70.0
_MARGIN = 3  # cells around a window of the reference, for interpolation and the curvature of lines of sight


class _FarError(Exception):
    """Raised when the lattice must cover more disparities; holds the new minimum and maximum."""


class RasterVisibility:
    """Disparities of a raster of heights, strip by strip.

    ``lattice_of`` returns the `Lattice` of a run over disparities from the first to the second; ``lattice``, over those
    of ``search``, is tried first. ``shift`` moves the raster on the map: easting, northing, height in metres.
    """

    def __init__(
        self,
        lattice: Lattice,
        lattice_of: Callable[[int, int], Lattice],
        raster: HeightRaster,
        projection: Projection,
        shift: np.ndarray,
        search: tuple[int, int],
    ) -> None:
        self._lattice_of = lattice_of
        self._raster = raster
        self._projection = projection
        self._shift = shift
        self._search = search
        self._lattice = lattice
        self._heights: dict[int, tuple[float, float]] = {}
        self._steepest = np.tan(np.radians(_STEEPEST)) * raster.cell / raster.frame.unit

    def strips(self, pixel: float) -> Iterator[tuple[int, np.ndarray]]:
        """Yield first row and disparities ``(rows, columns)``, NaN if unknown; ``pixel`` is metres on the ground."""
        side = min(_TILE, max(_LEAST, int(_CELLS * self._raster.cell / pixel) // _LEAST * _LEAST))
        height, width = self._lattice.region.height, self._lattice.region.width
        with ThreadPoolExecutor(_THREADS) as threads:
            for row in range(0, height, side):
                window = Window(row, 0, min(side, height - row), width)
                yield row, self._strip(threads, window, side)

    def _strip(self, threads: ThreadPoolExecutor, window: Window, side: int) -> np.ndarray:
        """Return the disparities of a strip; the lattice is extended until it reaches all heights."""
        while True:
            sights, first, step = self._sights(window)
            tiles = [
                Window(0, column, window.height, min(side, window.width - column))
                for column in range(0, window.width, side)
            ]
            try:
                parts = list(threads.map(partial(self._tile, sights=sights, first=first, step=step), tiles))
            except _FarError as far:
                self._search = far.args[0]
                self._lattice = self._lattice_of(*self._search)
                continue
            return np.concatenate(parts, axis=1)

    def _sights(self, window: Window) -> tuple[np.ndarray, tuple[float, float, float], tuple[float, float, float]]:
        """Return lines of sight in cells of the reference, from the highest point, and the place and step of nodes."""
        nodes, (row, column, disparity) = self._lattice.around(window)
        longitude, latitude, height = np.moveaxis(nodes[..., :3], -1, 0)
        x, y = self._projection.place(longitude, latitude)
        east, north, up = self._shift
        longitude, latitude = self._projection.degrees(x - east, y - north)
        sights = np.stack(self._raster.positions(longitude, latitude, height - up), axis=-1)
        row_step, column_step, step = self._lattice.spacing
        if np.nanmedian(height[:, :, -1] - height[:, :, 0]) > 0:
            sights, disparity, step = sights[:, :, ::-1], disparity + step * (nodes.shape[2] - 1), -step
        return np.ascontiguousarray(sights), (row, column, disparity), (row_step, column_step, step)

    def _tile(
        self, tile: Window, sights: np.ndarray, first: tuple[float, float, float], step: tuple[float, float, float]
    ) -> np.ndarray:
        """Return the disparities of the pixels of a tile, whose columns count from the strip's first pixel."""
        begin = min(int(tile.column / step[1]), sights.shape[1] - 2)
        end = min(int((tile.column_stop - 1) / step[1]) + 1, sights.shape[1] - 1)
        sights = np.ascontiguousarray(sights[:, begin : end + 1])
        below = self._below(sights, tile.column) if np.isfinite(sights).any() else None
        if below is None:
            return np.full((tile.height, tile.width), np.nan)
        window, surface = below
        self._check_reach(sights, surface, first[2], step[2])
        relative = sights - np.array([window.column, window.row, 0.0])
        place = first[0], begin * step[1] - tile.column, first[2]
        return np.asarray(
            seen_disparities(surface, tops(surface), relative, step, place, (tile.height, tile.width), self._steepest)
        )

    def _below(self, sights: np.ndarray, column: int) -> tuple[Window, np.ndarray] | None:
        """Read the heights that lines of sight can meet, in a window that grows to hold them; None without any."""
        ends = float(np.nanmin(sights[..., 2])), float(np.nanmax(sights[..., 2]))
        begin = self._heights.get(column, (sum(ends) / 2,) * 2)  # those of the tile above
        found = self._grown(sights, begin)
        if found is None:
            found = self._grown(sights, ends)
        if found is not None:
            self._heights[column] = float(np.nanmin(found[1])), float(np.nanmax(found[1]))
        return found

    def _grown(self, sights: np.ndarray, heights: tuple[float, float]) -> tuple[Window, np.ndarray] | None:
        """Read below a range of heights, which grows to that of the heights found; None if there are none."""
        low, high = heights
        while True:
            window = self._window(sights, low, high).clipped(Window(0, 0, *self._raster.shape))
            if window.height < 2 or window.width < 2:
                return None
            surface = self._raster.read(window)
            known = surface[np.isfinite(surface)]
            if not known.size:
                return None
            lowest, highest = float(known.min()), float(known.max())
            if low <= lowest and highest <= high:
                return window, surface
            low, high = min(low, lowest), max(high, highest)

    def _window(self, sights: np.ndarray, low: float, high: float) -> Window:
        """Return the cells under lines of sight between two heights."""
        top, bottom = sights[:, :, 0], sights[:, :, -1]
        fall = bottom - top
        parts = (np.array([low, high])[:, np.newaxis, np.newaxis] - top[..., 2]) / fall[..., 2]
        x, y = (top[..., axis] + parts * fall[..., axis] for axis in (0, 1))
        x, y = x[np.isfinite(x)], y[np.isfinite(y)]
        if not x.size:
            return Window(0, 0, 0, 0)
        left, above = int(np.floor(x.min())) - _MARGIN, int(np.floor(y.min())) - _MARGIN
        return Window(above, left, int(y.max()) + _MARGIN + 1 - above, int(x.max()) + _MARGIN + 1 - left)

    def _check_reach(self, sights: np.ndarray, surface: np.ndarray, first: float, step: float) -> None:
        """Raise `_FarError` if lines of sight begin below the highest height or end above the lowest."""
        top, bottom = np.nanmin(sights[:, :, 0, 2]), np.nanmax(sights[:, :, -1, 2])
        last = first + step * (sights.shape[2] - 1)
        fall = (top - bottom) / (last - first)  # metres a pixel, signed
        above, beneath = float(np.nanmax(surface)) - top, bottom - float(np.nanmin(surface))
        if above < 0 and beneath < 0:
            return
        ends = first - (above / fall if above >= 0 else 0), last + (beneath / fall if beneath >= 0 else 0)
        margin = 8 + 0.1 * (max(ends) - min(ends))
        lowest, highest = int(np.floor(min(ends) - margin)), int(np.ceil(max(ends) + margin))
        raise _FarError((min(lowest, self._search[0]), max(highest, self._search[1])))
