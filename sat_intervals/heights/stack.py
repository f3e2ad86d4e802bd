"""Match many images coarsely: a surface of a level, the ranges of the next one, and samples for shifts."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config
from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.ortho import ortho
from sat_intervals.heights.shifts import Sample
from sat_intervals.kernels.components import component_sizes
from sat_intervals.kernels.disparity import median
from sat_intervals.match.ground import BLOCK, GroundViews
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.matching_cost import Given
from sat_intervals.match.patch import PatchFrame, match_patch, patch_areas
from sat_intervals.match.sweep import SweepCost
from sat_intervals.prepare.pair import Each
from sat_intervals.raster import Image, read_reduced_views
from sat_intervals.tiling import Grid, Views, Window

try:
    from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter
except ModuleNotFoundError as error:
    raise SatIntervalsError("sensor models need shareloc: pip install 'sat-intervals[dsm]'") from error

# Cells of a tile of a level, and around it that support it.
_TILE, _OVERLAP = 256, 16
# Share of the cells of a level, of lowest confidence, that neither ranges nor shifts are made of.
_UNSURE = 0.02, 0.3
# Cells of a level around a block of the next one that its range is made of, by how much finer that is, and the margin
# of the range: steps of the level, and a share of the range. Levels with large cells smooth narrow towers away: their
# heights come from what is beside. With 4 cells whole roofs were lost that end beyond a block.
_BESIDE, _MARGIN = {4: 32, 2: 10}, (2, 0.1)
_SPECKLE = 30  # cells of a level of one surface, at least, that ranges are made of: fewer are stray winners
# Sample blocks for shifts along each side of the grid, of the cells and of coarse levels, and their side in cells.
_SAMPLES, _SIDE = (3, 2), 96
# Cells over which grey values are made alike.
_LOCAL = 9
# Side in cells of the windows, and the most steps of height between their cells, that shifts are found in.
_FLAT = 7, 2.0


@dataclass(frozen=True)
class Stack:
    """Many images and where they show the cells of a level; picklable."""

    images: tuple[Image, ...]
    ground: GroundViews
    config: Config
    ranges: LocalRanges | None

    @property
    def whole(self) -> Window:
        """Return all cells."""
        return Window(0, 0, *self.ground.shape)

    def around(self, core: Window) -> "Stack":
        """Return what matching a core needs: of a large grid it is a small part."""
        return replace(self, ground=self.ground.within(core.grown(_OVERLAP, _OVERLAP)))


class Surface(NamedTuple):
    """Winners of cells: float32 disparities ``(rows, columns)``, NaN for none; ambiguities, shares of the largest."""

    disparity: np.ndarray
    ambiguity: np.ndarray

    def sure(self, share: float) -> np.ndarray:
        """Return the cells but a share of those with the largest ambiguity."""
        known = np.isfinite(self.disparity)
        most = np.quantile(self.ambiguity[known], 1 - share) if known.any() else 0.0
        return np.asarray(known & (self.ambiguity <= most))


def level_config(config: Config, minimum: int, maximum: int) -> Config:
    """Return the settings of a level: winners and their ambiguities only."""
    changes = {"minimum": minimum, "maximum": maximum}
    return config.model_copy(
        update={
            "disparity": config.disparity.model_copy(update=changes),
            "tiles": config.tiles.model_copy(update={"size": _TILE, "overlap": _OVERLAP}),
            "interval": None,
            "regularization": None,
        }
    )


def match_core(stack: Stack, core: Window) -> Surface:
    """Match the cells of a core with an overlap; runs on a worker."""
    return _matched(stack, core)[0]


def _matched(stack: Stack, core: Window) -> tuple[Surface, Views]:
    frame = PatchFrame(core, stack.whole, stack.whole)
    cost = SweepCost(stack.config, Given(ground=stack.ground, ranges=stack.ranges))
    areas = patch_areas(frame, stack.config, stack.ranges)
    views = read_reduced_views(stack.images, cost.windows(areas), stack.ground.reductions)
    patch = match_patch(frame, cost.of_areas(views, areas), stack.config, ranges=stack.ranges)
    inner = core.relative_to(patch.output).slices
    disparity, ambiguity = patch.raw.disparity[inner], patch.raw.ambiguity[inner]
    surface = Surface(disparity, (ambiguity / stack.config.largest_ambiguity).astype(np.float32))
    return surface, views


def surface_of(stack: Stack, each: Each) -> Surface:
    """Match all cells of a level."""
    cores = [tile.core for tile in Grid(stack.whole, _TILE)]
    surface = Surface(*(np.full(stack.ground.shape, np.float32(np.nan)) for _ in Surface._fields))
    for i, found in each(match_core, [(stack.around(core), core) for core in cores], "heights"):
        for target, part in zip(surface, found, strict=True):
            target[cores[i].slices] = part
    return surface


def ranges_for(surface: Surface, stack: Stack, finer: Stack, factor: int) -> LocalRanges:
    """Return the ranges of blocks of a level ``factor`` times as fine, whose grid begins at the same corner.

    Blocks that no two images show have one height.
    """
    sure = surface.sure(_UNSURE[0])
    sure &= component_sizes(surface.disparity, sure) >= _SPECKLE
    disparity = median(surface.disparity, sure, 3)
    rows, columns = (-(-size // BLOCK) for size in finer.ground.shape)
    least, most = np.full((2, rows, columns), np.nan)
    side, beside = BLOCK // factor, _BESIDE[factor]
    for row in range(rows):
        for column in range(columns):
            around = Window(row * side, column * side, side, side).grown(beside, beside).clipped(stack.whole)
            here = disparity[around.slices][sure[around.slices]]
            if here.size:
                least[row, column], most[row, column] = here.min(), here.max()
    margin = _MARGIN[0] + _MARGIN[1] * (most - least)
    search, there, ground = finer.config.disparity, finer.ground, stack.ground
    least, most = (
        (ground.base - there.base + ground.step * end) / there.step for end in (least - margin, most + margin)
    )
    least, most = np.where(np.isnan(least), search.minimum, least), np.where(np.isnan(most), search.maximum, most)
    nobody = ~there.shown([(image.height, image.width) for image in finer.images])
    least[nobody] = most[nobody] = 0
    whole = (np.clip(end, search.minimum, search.maximum).astype(np.int16) for end in (np.floor(least), np.ceil(most)))
    first, last = whole
    return LocalRanges(first, last, BLOCK, BLOCK).clipped(search.minimum, search.maximum)


def sample_cores(whole: Window, most: int = _SAMPLES[0]) -> list[Window]:
    """Return blocks spread over a grid, ``most`` along each side."""
    starts = [
        sorted({round(first) for first in np.linspace(0, max(0, size - _SIDE), min(most, -(-size // _SIDE)))})
        for size in (whole.height, whole.width)
    ]
    return [Window(row, column, _SIDE, _SIDE).clipped(whole) for row in starts[0] for column in starts[1]]


def sample(stack: Stack, core: Window) -> Sample:
    """Match a core, and resample the images to its surface; runs on a worker."""
    surface, views = _matched(stack, core)
    disparity = np.nan_to_num(median(surface.disparity, np.isfinite(surface.disparity), 3))
    places = [stack.ground.positions(n, core, disparity) for n in range(len(views))]
    alike = np.stack([_alike(ortho(view, there)) for view, there in zip(views, places, strict=True)])
    cell = np.stack([[np.diff(there, axis=axis).mean(axis=(0, 1)) for axis in (0, 1)] for there in places])
    smooth = maximum_filter(disparity, _FLAT[0]) - minimum_filter(disparity, _FLAT[0]) <= _FLAT[1]
    place = np.array([core.row + core.height / 2, core.column + core.width / 2]) / stack.ground.shape - 0.5
    return Sample(place, alike.astype(np.float32), surface.sure(_UNSURE[1]) & smooth, cell.swapaxes(1, 2))


def samples_of(stack: Stack, each: Each, *, is_coarse: bool) -> list[Sample]:
    """Match sample blocks, and resample the images to them."""
    cores = sample_cores(stack.whole, _SAMPLES[is_coarse])
    found = dict(each(sample, [(stack.around(core), core) for core in cores], "shifts"))
    return [found[i] for i in range(len(cores))]


def _alike(values: np.ndarray) -> np.ndarray:
    """Return grey values without their local mean, over their local deviation; NaN near NaN."""
    usable = np.isfinite(values)
    filled = np.where(usable, values, 0).astype(np.float64)
    share = np.maximum(uniform_filter(usable.astype(float), _LOCAL), 1e-9)
    away = np.where(usable, filled - uniform_filter(filled, _LOCAL) / share, 0.0)
    deviation = np.sqrt(np.maximum(uniform_filter(away**2, _LOCAL) / share, 0))
    scale = deviation + 0.05 * (deviation[usable].mean() if usable.any() else 1.0) + 1e-9
    return np.where(usable, away / scale, np.nan)
