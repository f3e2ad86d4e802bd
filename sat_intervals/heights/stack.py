"""Match many images coarsely: a surface of a level, the ranges of the next one, and shifts of the images."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.disparity import median
from sat_intervals.kernels.resampling import resample
from sat_intervals.kernels.row_offsets import AFTER, BEFORE
from sat_intervals.match.ground import BLOCK, GroundViews
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.matching_cost import Given
from sat_intervals.match.patch import PatchFrame, match_patch, patch_areas
from sat_intervals.match.sweep import SweepCost
from sat_intervals.prepare.pair import Each
from sat_intervals.raster import Image, read_reduced_views
from sat_intervals.tiling import Grid, View, Views, Window

try:
    from scipy.ndimage import maximum_filter, minimum_filter, shift, uniform_filter
except ModuleNotFoundError as error:
    raise SatIntervalsError("sensor models need shareloc: pip install 'sat-intervals[dsm]'") from error

# Cells of a tile of a level, and around it that support it.
_TILE, _OVERLAP = 256, 16
# Share of the cells of a level, of lowest confidence, that neither ranges nor shifts are made of.
_UNSURE = 0.1, 0.3
# Cells of a level around a block of the next one that its range is made of, and the margin of the range: steps of the
# level, and a share of the range.
_BESIDE, _MARGIN = 4, (2, 0.1)
# Sample blocks for shifts along each side of the grid, of the cells and of coarse levels, and their side in cells.
_SAMPLES, _SIDE = (3, 2), 96
# Cells of sample blocks that an image must show to be compared with the others.
_FEWEST = 500
# Cells over which grey values are made alike.
_LOCAL = 9
# Side in cells of the windows, and the most steps of height between their cells, that shifts are found in.
_FLAT = 7, 2.0
# Steps of least squares, and pixels of a step that are enough.
_STEPS, _ENOUGH = 8, 0.01
# Pixels that a shift leaves from which an image gets a plane, and the largest condition of its equations.
_MUCH, _SOLVABLE = 0.3, 1e4
# Reduction from which a level is coarse, and pixels of such a level that a shift has at least to be believed.
_COARSE, _TOLD = 4, 0.5


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
    disparity = median(surface.disparity, sure, 3)
    rows, columns = (-(-size // BLOCK) for size in finer.ground.shape)
    least, most = np.full((2, rows, columns), np.nan)
    side = BLOCK // factor
    for row in range(rows):
        for column in range(columns):
            around = Window(row * side, column * side, side, side).grown(_BESIDE, _BESIDE).clipped(stack.whole)
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


class Sample(NamedTuple):
    """Images resampled to the surface of a core.

    place: row and column of its middle, in sizes of the grid from the grid's middle.
    alike: ``(images, rows, columns)`` float32: grey values made alike, NaN where not usable.
    sure: bool ``(rows, columns)``.
    cell: ``(images, 2, 2)``: how rows and columns in an image change along rows and columns of cells.
    """

    place: np.ndarray
    alike: np.ndarray
    sure: np.ndarray
    cell: np.ndarray


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


class Fits(NamedTuple):
    """What adds to the positions of images, in pixels; the mean of all images is 0.

    shift: ``(images, 2)``: rows and columns.
    slope: ``(images, 2, 2)``: rows and columns more at the last row, and at the last column, of the grid than at the
        first.
    left: ``(images,)``: what is left on sample blocks, root mean square; NaN of images that show too little.
    """

    shift: np.ndarray
    slope: np.ndarray
    left: np.ndarray


def aligned(stack: Stack, samples: Sequence[Sample]) -> np.ndarray:
    """Return shifts ``(images, 2)`` that add to positions, pixels with mean 0.

    Least squares between each image and the median of the others on sample blocks of the surface. A shift for each
    image is what Fraser and Hanley (2003) found that RPC models need.
    """
    shifts = np.zeros((len(stack.images), 2))
    for _ in range(_STEPS):
        sums = np.sum([_equations(one, shifts) for one in samples], axis=0)
        step = np.zeros_like(shifts)
        solvable = np.linalg.det(sums[:, :, :2]) > 0
        step[solvable] = np.linalg.solve(sums[solvable, :, :2], sums[solvable, :, 2:])[..., 0]
        shifts += step - step.mean(axis=0)
        if np.abs(step).max() <= _ENOUGH:
            break
    reduction = np.array(stack.ground.reductions)[:, None]
    is_fine = np.linalg.norm(shifts, axis=1, keepdims=True) >= _TOLD * (reduction >= _COARSE)
    shifts = np.where(is_fine, shifts, 0.0) * reduction
    return np.asarray(shifts - shifts.mean(axis=0))


def tilted(stack: Stack, samples: Sequence[Sample], shifts: np.ndarray) -> Fits:
    """Return planes of the images of which shifts ``(images, 2)`` leave much, and what is left of all.

    Planes are what Fraser and Hanley (2003) need where the attitude drifts. They are least squares over all blocks.
    """
    reduction, places = np.array(stack.ground.reductions), np.array([[1.0, *one.place] for one in samples])
    planes = np.zeros((len(stack.images), 3, 2))  # in the middle, and along rows and columns; reduced pixels
    planes[:, 0] = shifts / reduction[:, None]
    sums, left = _left_by(planes, samples, places)
    before = left * reduction
    for _ in range(_STEPS if (before > _MUCH).any() else 0):
        whole = np.einsum("si,snkl,sj->nikjl", places, sums[..., :2], places).reshape(-1, 6, 6)
        right = np.einsum("si,snk->nik", places, sums[..., 2]).reshape(-1, 6, 1)
        step, solvable = np.zeros_like(planes), np.linalg.cond(whole) < _SOLVABLE
        step[solvable] = np.linalg.solve(whole[solvable], right[solvable]).reshape(-1, 3, 2)
        planes += step
        sums, left = _left_by(planes, samples, places)
        if np.abs(step).max() <= _ENOUGH:
            break
    needed = (before > _MUCH) & (left * reduction < before / 2)
    planes = planes * reduction[:, None, None]
    planes[~needed, 0], planes[~needed, 1:] = shifts[~needed], 0.0
    planes -= planes.mean(axis=0)
    return Fits(planes[:, 0], planes[:, 1:], np.where(needed, left * reduction, before))


def _left_by(planes: np.ndarray, samples: Sequence[Sample], places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the equations of all blocks beyond planes, ``(blocks, images, 2, 3)``, and what planes leave of images.

    That is the root mean square of what each block alone finds, weighted by what its grey values tell.
    """
    sums = np.array([_equations(one, at @ planes) for one, at in zip(samples, places, strict=True)])
    solvable = np.linalg.det(sums[..., :2]) > 0
    total, weight = np.zeros(sums.shape[:2]), np.where(solvable, np.trace(sums[..., :2], axis1=2, axis2=3) / 2, 0.0)
    steps = np.linalg.solve(sums[solvable, :, :2], sums[solvable, :, 2:])
    total[solvable] = (steps * sums[solvable, :, 2:]).sum(axis=(1, 2))
    known = weight.sum(axis=0)
    return sums, np.sqrt(total.sum(axis=0) / np.where(known > 0, known, np.nan))


