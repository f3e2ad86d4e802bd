"""Read the heights of one of two dates with their bounds: a surface model of this tool, or of others with sigma."""

from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist

import numpy as np
from pyproj import Transformer

from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.change import drawn
from sat_intervals.products import SURFACE
from sat_intervals.raster.georeferencing import Georeferencing, horizontal_name
from sat_intervals.raster.heightfield import is_ground, warn_of_no_data
from sat_intervals.raster.images import opened
from sat_intervals.raster.layers import read_layers
from sat_intervals.raster.projection import transformed
from sat_intervals.raster.surfaces import read_heights, read_place, resolution_of
from sat_intervals.store.remote import path_of
from sat_intervals.tiling import Window

_COVERAGE = 0.9  # of bounds that are made of standard deviations
_DEVIATIONS = "sigma", "std", "error", "uncertainty"  # words in names of bands


@dataclass(frozen=True)
class Epoch:
    """Heights of a date; ``sigma`` is their standard deviation, None with bounds; ``band`` that of sigma, 0 without."""

    path: Path
    shape: tuple[int, int]
    place: Georeferencing
    level: str  # what heights are above, "" if unknown
    coverage: float
    sigma: float | None = None
    band: int = 0

    @property
    def deviations(self) -> float:
        """Return the standard deviations in a half width."""
        return NormalDist().inv_cdf((1 + self.coverage) / 2)

    def read(self, window: Window) -> np.ndarray:
        """Read height and both bounds of a window inside: ``(3, rows, columns)`` float64, NaN where unknown."""
        if not (self.sigma or self.band):
            bands = read_layers(self.path, window).astype(np.float64)
            return np.where(bands[3] == 0, np.nan, bands[:3])  # filled and flattened cells were not measured
        height = read_heights(self.path, self.place, self.shape, window)
        height[~is_ground(height)] = np.nan  # undeclared no data
        sigma = self.sigma or read_heights(self.path, self.place, self.shape, window, band=self.band)
        half = self.deviations * np.where(sigma > 0, sigma, np.nan)
        return np.stack([height, height - half, height + half])

    def drawn(self, place: Georeferencing, shape: tuple[int, int]) -> np.ndarray:
        """Read the same at the centres of other cells, see `kernels.change.drawn`; NaN outside."""
        grid, own = place.affine, self.place.affine
        x, y = np.meshgrid(grid.c + (np.arange(shape[1]) + 0.5) * grid.a, grid.f + (np.arange(shape[0]) + 0.5) * grid.e)
        if place.crs != self.place.crs:
            crs, target = (horizontal_name(one.crs) for one in (place, self.place) if one.crs)
            x, y = transformed(Transformer.from_crs(crs, target, always_xy=True), x, y)
        # rounded: a neighbour with a weight of rounding errors would give its bounds
        column, row = np.round((x - own.c) / own.a - 0.5, 6), np.round((y - own.f) / own.e - 0.5, 6)
        reach = max(1.0, grid.a / resolution_of(self.path, place))
        first, last = (row.min() - reach, column.min() - reach), (row.max() + reach + 1, column.max() + reach + 1)
        is_near = np.isfinite([*first, *last]).all()  # else too far for the projection
        window = Window.around(first, last).clipped(Window(0, 0, *self.shape)) if is_near else Window(0, 0, 0, 0)
        if not (window.height and window.width):
            return np.full((3, *shape), np.nan)
        bands = self.read(window)
        found = drawn(bands, column.ravel() - window.column, row.ravel() - window.row, reach)
        return np.asarray(found.reshape(3, *shape))


def open_epoch(path: str | Path, sigma: float | None = None) -> Epoch:
    """Open a surface model, or the folder that has it as dsm.tif; ``sigma`` in metres is for those without bounds."""
    path = path_of(path) / "dsm.tif" if path_of(path).is_dir() else path_of(path)
    shape, place = read_place(path)
    assert place.crs is not None
    if not place.crs.is_projected or place.crs.linear_units_factor[1] != 1:
        raise SatIntervalsError(f"{path} is on no map in metres: resample it to one, such as with gdalwarp")
    with opened(str(path)) as dataset:
        names, tags = dataset.descriptions, dataset.tags()
    if "FALSE_ALARMS" in tags:
        raise SatIntervalsError(f"{path} is a change of height: give the surface models of both dates")
    level = tags.get("HEIGHTS", "")
    if names == tuple(band.name for band in SURFACE):
        if "COVERAGE" not in tags:
            raise SatIntervalsError(f"{path} has no bounds with a coverage: make it of runs with --coverage")
        return Epoch(path, shape, place, level, float(tags["COVERAGE"]))
    named = [n for n, name in enumerate(names, 1) for word in _DEVIATIONS if n > 1 and word in (name or "").lower()]
    band = named[0] if named and sigma is None else 0
    if not (sigma or band):
        raise SatIntervalsError(
            f"{path} has neither bounds nor a band named sigma: give --sigma, the standard deviation of its heights"
        )
    warn_of_no_data(path)
    return Epoch(path, shape, place, level, _COVERAGE, sigma, band)
