"""Complete a surface: areas without data or of one height, and voids filled from their rims."""

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.kernels.conformal import highest_around, outwards
from sat_intervals.kernels.filling import filled
from sat_intervals.machine import usable_cores
from sat_intervals.raster.files import File
from sat_intervals.raster.georeferencing import Georeferencing
from sat_intervals.raster.layers import read_layers, read_tags
from sat_intervals.raster.polygons import Areas, numbers_of
from sat_intervals.raster.surfaces import read_place
from sat_intervals.raster.writer import OutputWriter
from sat_intervals.store.manifest import digest
from sat_intervals.tiling import Window, strips_of_windows

_TILE, _CELLS, _LOWEST = 1024, 1 << 21, 64  # columns of a tile, cells of a strip, its rows at least
_APART = 1.0  # cells: rims closer to a plane are of smooth ground
# Cells around an area that are its rim, and the share of them below its height.
_RIM, _LOW = 3, 0.1

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Completion:
    """What is done to a measured surface: metres up to which voids are filled, areas of one height, and of no data."""

    fill: float | None
    flatten: Areas | None
    mask: Areas | None

    @property
    def key(self) -> str:
        """Return a digest of all of it."""
        return digest([self.fill, *(one and [one.crs, one.polygons] for one in (self.flatten, self.mask))])

    def tags(self) -> dict[str, str]:
        """Return tags of the surface."""
        tags = {"FILLED": f"voids up to {self.fill:g} m from their rims"} if self.fill else {}
        named = {"FLATTENED": self.flatten, "MASKED": self.mask}
        return tags | {name: areas.path.name for name, areas in named.items() if areas}

    def on(self, place: Georeferencing, shape: tuple[int, int]) -> "Completion":
        """Return it with the areas that are on a surface; warn if a file has none."""
        flatten, mask = (areas and areas.on(place, shape) for areas in (self.flatten, self.mask))
        for areas in (flatten, mask):
            if areas and not areas.polygons:
                _LOG.warning("%s has no area on the surface: check its CRS, or leave it out", areas.path)
        return replace(self, flatten=flatten, mask=mask)


def complete(
    measured: Path, path: Path, file: File, completion: Completion, progress: Callable[[str, int, int], None]
) -> dict[str, Any]:
    """Write the complete surface of a measured one, perhaps in its place; return numbers of cells.

    These are ``filled``, ``flattened`` and ``masked``, and ``voids``, those that stay; ``areas`` of one height, and
    those ``without_rim``.
    """
    surface, counts = _Surface(measured, completion), Counter[str]()
    tags, rows = read_tags(measured) | completion.tags(), surface.shape[0]
    with (
        OutputWriter(path.parent, [replace(file, name=path.name)], *surface.shape, surface.place, tags) as writer,
        ThreadPoolExecutor(usable_cores()) as threads,
    ):
        for windows in surface.windows():
            bands, counted = zip(*threads.map(surface.tile, windows), strict=True)
            counts = sum(counted, counts)
            writer.write(windows[0].row, np.concatenate(bands, axis=2))
            progress("fill", windows[0].row_stop, rows)
        writer.publish()
    without = int(np.isnan(surface.levels[0]).sum())
    areas = {"areas": surface.levels.shape[1], "without_rim": without}
    return {name: counts[name] for name in ("filled", "flattened", "masked", "voids")} | areas


class _Surface:
    """A measured surface that is completed tile by tile; ``levels``: height and bounds of areas, ``(3, n)``."""

    def __init__(self, path: Path, how: Completion) -> None:
        self.shape, self.place = read_place(path)
        self._path, self._how = path, how
        self._reach = int((how.fill or 0.0) / self.place.pixel_size[0] + 1e-6)
        self.levels = self._levels(how.flatten) if how.flatten else np.empty((3, 0))

    def windows(self) -> Iterator[list[Window]]:
        """Yield the windows of strips."""
        return strips_of_windows(self.shape, max(_LOWEST, _CELLS // self.shape[1]), _TILE)

    def _read(self, window: Window, reach: int) -> tuple[Window, np.ndarray, np.ndarray]:
        """Return a window grown by a reach, its bands with masked cells NaN, and which cells are masked."""
        around = window.grown(reach, reach).clipped(Window(0, 0, *self.shape))
        bands = read_layers(self._path, around)
        masked = numbers_of(self._how.mask, self.place, around) > 0
        bands[:, masked] = np.nan
        return around, bands, masked

    def tile(self, window: Window) -> tuple[np.ndarray, Counter[str]]:
        """Return the bands of a window, and counts."""
        around, bands, masked = self._read(window, 2 * self._reach)
        numbers = numbers_of(self._how.flatten, self.place, around)
        flat = (numbers > 0) & ~masked
        bands[:, flat] = np.nan
        bands[:3, flat] = self.levels[:, numbers[flat] - 1]
        is_new = flat & np.isfinite(bands[0])
        voids = np.zeros(masked.shape, bool)
        inner = window.relative_to(around).slices
        voids[inner] = (np.isnan(bands[0]) & ~masked & ~flat)[inner] & bool(self._how.fill)
        found = filled(*bands[:3].astype(np.float64), voids, float(self._reach), _APART * self.place.pixel_size[0])
        voids &= np.isfinite(found[0])
        bands[0][voids] = found[0][voids]
        for band, end in ((1, -np.inf), (2, np.inf)):
            bands[band][voids] = outwards(found[band][voids], end)
        bands[3:5, is_new | voids] = 0
        chosen = {"filled": voids, "flattened": is_new, "masked": masked, "voids": np.isnan(bands[0]) & ~masked}
        counts = Counter({name: int(cells[inner].sum()) for name, cells in chosen.items()})
        return bands[(slice(None), *inner)], counts

    def _levels(self, areas: Areas) -> np.ndarray:
        """Return height and bounds of each area: those of a low quantile of its rim, NaN without one."""
        found = [self._rims(areas, window) for windows in self.windows() for window in windows]
        numbers, cells = (np.concatenate(part, axis=-1) for part in zip(*found, strict=True))
        order = np.argsort(numbers, kind="stable")
        starts = np.searchsorted(numbers[order], np.arange(1, len(areas.polygons) + 2))
        levels = np.full((3, len(areas.polygons)), np.nan)
        for number, (first, last) in enumerate(pairwise(starts)):
            if first < last:
                height, lower, upper = cells[:, order[first:last]].astype(np.float64)
                level = np.quantile(height, _LOW)
                below, above = np.nanmedian(height - lower), np.nanmedian(upper - height)
                levels[:, number] = level, level - below, level + above
        return levels

    def _rims(self, areas: Areas, window: Window) -> tuple[np.ndarray, np.ndarray]:
        """Return numbers of the areas whose rims have the cells of a window, ``(n,)``; their heights and bounds."""
        numbers = numbers_of(areas, self.place, window.grown(_RIM, _RIM).clipped(Window(0, 0, *self.shape)))
        if not numbers.any():
            return np.empty(0, np.int32), np.empty((3, 0), np.float32)
        around, bands, _ = self._read(window, _RIM)
        near = highest_around(numbers.astype(np.float64), _RIM).astype(np.int32)
        inner = window.relative_to(around).slices
        rim = ((near > 0) & (numbers == 0) & np.isfinite(bands[0]))[inner]
        return near[inner][rim], bands[:3][(slice(None), *inner)][:, rim]