def correlations(samples: Sequence[Sample]) -> np.ndarray:
    """Return the correlation of each image with the median of the others, NaN where it shows too few cells."""
    products = []
    for one in samples:
        for n, (own, middle) in enumerate(zip(one.alike, medians_of_others(one.alike), strict=True)):
            seen = one.sure & np.isfinite(own) & np.isfinite(middle)
            of_cells = (own * middle)[seen].sum(), (own**2)[seen].sum(), (middle**2)[seen].sum(), seen.sum()
            products.append((n, *of_cells))
    sums = np.zeros((len(samples[0].alike), 4))
    for n, *parts in products:
        sums[n] += parts
    found = sums[:, 0] / np.sqrt(np.maximum(sums[:, 1] * sums[:, 2], 1e-9))
    return np.where(sums[:, 3] >= _FEWEST, found, np.nan)


def _equations(one: Sample, shifts: np.ndarray) -> np.ndarray:
    """Return the normal equations of a step beyond shifts (reduced pixels), ``(images, 2, 3)``."""
    to_cells = np.linalg.inv(one.cell)
    moved = np.stack(
        [
            shift(values, -cells @ by, order=1, cval=np.nan)
            for values, cells, by in zip(one.alike, to_cells, shifts, strict=True)
        ]
    )
    result = np.zeros((len(moved), 2, 3))
    for n, (own, middle) in enumerate(zip(moved, medians_of_others(moved), strict=True)):
        along = np.stack(np.gradient(middle), axis=-1)
        seen = one.sure & np.isfinite(own) & np.isfinite(along).all(axis=-1)
        slope, miss = along[seen] @ to_cells[n], (middle - own)[seen]
        weighted = slope / (1 + miss**2)[:, None]
        result[n, :, :2], result[n, :, 2] = weighted.T @ slope, weighted.T @ miss
    return result


