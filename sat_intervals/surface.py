"""From the points of one or several runs to a surface model whose cells carry intervals of height.

The cells are made in tiles of a few rows, each of the points that may reach it: memory follows the tile. Every point
reaches the cell it falls in and those whose centre lies within a radius of it; cells that none reaches are no data,
never filled.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.splat import (
    BOUNDED,
    CONFIDENCE,
    COUNT,
    HEIGHT,
    LEAST,
    LOWER,
    MOST,
    UPPER,
    WEIGHT,
    empty_cells,
    splat,
)
from sat_intervals.products import POINTS, SURFACE
from sat_intervals.raster import (
    Georeferencing,
    OutputWriter,
    Projection,
    is_surface,
    north_up,
    read_layers,
    read_shape,
    read_tags,
    surface_file,
    utm_of,
)
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import Grid, Window

Progress = Callable[[str, int, int], None]
"""Called with the stage ("extent", "cells", "files"), how much of it is done, and how much there is."""

_POINT = {band.name: index for index, band in enumerate(POINTS)}
# Pixels of a window of points, cells of a tile: some tens of megabytes each.
_WINDOW = 512
_TILE_ROWS, _TILE_COLUMNS = 512, 2048
# Cells of a strip of tiles, of which a few are held, 24 bytes each; tiles of wide surfaces are lower for it.
_STRIP_CELLS, _LOWEST = 1 << 22, 64
# A surface of more cells than this for a point is a wrong resolution, or points of two places.
_CELLS_PER_POINT = 1000
# Metres: no cell is wider, and no point reaches further.
_LARGEST = 10_000.0


class Extent(NamedTuple):
    """A rectangle on the map, in metres."""

    left: float
    bottom: float
    right: float
    top: float

    def meets(self, other: "Extent") -> bool:
        """Whether they share a point."""
        return (
            self.left <= other.right
            and other.left <= self.right
            and self.bottom <= other.top
            and other.bottom <= self.top
        )

    def grown(self, margin: float) -> "Extent":
        """The rectangle with a margin around it."""
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
        """The cells that cover an extent."""
        left, bottom = (math.floor(edge / resolution) for edge in (extent.left, extent.bottom))
        right, top = (math.floor(edge / resolution) + 1 for edge in (extent.right, extent.top))
        return cls(left * resolution, top * resolution, resolution, top - bottom, right - left)

    def extent(self, window: Window) -> Extent:
        """Where a window of the cells lies."""
        return Extent(
            self.left + window.column * self.resolution,
            self.top - window.row_stop * self.resolution,
            self.left + window.column_stop * self.resolution,
            self.top - window.row * self.resolution,
        )


class Cloud:
    """The points of one run, read by windows, with the extent of each on the map."""

    def __init__(self, run: Run, projection: Projection) -> None:
        self.run = run
        self._path = run.out / "points.tif"
        self._projection = projection
        self._extents: list[tuple[Window, Extent]] = []
        self.points = 0
        for tile in Grid(Window(0, 0, *run.shape), _WINDOW):
            self._look(tile.core)

    def _look(self, window: Window) -> None:
        bands = read_layers(self._path, window)
        longitude, latitude = bands[_POINT["longitude"]], bands[_POINT["latitude"]]
        known = np.isfinite(longitude)
        self.points += int(known.sum())
        if known.any():
            longitude, latitude = longitude[known], latitude[known]
            if np.isnan(self._projection.undulation(longitude, latitude)).any():
                raise SatIntervalsError(
                    f"the grid of geoid heights ends before the points of {self.run.out}, at longitudes "
                    f"{longitude.min():.4f} to {longitude.max():.4f}, latitudes {latitude.min():.4f} to "
                    f"{latitude.max():.4f}: give one that covers them"
                )
            x, y = self._projection.place(longitude, latitude)
            if not (np.isfinite(x).all() and np.isfinite(y).all()):
                raise SatIntervalsError(
                    f"{self._projection.crs} has no place for points of {self.run.out}: give another"
                )
            self._extents.append((window, Extent(x.min(), y.min(), x.max(), y.max())))

    @property
    def extent(self) -> Extent | None:
        """Of all points; None where there is none."""
        if not self._extents:
            return None
        left, bottom, right, top = zip(*(extent for _, extent in self._extents), strict=True)
        return Extent(min(left), min(bottom), max(right), max(top))

    def splat(self, cells: Cells, window: Window, radius: float) -> np.ndarray:
        """What the points gather in a window of the cells, see `kernels.splat`; ``radius`` in metres."""
        gathered = empty_cells(window.height, window.width)
        place = cells.extent(window)
        for source, extent in self._extents:
            if extent.grown(radius).meets(place):
                bands = read_layers(self._path, source)
                known = np.isfinite(bands[_POINT["height"]])
                longitude, latitude, height, lower, upper = (
                    bands[_POINT[name]][known]
                    for name in ("longitude", "latitude", "height", "height_lower", "height_upper")
                )
                (_, _, _, confidence), _ = self.run.read_bands(source)
                x, y = self._projection.place(longitude, latitude)
                down = self._projection.undulation(longitude, latitude)
                splat(
                    (x - place.left) / cells.resolution, (place.top - y) / cells.resolution,
                    height - down, lower - down, upper - down, confidence[known].astype(np.float64),
                    radius / cells.resolution, gathered,
                )  # fmt: skip
        return gathered


def make_surface(
    outs: Sequence[str | Path],
    path: str | Path,
    *,
    resolution: float,
    crs: str | None = None,
    radius: float | None = None,
    interval: Literal["envelope", "mean"] = "envelope",
    geoid: str | Path | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Make a surface model of the points of some runs.

    Parameters
    ----------
    outs
        Folders of runs that were triangulated, of one place.
    path
        The Cloud-Optimized GeoTIFF to write.
    resolution
        Side of a cell in metres.
    crs
        A projected CRS in metres; by default the UTM zone of a point near the middle.
    radius
        Metres from a point within which the centres of cells are reached, beside the cell it falls in; by default the
        side of a cell.
    interval
        The cell's interval: ``envelope`` holds the intervals of all points that reach it; ``mean`` is the weighted mean
        of their bounds. The intervals of several runs are intersected where they meet, else the hull of all is taken.
    geoid
        Grid of geoid heights, which then are what heights count from; by default the ellipsoid of WGS 84.
    progress
        Called from time to time.

    Returns
    -------
    ``crs``, ``rows``, ``columns``, ``points``, ``filled`` (the share of cells with a height), ``disagreeing`` (the
    share of the cells of several runs in which these do not meet, None without such cells).

    Raises
    ------
    SatIntervalsError
        Runs without points, a CRS or grid that does not serve, a file that cannot be written.
    """
    path, radius = Path(path), resolution if radius is None else radius
    for name, value in (("resolution", resolution), ("radius", radius)):
        if not 0 < value <= _LARGEST:
            raise SatIntervalsError(f"{name} is {value:g} m: give one above 0, up to {_LARGEST:g}")
    _check_target(path)
    runs = _triangulated([Path(out) for out in outs])
    middle = _point_near_the_middle(runs)
    projection = Projection(utm_of(*middle) if crs is None else crs, None if geoid is None else Path(geoid))
    projection.check(*middle)
    clouds = []
    for done, run in enumerate(runs):
        progress("extent", done, len(runs))
        clouds.append(Cloud(run, projection))
    cells = _cells(clouds, resolution, radius)
    tags = {
        "RUNS": runs_tag(runs),
        "INTERVAL": interval,
        "RADIUS": f"{radius:g} m",
        "HEIGHTS": f"above {geoid or 'the WGS 84 ellipsoid'}",
    }
    counts = np.zeros(3, np.int64)
    writer = OutputWriter(
        path.parent, [surface_file(path.name)], cells.rows, cells.columns, _place(cells, crs=projection.crs), tags
    )
    with writer, ThreadPoolExecutor() as threads:
        for row, strip in _strips(threads, clouds, cells, radius, interval):
            writer.write(row, strip)
            agreement = strip[-1]
            counts += np.isfinite(strip[0]).sum(), np.isfinite(agreement).sum(), (agreement == 0).sum()
            progress("cells", row + strip.shape[1], cells.rows)
        progress("files", 0, 1)
        writer.publish()
        progress("files", 1, 1)
    filled, shared, disagreeing = map(int, counts)
    return {
        "crs": projection.crs,
        "rows": cells.rows,
        "columns": cells.columns,
        "points": sum(cloud.points for cloud in clouds),
        "filled": filled / (cells.rows * cells.columns),
        "disagreeing": disagreeing / shared if shared else None,
        "without_intervals": [str(run.out) for run in runs if run.config.interval is None],
    }


