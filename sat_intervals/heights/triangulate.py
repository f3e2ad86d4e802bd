"""Triangulate disparities and bounds of a run, strip by strip: three seconds of processor time a megapixel."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sat_intervals.progress import Progress
from sat_intervals.raster import POINT_FILES, OutputWriter
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import Window

if TYPE_CHECKING:
    from sat_intervals.heights.sensors import Lattice, Points

# Pixels computed at a time, 300 bytes each; pixels read ahead take 18 bytes.
_PIXELS = 1 << 18
# Positions are rounded to 0.01 mm on the ground and 0.1 mm in height, below the error of the lattice. This halves the
# file.
_DEGREES, _METRES = 2.0**-33, 2.0**-13


def triangulate(
    out: str | Path | Run,
    left_model: str | Path,
    right_model: str | Path,
    left_grid: str | Path,
    right_grid: str | Path,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Triangulate a run and write ``points.tif`` to its folder; an existing one is replaced.

    Parameters
    ----------
    out
        Folder of the finished run, or the run as it was opened.
    left_model, right_model
        RPC models of the sensor images: GeoTIFF with RPC tags, ``.geom`` or DIMAP XML.
    left_grid, right_grid
        Epipolar grids: band 1 is the sensor column, band 2 the sensor row. The geotransform gives the epipolar position
        of each node (convention of shareloc and CARS). Epipolar positions refer to the whole left image. Grids of OTB,
        known by their tag ``METADATATYPE=OTB``, have displacements instead of positions.
    progress
        Callback, see `Progress`.

    Returns
    -------
    ``points``, the number of points; ``lost``, the number of valid pixels
    without a point, because grids or models have no values there; ``beyond``, the number of pixels by which the left
    grid reaches beyond the left image, and the ``grid_step`` in pixels; if there are points, minimum and maximum of
    ``height`` (metres above the ellipsoid) and ``residual`` (metres); ``median_residual`` (metres) at some positions
    across the region, far below 0.1 m if models and grids belong to these images, for any disparities.

    Raises
    ------
    SatIntervalsError
        The folder is not a run, models or grids cannot be read or do not fit, or the file cannot be written.
    """
    from sat_intervals.heights.sensors import Lattice, Sensors  # needs the extra `dsm`

    run = out if isinstance(out, Run) else open_run(out)
    run.check_kept([run.out / "points.tif"], [left_model, right_model, left_grid, right_grid])
    search = run.config.disparity
    models = map(Path, (left_model, right_model, left_grid, right_grid))
    sensors = Sensors.load(*models, left=run.left_georeferencing)
    right_width = run.report["inputs"]["right"]["width"]
    lattice = Lattice(sensors, run.region, right_width, search.minimum, search.maximum)
    tags = {"RUN": run.report["finished"], "LEFT_MODEL": str(left_model), "RIGHT_MODEL": str(right_model)}
    tally = _Tally()
    with OutputWriter(run.out, POINT_FILES, *run.shape, run.georeferencing, tags) as writer:
        for window, disparities in _strips(run):
            bands = _bands(lattice, window, disparities)
            writer.write(window.row, bands)
            tally.add(int(np.isfinite(disparities[0]).sum()), height=bands[2], residual=bands[5])
            progress("points", window.row_stop, run.shape[0])
        progress("files", 0, 1)
        writer.publish()
        progress("files", 1, 1)
    return tally.report() | _beyond(sensors.left_grid, run) | {"median_residual": lattice.residual}


def _beyond(grid: Any, run: Run) -> dict[str, float]:
    """Return the largest number of pixels by which a grid reaches beyond the left image, and its largest step."""
    left, (columns, rows) = run.report["inputs"]["left"], grid.points
    ends = zip((rows, columns), (left["height"], left["width"]), strict=True)
    beyond = max(max(float(-nodes[0]), float(nodes[-1]) - (size - 1)) for nodes, size in ends)
    return {"beyond": beyond, "grid_step": float(max(np.diff(rows).max(), np.diff(columns).max()))}


class _Tally:
    """Count points and valid pixels, and gather minimum and maximum of some bands."""

    def __init__(self) -> None:
        self._points = self._valid = 0
        self._ends: dict[str, tuple[float, float]] = {}

    def add(self, valid: int, **bands: np.ndarray) -> None:
        self._valid += valid
        for name, band in bands.items():
            known = band[np.isfinite(band)]
            if known.size:
                least, largest = self._ends.get(name, (np.inf, -np.inf))
                self._ends[name] = min(least, float(known.min())), max(largest, float(known.max()))
        self._points += known.size

    def report(self) -> dict[str, Any]:
        return {"points": self._points, "lost": self._valid - self._points, **self._ends}


def _strips(run: Run) -> Iterator[tuple[Window, np.ndarray]]:
    """Yield windows of whole rows with disparity, lower and upper ``(3, rows, columns)``, NaN if invalid."""
    height = max(1, _PIXELS // run.region.width)
    for block in run.windows():
        bands = run.read_bands(block)
        disparities = np.where(bands.valid, bands[:3], np.float32(np.nan))
        for first in range(0, block.height, height):
            part = disparities[:, first : first + height]
            yield Window(block.row + first, 0, part.shape[1], block.width), part


def _bands(lattice: "Lattice", window: Window, disparities: np.ndarray) -> np.ndarray:
    """Return the bands of ``points.tif`` for a window."""
    middle, one, other = lattice.points(window, *disparities)
    # Which bound gives the higher point depends on the geometry of the pair.
    low, high = _ordered(one, other)
    heights = (point.height for point in (middle, low, high))
    middle_place, *bound_places = ((point.longitude, point.latitude) for point in (middle, low, high))
    return np.stack(
        [
            *_rounded(middle_place, _DEGREES),
            *_rounded(heights, _METRES),
            middle.residual.astype(np.float32),
            *(place for places in bound_places for place in _rounded(places, _DEGREES)),
        ]
    )


def _rounded(bands: Iterable[np.ndarray], step: float) -> Iterator[np.ndarray]:
    return (np.rint(band / step) * step for band in bands)


def _ordered(one: "Points", other: "Points") -> tuple["Points", "Points"]:
    """Return the lower and the higher of two points of each pixel."""
    swapped = one.height > other.height
    low = type(one)(*(np.where(swapped, b, a) for a, b in zip(one, other, strict=True)))
    high = type(one)(*(np.where(swapped, a, b) for a, b in zip(one, other, strict=True)))
    return low, high
