"""From the disparities and bounds of a run to points and heights, in the geometry of the run.

Points are interpolated from a lattice, which takes about a second a megapixel: no tiles, no cluster and no resuming are
needed. Rows are read, computed and written strip by strip, whatever the size.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.heights.sensors import Lattice, Points, Sensors
from sat_intervals.progress import Progress
from sat_intervals.raster import POINT_FILES, Georeferencing, OutputWriter, open_image
from sat_intervals.results import Run, open_run
from sat_intervals.tiling import Window

# Pixels in work at a time, 300 bytes each; those read and waiting are 18.
_PIXELS = 1 << 20
# What is written is rounded to hundredths of a millimetre on the ground and tenths of one in height, below the error of
# the lattice: the file is half as large.
_DEGREES, _METRES = 2.0**-33, 2.0**-13


def triangulate(
    out: str | Path,
    left_model: str | Path,
    right_model: str | Path,
    left_grid: str | Path,
    right_grid: str | Path,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Triangulate a run: ``points.tif`` beside its files.

    Parameters
    ----------
    out
        Folder of the finished run.
    left_model, right_model
        RPC models of the sensor images: GeoTIFF with RPC tags, ``.geom`` or DIMAP XML.
    left_grid, right_grid
        Epipolar grids: band 1 sensor column, band 2 sensor row at nodes whose epipolar position the geotransform tells
        (the convention of shareloc and CARS). Epipolar positions are those of the whole left image.
    progress
        Called from time to time.

    Returns
    -------
    ``points``, how many pixels have one, and ``lost``, how many valid pixels have none, for grids or models that have
    no values there; where there are points, the least and the largest ``height`` (metres above the ellipsoid) and
    ``residual`` (metres); ``median_residual`` of a few places all over the region: with models and grids of these
    images it is far below a decimetre, whatever the disparities.

    Raises
    ------
    SatIntervalsError
        No run, models or grids that cannot be read or do not fit, a file that cannot be written.
    """
    run = open_run(out)
    run.check_kept([run.out / POINT_FILES[0].name], [left_model, right_model, left_grid, right_grid])
    search = run.config.disparity
    sensors = Sensors.load(*map(Path, (left_model, right_model, left_grid, right_grid)))
    right_width = run.report["inputs"]["right"]["width"]
    lattice = Lattice(sensors, run.region, right_width, search.minimum, search.maximum)
    tags = {"RUN": run.report["finished"], "LEFT_MODEL": str(left_model), "RIGHT_MODEL": str(right_model)}
    tally = _Tally()
    with OutputWriter(run.out, POINT_FILES, *run.shape, _georeferencing(run), tags) as writer:
        for window, disparities in _strips(run):
            bands = _bands(lattice, window, disparities)
            writer.write(window.row, bands)
            tally.add(int(np.isfinite(disparities[0]).sum()), height=bands[2], residual=bands[5])
            progress("points", window.row_stop, run.shape[0])
        progress("files", 0, 1)
        writer.publish()
        progress("files", 1, 1)
    return tally.report() | {"median_residual": lattice.residual}


class _Tally:
    """How many points there are, and what lies between which values."""

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


def _georeferencing(run: Run) -> Georeferencing:
    return open_image(run.out / "validity.tif").georeferencing


def _strips(run: Run) -> Iterator[tuple[Window, np.ndarray]]:
    """Windows of whole rows, from the top, with disparity, lower and upper ``(3, rows, columns)``, NaN if not valid.

    Files are read by rows of blocks, which are then cut.
    """
    height = max(1, _PIXELS // run.region.width)
    for block in run.windows():
        bands = run.read_bands(block)
        disparities = np.where(bands.valid, bands[:3], np.float32(np.nan))
        for first in range(0, block.height, height):
            part = disparities[:, first : first + height]
            yield Window(block.row + first, 0, part.shape[1], block.width), part


def _bands(lattice: Lattice, window: Window, disparities: np.ndarray) -> np.ndarray:
    """The bands of ``points.tif`` for a window."""
    middle, one, other = lattice.points(window, *disparities)
    # Which bound is the higher depends on which image is the left one, and how the grids are turned.
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


def _ordered(one: Points, other: Points) -> tuple[Points, Points]:
    """The lower and the higher of two points of each pixel."""
    swapped = one.height > other.height
    low = Points(*(np.where(swapped, b, a) for a, b in zip(one, other, strict=True)))
    high = Points(*(np.where(swapped, a, b) for a, b in zip(one, other, strict=True)))
    return low, high
