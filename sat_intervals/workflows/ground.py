"""Find what a sweep of many images needs: grid, heights, shifts of the images, pairs, and ranges of heights."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from sat_intervals.config import Config, Sweep
from sat_intervals.errors import SatIntervalsError
from sat_intervals.heights.models import SensorImage
from sat_intervals.heights.point_cloud import Cells
from sat_intervals.heights.shifts import Fits, aligned, correlations, tilted
from sat_intervals.heights.stack import Stack, Surface, level_config, ranges_for, samples_of, surface_of
from sat_intervals.heights.views import common_cells, undulation_at, views_of, with_pairs
from sat_intervals.kernels.components import component_sizes
from sat_intervals.match.ground import BLOCK, GroundViews
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.prepare.pair import Each
from sat_intervals.raster import Projection

# Factors of the cells of levels, and cells along a side of a level at least.
_FACTORS, _LEAST = (512, 128, 32, 8, 2), 48
# Share of the cells of the coarsest level that are too doubtful for the range of heights: roofs are among the next.
_DOUBTFUL = 0.1
_SPECKLE = 3  # cells of one height, at least: stray winners of three images made the range seven times as wide
# Share of the cells of the coarsest level beyond the range of heights at each end; its margin: steps, and a share.
_BEYOND, _MARGIN = 0.005, (3, 0.15)
# Rounds of matching and shifts at a level, and the shifts after which there is no other, in pixels of the level.
_ROUNDS, _SMALL = 2, 0.4
# Share of the median correlation below which an image is not like the others.
_UNLIKE = 0.4
# Images that a sweep needs.
FEWEST = 3


@dataclass(frozen=True)
class GroundPlan:
    """All that is found before the tiles of a sweep.

    sensors: the images that are used; ``left_out``: those whose shift could not be found.
    ranges: None of a scene too small for coarse levels.
    fits: what adds to positions in the images; ``alike``: correlation of each image with the others.
    """

    sensors: list[SensorImage]
    left_out: list[SensorImage]
    cells: Cells
    ground: GroundViews
    config: Config
    ranges: LocalRanges | None
    fits: Fits
    alike: np.ndarray


class _Search:
    """Images whose shifts and heights are searched from coarse to fine."""

    def __init__(self, sensors: Sequence[SensorImage], projection: Projection, config: Config, each: Each) -> None:
        assert isinstance(config.cost, Sweep)
        self.sensors, self.projection, self.config, self.each = list(sensors), projection, config, each
        self.cost, self.shifts, self.alike = config.cost, np.zeros((len(sensors), 2)), np.ones(len(sensors))
        self.slopes, self.left = np.zeros((len(sensors), 2, 2)), np.full(len(sensors), np.nan)

    def stack(self, cells: Cells, factor: int, heights: tuple[float, float]) -> Stack:
        """Return the stack of a level; its step is half a pixel of parallax of its widest pair, if it is not given."""
        rows, columns = -(-cells.rows // factor), -(-cells.columns // factor)
        level = replace(cells, resolution=cells.resolution * factor, rows=rows, columns=columns)
        images = tuple(one.image for one in self.sensors)
        ground = views_of(self.sensors, self.projection, level, heights, self.shifts)
        ground, ratio = with_pairs(ground, [image.path for image in images], level.resolution, self.cost.pairs)
        step = self.cost.step * factor if self.cost.step else 0.5 * level.resolution / ratio
        base = step * round((heights[0] + heights[1]) / 2 / step)
        first, last = int(np.floor((heights[0] - base) / step)), int(np.ceil((heights[1] - base) / step))
        return Stack(images, replace(ground, base=base, step=step), level_config(self.config, first, last), None)

    def align(self, stack: Stack, *, is_coarse: bool) -> Stack:
        """Find shifts, in rounds while they are large, at last planes; return the stack with them."""
        reductions = stack.ground.reductions
        for is_last in [False] * (_ROUNDS - 1) + [True]:
            samples = samples_of(stack, self.each, is_coarse=is_coarse)
            found, self.alike = aligned(samples, reductions), correlations(samples)
            if is_last or np.abs(found).max() < _SMALL * min(reductions):
                break
            stack = self._moved(stack, found)
        if is_coarse:
            return self._moved(stack, found)
        found, self.slopes, self.left = tilted(samples, found, reductions)
        stack = self._moved(stack, found)
        return replace(stack, ground=stack.ground.tilted(self.slopes))

    @property
    def unlike(self) -> np.ndarray:
        """Return which images are not like the others, but not those that show too few of the samples."""
        middle = np.nanmedian(self.alike) if np.isfinite(self.alike).any() else np.nan
        return np.asarray(self.alike < _UNLIKE * middle)

    def _moved(self, stack: Stack, shifts: np.ndarray) -> Stack:
        self.shifts = self.shifts + shifts
        return replace(stack, ground=stack.ground.shifted(shifts))

    def descend(self, cells: Cells, heights: tuple[float, float]) -> Stack:
        """Match levels from coarse to fine, until one shows an unlike image; return the last, which is not matched."""
        before: tuple[Stack, Surface, int] | None = None
        for factor in [*_factors(cells), 1]:
            stack = self.stack(cells, factor, heights)
            if before:
                coarse, surface, coarser = before
                stack = replace(stack, ranges=ranges_for(surface, coarse, stack, coarser // factor))
            stack = self.align(stack, is_coarse=factor > 1)
            if self.unlike.any():
                break
            if factor > 1:
                before = stack, surface_of(stack, self.each), factor
        return stack


def found_ground(
    sensors: Sequence[SensorImage],
    projection: Projection,
    resolution: float,
    config: Config,
    each: Each,
    heights: tuple[float, float] | None = None,
    grid: Cells | None = None,
) -> GroundPlan:
    """Find grid, heights, shifts and ranges of images; ``heights`` and ``grid`` if they are given.

    Images that are not like the others on the surface, such as clouds or another place, are left out.
    """
    up = undulation_at(sensors, projection)
    for one, height in product(sensors, heights or ()):
        one.check_height(height + up)
    search, left_out = _Search(sensors, projection, config, each), list[SensorImage]()
    while True:
        domain = heights or _domain(search.sensors, up)
        cells = common_cells(search.sensors, projection, domain, resolution, grid)
        found = heights
        if found is None:
            top = search.stack(cells, [*_factors(cells), 1][0], domain)
            found = _heights_of(surface_of(top, each), top, domain)
            cells = common_cells(search.sensors, projection, found, resolution, grid)
        stack = search.descend(cells, found)
        unlike = search.unlike
        if not unlike.any():
            break
        left_out += [one for one, is_unlike in zip(search.sensors, unlike, strict=True) if is_unlike]
        kept = [one for one, is_unlike in zip(search.sensors, unlike, strict=True) if not is_unlike]
        if len(kept) < FEWEST:
            raise SatIntervalsError(
                f"{', '.join(one.image.path for one in left_out)}: not like the others on the ground (clouds, or "
                f"another place), and without them {len(kept)} images are left: give more images of this place"
            )
        search = _Search(kept, projection, config, each)
    config = config.model_copy(update={"disparity": stack.config.disparity})
    stack = _on_grid(stack, cells, grid) if grid else stack
    fits = Fits(search.shifts, search.slopes, search.left)
    return GroundPlan(search.sensors, left_out, grid or cells, stack.ground, config, stack.ranges, fits, search.alike)


def _on_grid(stack: Stack, cells: Cells, grid: Cells) -> Stack:
    """Return the stack of some blocks of a grid as that of all; the others, which nobody sees, have one height."""
    side, shape = BLOCK * grid.resolution, (grid.rows, grid.columns)
    first = round((grid.top - cells.top) / side), round((cells.left - grid.left) / side)
    inner = [-(-size // BLOCK) for size in stack.ground.shape]
    around = [(one, -(-whole // BLOCK) - one - size) for one, whole, size in zip(first, shape, inner, strict=True)]
    search, ranges = stack.config.disparity, stack.ranges
    ends: list[Any] = [ranges.minimum, ranges.maximum] if ranges else [search.minimum, search.maximum]
    least, most = (np.pad(np.broadcast_to(end, inner), around).astype(np.int16) for end in ends)
    ground = replace(stack.ground, first=first, shape=shape)
    return replace(stack, ground=ground, ranges=LocalRanges(least, most, BLOCK, BLOCK))


def _domain(sensors: Sequence[SensorImage], up: float) -> tuple[float, float]:
    """Return the heights that all models have in common, above the geoid if there is one."""
    lowest, highest = (max(one.heights[0] for one in sensors), min(one.heights[1] for one in sensors))
    if lowest >= highest:
        raise SatIntervalsError("the models of the images have no heights in common: give heights")
    return lowest - up, highest - up


def _factors(cells: Cells) -> list[int]:
    side = min(cells.rows, cells.columns)
    return [factor for factor in _FACTORS if side >= _LEAST * factor]


def _heights_of(surface: Surface, stack: Stack, domain: tuple[float, float]) -> tuple[float, float]:
    """Return the range of the heights of most cells of a level, in metres."""
    sure = surface.sure(_DOUBTFUL)
    found = surface.disparity[sure & (component_sizes(surface.disparity, sure) >= _SPECKLE)]
    if not found.size:
        raise SatIntervalsError(
            "nowhere on the grid do two images show the same ground: check the grid, no-data values and masks"
        )
    low, high = np.quantile(found, [_BEYOND, 1 - _BEYOND])
    margin = _MARGIN[0] + _MARGIN[1] * (high - low)
    ground = stack.ground
    low, high = (ground.base + ground.step * float(end) for end in (low - margin, high + margin))
    return max(low, domain[0]), min(high, domain[1])