def ortho(view: View, places: np.ndarray) -> np.ndarray:
    """Return an image resampled to positions of cells, ``(rows, columns, 2)``, see `GroundViews.positions`."""
    nodes = np.pad(places, ((0, 1), (0, 1), (0, 0)), mode="edge")
    around = Window.around(places.min(axis=(0, 1)) - BEFORE, places.max(axis=(0, 1)) + AFTER + 1)
    pixels = np.full((around.height, around.width), np.float32(np.nan))
    inside = around.clipped(view.window)
    if inside.height and inside.width:
        pixels[inside.relative_to(around).slices] = view.pixels[inside.relative_to(view.window).slices]
    return np.asarray(resample(pixels, (around.row, around.column), nodes, 1, (0, 0), *places.shape[:2]))


def _alike(values: np.ndarray) -> np.ndarray:
    """Return grey values without their local mean, over their local deviation; NaN near NaN."""
    usable = np.isfinite(values)
    filled = np.where(usable, values, 0).astype(np.float64)
    share = np.maximum(uniform_filter(usable.astype(float), _LOCAL), 1e-9)
    away = np.where(usable, filled - uniform_filter(filled, _LOCAL) / share, 0.0)
    deviation = np.sqrt(np.maximum(uniform_filter(away**2, _LOCAL) / share, 0))
    scale = deviation + 0.05 * (deviation[usable].mean() if usable.any() else 1.0) + 1e-9
    return np.where(usable, away / scale, np.nan)


def medians_of_others(values: np.ndarray) -> Iterator[np.ndarray]:
    """Yield for each item of the first axis the median of the others, without NaN; where it is itself NaN, NaN."""
    ordered, count = np.sort(values, axis=0), np.isfinite(values).sum(axis=0) - 1  # of the others
    # without a value the order is that of all, one further from the value on
    ends = [
        [
            np.take_along_axis(ordered, np.clip(place + more, 0, len(values) - 1)[np.newaxis], axis=0)[0]
            for more in (0, 1)
        ]
        for place in ((count - 1) // 2, count // 2)
    ]
    for own in values:
        low, high = (np.where(here < own, here, following) for here, following in ends)
        yield np.where(np.isfinite(own), (low + high) / 2, np.nan)


def median_of(values: np.ndarray) -> np.ndarray:
    """Return the median along the first axis, without NaN; much faster than `numpy.nanmedian`."""
    ordered, count = np.sort(values, axis=0), np.isfinite(values).sum(axis=0)
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1)
    return np.asarray(np.take_along_axis(ordered, np.stack([low, high]), axis=0).mean(axis=0))