def runs_tag(runs: Sequence[Run]) -> str:
    """What a surface says of the runs that it is of."""
    return " ".join(run.report["finished"] for run in runs)


def _check_target(path: Path) -> None:
    """Refuse to replace what is no surface model."""
    if path.exists() and not is_surface(path):
        raise SatIntervalsError(f"{path} is there, and is no surface model to be replaced: choose another --output")


def _triangulated(outs: Sequence[Path]) -> list[Run]:
    for out, count in Counter(out.resolve() for out in outs).items():
        if count > 1:
            raise SatIntervalsError(f"{out} is given {count} times: give each run once")
    runs = []
    for out in outs:
        run = open_run(out)
        path = out / "points.tif"
        if not path.exists():
            raise SatIntervalsError(f"{out} has no points.tif: run sat-intervals triangulate on it first")
        if read_tags(path).get("RUN") != run.report["finished"] or read_shape(path) != (len(POINTS), *run.shape):
            raise SatIntervalsError(f"{path} is of an earlier run in {out}: triangulate again")
        runs.append(run)
    return runs


def _point_near_the_middle(runs: Sequence[Run]) -> tuple[float, float]:
    """Longitude and latitude of a point of the first run that has any."""
    for run in runs:
        tiles = Grid(Window(0, 0, *run.shape), _WINDOW)
        middle = tiles.rows / 2 - 0.5, tiles.columns / 2 - 0.5
        for tile in sorted(tiles, key=lambda tile: math.dist((tile.grid_row, tile.grid_column), middle)):
            bands = read_layers(run.out / "points.tif", tile.core)
            known = np.isfinite(bands[0])
            if known.any():
                return float(np.median(bands[0][known])), float(np.median(bands[1][known]))
    raise SatIntervalsError(f"no valid pixel in {', '.join(str(run.out) for run in runs)}: there is no surface to make")


