"""Compare a surface model with reference heights: open both, register the reference, read cells tile by tile."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.accuracy import BLOCKS, LARGEST, Heights
from sat_intervals.evaluate.points import blocks_of, cells_of, read_points
from sat_intervals.heights.point_files import ENDINGS
from sat_intervals.kernels.conformal import AROUND, relief_of
from sat_intervals.kernels.registration import REACH, Blocks, part_of, put_together, register, spread_blocks
from sat_intervals.kernels.relief import sampled
from sat_intervals.raster import GROUND, Georeferencing, path_of, read_heights, read_layers, read_place, read_tags
from sat_intervals.raster.heightfield import warn_of_no_data
from sat_intervals.raster.surfaces import (
    check_reference,
    covered_window,
    datum_warnings,
    resolution_of,
    surface_place,
)
from sat_intervals.tiling import Grid, Window

_TILE = 1 << 20  # heights compared at a time, some hundred bytes each
# Smallest side of the blocks that register, in cells; cells around a window that slopes are taken from.
_SMALLEST, _AROUND = 16, 4


@dataclass(frozen=True)
class Comparison:
    """A surface model and its reference, moved by the shift of ``registration``, see `Registration.report`."""

    surface: Path
    reference: Path
    shape: tuple[int, int]
    place: Georeferencing
    resolution: float  # of the reference in metres
    finer: int  # heights of the reference along a cell
    area: Window  # cells where the reference may have heights
    points: np.ndarray | None = None  # instead of a raster, see `read_points`
    registration: dict[str, Any] | None = None

    @property
    def shift(self) -> tuple[float, float, float]:
        """Return metres that the reference is moved by: easting, northing, height."""
        return tuple(self.registration["shift"]) if self.registration else (0.0, 0.0, 0.0)

    @property
    def cell(self) -> float:
        """Return the side of a cell in metres."""
        return self.place.pixel_size[0]

    def block_of(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return the part of the ground of cells: `BLOCKS` x `BLOCKS` parts of the area of the reference."""
        parts = (
            np.clip(BLOCKS * (place - first) // max(1, size), 0, BLOCKS - 1)
            for place, first, size in (
                (row, self.area.row, self.area.height),
                (column, self.area.column, self.area.width),
            )
        )
        return np.asarray(next(parts) * BLOCKS + next(parts))

    def cells(self, window: Window, finer: int = 1) -> tuple[Georeferencing, tuple[int, int]]:
        """Return place and shape of a window of cells, perhaps beyond the surface, with ``finer`` per side of each."""
        return self.place.shifted(window).coarser(1 / finer, 1 / finer), (finer * window.height, finer * window.width)

    def heights(
        self, place: Georeferencing, shape: tuple[int, int], *, smooth: bool = False, needed: np.ndarray | None = None
    ) -> np.ndarray:
        """Read the moved reference at the centres of ``shape`` cells; if ``smooth``, interpolate.

        Heights that no ground has are NaN, and errors where they are ``needed``: undeclared no data, or another unit.
        """
        east, north, up = self.shift
        if smooth or (east, north) == (0.0, 0.0):
            cells = place.moved(-east, -north)
            heights = read_heights(self.reference, cells, shape, Window(0, 0, *shape), smooth=smooth)
        else:
            heights = self._moved(place, shape, east, north)
        wrong = (heights < GROUND[0]) | (heights > GROUND[1])
        if needed is not None and (found := heights[wrong & needed]).size:
            raise SatIntervalsError(
                f"{self.reference} has heights such as {found[0]:.0f} m, which no ground has: declare them as no data, "
                "with gdal_edit.py -a_nodata, or convert the file to metres"
            )
        return np.where(wrong, np.nan, heights + up)

    def _moved(self, place: Georeferencing, shape: tuple[int, int], east: float, north: float) -> np.ndarray:
        """Read the reference moved by whole cells and, by slopes, the rest: interpolation would average noise away."""
        cell = place.pixel_size[0]
        rows, columns = (size + 2 * _AROUND for size in shape)
        across, down = round(east / cell), round(-north / cell)
        cells = place.shifted(Window(-_AROUND - down, -_AROUND - across, *shape))
        read = read_heights(self.reference, cells, (rows, columns), Window(0, 0, rows, columns))
        x, y = np.meshgrid(np.arange(shape[1]) - east / cell + across, np.arange(shape[0]) + north / cell + down)
        block = np.zeros(x.size, np.int64)
        found: np.ndarray = sampled(read[np.newaxis], block, x.ravel() + _AROUND, y.ravel() + _AROUND)
        return found.reshape(shape)


def open_comparison(
    surface: str | Path,
    reference: str | Path,
    registration: dict[str, Any] | None = None,
    sigma: float | None = None,
) -> Comparison:
    """Open a surface model and its reference, which a registration moves; ``sigma`` is that of points."""
    surface, reference = path_of(surface), path_of(reference)
    shape, place = surface_place(surface)
    if reference.suffix.lower() in ENDINGS:
        points = read_points(surface, reference, place, shape, sigma)
        cells = cells_of(points, place)
        area = Window.around(cells.min(axis=1).tolist(), (cells.max(axis=1) + 1).tolist())
        return Comparison(surface, reference, shape, place, place.pixel_size[0], 1, area, points, registration)
    if sigma is not None:
        raise SatIntervalsError(f"{reference} is a raster: a sigma of its heights is for points, leave it out")
    read_place(reference)
    check_reference(reference, surface)
    warn_of_no_data(reference)
    resolution = resolution_of(reference, place)
    finer = max(1, round(place.pixel_size[0] / resolution))
    area = covered_window(reference, place, shape)
    return Comparison(surface, reference, shape, place, resolution, finer, area, registration=registration)


def check_common(given: Comparison, count: int, median: float | None) -> list[str]:
    """Warn of another datum by the median of height - reference; raise without one, or if it is too large."""
    if not count or median is None:
        raise SatIntervalsError(
            f"no cell of {given.surface} has a height in {given.reference}: give a reference of the same place"
        )
    if abs(median) >= LARGEST:
        raise SatIntervalsError(
            f"the heights of {given.surface} and {given.reference} differ by {LARGEST} m or more in the median: check "
            "that both are metres above the same datum"
        )
    return datum_warnings(given.surface, given.reference, median)


def shared_errors(given: Comparison) -> list[str]:
    """Return a warning if the reference is a surface of this tool, too."""
    if given.points is not None or "RUNS" not in read_tags(given.reference):
        return []
    return [
        f"{given.reference} is a surface of this tool, too: errors that both share do not show, so coverage is too "
        "large and margins are too small; compare with heights of another source; what changed between two dates, "
        "sat-intervals change finds"
    ]


def tiles(given: Comparison) -> Iterator[Window]:
    """Yield square tiles: windows of whole rows would read the blocks of a fine reference many times."""
    side = max(1, int(_TILE**0.5) // given.finer)
    return (tile.core for tile in Grid(Window(0, 0, *given.shape), side))


class Compared(NamedTuple):
    """Heights of both, and rows and columns of the reference heights of a tile that they are of.

    ``missing``: those of reference heights whose cells have none.
    """

    cells: Heights
    known: tuple[np.ndarray, ...]
    missing: tuple[np.ndarray, ...]


def compared(given: Comparison, window: Window) -> Compared:
    """Read the cells of a tile that both have a height, once for each reference height."""
    if given.points is not None:
        return _compared_points(given, given.points + np.array([*given.shift, 0.0]), window)
    finer = given.finer
    height, lower, upper, relief = (
        np.repeat(np.repeat(band, finer, axis=0), finer, axis=1) for band in _bands(given, window)
    )
    reference = given.heights(*given.cells(window, finer), needed=np.isfinite(height))
    known = np.isfinite(reference) & np.isfinite(height)
    row, column = np.arange(height.shape[0])[:, np.newaxis] // finer, np.arange(height.shape[1]) // finer
    block = given.block_of(row + window.row, column + window.column)
    cells = Heights(height, lower, upper, reference, relief, np.zeros(height.shape), block).of(known)
    return Compared(cells, np.nonzero(known), np.nonzero(np.isfinite(reference) & np.isnan(height)))


def _compared_points(given: Comparison, points: np.ndarray, window: Window) -> Compared:
    """Read the cells of a tile that points fall in."""
    row, column = cells_of(points, given.place)
    inside = (row >= window.row) & (row < window.row_stop) & (column >= window.column) & (column < window.column_stop)
    row, column, block = row[inside] - window.row, column[inside] - window.column, given.block_of(row, column)[inside]
    height, lower, upper, relief = _bands(given, window)[:, row, column]
    known = np.isfinite(height)
    cells = Heights(height, lower, upper, points[inside, 2], relief, points[inside, 3], block).of(known)
    return Compared(cells, (row[known], column[known]), (row[~known], column[~known]))


def _bands(given: Comparison, window: Window) -> np.ndarray:
    """Return height, both bounds and relief of a window of cells: ``(4, rows, columns)``."""
    around = window.grown(AROUND, AROUND).clipped(Window(0, 0, *given.shape))
    bands = read_layers(given.surface, around)[:3].astype(np.float64)
    return np.concatenate([bands, relief_of(bands[0])[np.newaxis]])[:, *window.relative_to(around).slices]


def registered(given: Comparison) -> tuple[Comparison, list[str]]:
    """Return the comparison with the reference moved to the surface; the same and a warning with too few heights."""
    if given.points is not None:
        blocks = blocks_of(given.surface, given.points, given.place, given.shape)
    else:
        blocks = _blocks_of_raster(given)
    found = register(blocks)
    if found is None:
        return given, ["the reference was not moved: too few common heights"]
    return replace(given, registration=found.report()), []


def _blocks_of_raster(given: Comparison) -> Blocks | None:
    """Return cells of the surface on blocks of the reference."""
    parts = []
    for core in spread_blocks(given.area, _SMALLEST):
        height = read_heights(given.surface, given.place, given.shape, core)
        if np.isfinite(height).any():
            surface = given.heights(*given.cells(core.grown(REACH + 1, REACH + 1)), smooth=True)
            parts.append(part_of(surface, height))
    return put_together(parts, given.cell, moves=1)