def _cells(clouds: Sequence[Cloud], resolution: float, radius: float) -> Cells:
    extents = [cloud.extent for cloud in clouds if cloud.extent is not None]
    left, bottom, right, top = zip(*extents, strict=True)
    cells = Cells.over(Extent(min(left), min(bottom), max(right), max(top)).grown(radius), resolution)
    points = sum(cloud.points for cloud in clouds)
    if cells.rows * cells.columns > _CELLS_PER_POINT * points:
        raise SatIntervalsError(
            f"{cells.rows} x {cells.columns} cells of {resolution:g} m for {points} points: "
            "choose a coarser --resolution, or runs of one place"
        )
    return cells


def _place(cells: Cells, crs: str) -> Georeferencing:
    return north_up(crs, cells.left, cells.top, cells.resolution)


def _strips(
    threads: ThreadPoolExecutor, clouds: Sequence[Cloud], cells: Cells, radius: float, interval: str
) -> Iterator[tuple[int, np.ndarray]]:
    """Bands of full-width strips, from the top, with the first row of each."""

    def tile(window: Window) -> np.ndarray:
        return _fused([_of_one(cloud.splat(cells, window, radius), interval) for cloud in clouds])

    rows = min(_TILE_ROWS, max(_LOWEST, _STRIP_CELLS // cells.columns))
    for row in range(0, cells.rows, rows):
        height = min(rows, cells.rows - row)
        windows = (
            Window(row, column, height, min(_TILE_COLUMNS, cells.columns - column))
            for column in range(0, cells.columns, _TILE_COLUMNS)
        )
        yield row, np.concatenate(list(threads.map(tile, windows)), axis=2)


class _One(NamedTuple):
    """The cells of one run; NaN where no point reaches."""

    weight: np.ndarray
    height: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    confidence: np.ndarray
    points: np.ndarray


def _of_one(gathered: np.ndarray, interval: str) -> _One:
    weight = np.where(gathered[COUNT] > 0, gathered[WEIGHT], np.nan)
    bounded = np.where(gathered[BOUNDED] > 0, gathered[BOUNDED], np.nan)
    if interval == "mean":
        lower, upper = gathered[LOWER] / bounded, gathered[UPPER] / bounded
    else:
        lower, upper = (np.where(np.isnan(bounded), np.nan, gathered[index]) for index in (LEAST, MOST))
    height, confidence = gathered[HEIGHT] / weight, gathered[CONFIDENCE] / weight
    return _One(weight, height, lower, upper, confidence, gathered[COUNT])


def _fused(runs: Sequence[_One]) -> np.ndarray:
    """The bands of SURFACE from those of each run: ``(6, rows, columns)`` float32."""
    weights = np.stack([run.weight for run in runs])
    weight = np.where(np.isfinite(weights).any(axis=0), np.nansum(weights, axis=0), np.nan)
    height = np.nansum([run.weight * run.height for run in runs], axis=0) / weight
    judged = np.nansum([np.where(np.isnan(run.confidence), np.nan, run.weight) for run in runs], axis=0)
    confidence = np.nansum([run.weight * run.confidence for run in runs], axis=0)
    confidence = np.divide(confidence, judged, out=np.full(judged.shape, np.nan), where=judged > 0)
    lowers, uppers = (np.stack([getattr(run, name) for run in runs]) for name in ("lower", "upper"))
    inner = np.fmax.reduce(lowers), np.fmin.reduce(uppers)
    outer = np.fmin.reduce(lowers), np.fmax.reduce(uppers)
    meeting = inner[0] <= inner[1]
    lower, upper = (np.where(meeting, one, other) for one, other in zip(inner, outer, strict=True))
    several = np.isfinite(lowers).sum(axis=0) > 1
    bands = {
        "height": np.fmin(np.fmax(height, lower), upper),
        "height_lower": _outwards(lower, -np.inf),
        "height_upper": _outwards(upper, np.inf),
        "count": np.where(np.isfinite(weight), sum(run.points for run in runs), np.nan),
        "confidence": confidence,
        "agreement": np.where(several, meeting, np.nan),
    }
    return np.stack([bands[band.name] for band in SURFACE]).astype(np.float32)


def _outwards(bound: np.ndarray, end: float) -> np.ndarray:
    """The float32 next to a bound, on the side of ``end`` where it is not the bound itself."""
    single = bound.astype(np.float32)
    inside = single > bound if end < 0 else single < bound
    return np.where(inside, np.nextafter(single, np.float32(end)), single)
