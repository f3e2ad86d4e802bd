"""Find what must be added to positions in images so that they fit each other on a surface (METHOD.md, section 20)."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sat_intervals.errors import SatIntervalsError

try:
    from scipy.ndimage import shift
except ModuleNotFoundError as error:
    raise SatIntervalsError("sensor models need shareloc: pip install 'sat-intervals[dsm]'") from error

# Cells of sample blocks that an image must show to be compared with the others.
_FEWEST = 500
# Steps of least squares, and pixels of a step that are enough.
_STEPS, _ENOUGH = 8, 0.01
# Reduced pixels that a shift leaves from which an image gets a plane, blocks that it needs, and the largest condition
# of its equations.
_MUCH, _BLOCKS, _SOLVABLE = 0.3, 6, 1e4
# Reduction from which a level is coarse, and pixels of such a level that a shift has at least to be believed.
_COARSE, _TOLD = 4, 0.5


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


def aligned(samples: Sequence[Sample], reductions: Sequence[int]) -> np.ndarray:
    """Return shifts ``(images, 2)`` that add to positions, pixels with mean 0.

    Least squares between each image and the median of the others on sample blocks of the surface. A shift for each
    image is what Fraser and Hanley (2003) found that RPC models need.
    """
    shifts = np.zeros((len(reductions), 2))
    for _ in range(_STEPS):
        sums = np.sum([_equations(one, shifts) for one in samples], axis=0)
        step = np.zeros_like(shifts)
        solvable = np.linalg.det(sums[:, :, :2]) > 0
        step[solvable] = np.linalg.solve(sums[solvable, :, :2], sums[solvable, :, 2:])[..., 0]
        shifts += step - step.mean(axis=0)
        if np.abs(step).max() <= _ENOUGH:
            break
    reduction = np.array(reductions)[:, None]
    is_fine = np.linalg.norm(shifts, axis=1, keepdims=True) >= _TOLD * (reduction >= _COARSE)
    shifts = np.where(is_fine, shifts, 0.0) * reduction
    return np.asarray(shifts - shifts.mean(axis=0))


def tilted(samples: Sequence[Sample], shifts: np.ndarray, reductions: Sequence[int]) -> Fits:
    """Return planes of the images of which shifts ``(images, 2)`` leave much, and what is left of all.

    Planes are what Fraser and Hanley (2003) need where the attitude drifts. They are least squares over all blocks.
    """
    reduction, places = np.array(reductions), np.array([[1.0, *one.place] for one in samples])
    start = np.zeros((len(reductions), 3, 2))  # in the middle, and along rows and columns; reduced pixels
    start[:, 0] = shifts / reduction[:, None]
    _, before, blocks = _left_by(start, samples, places)
    planes, left, free = start, before, (before > _MUCH) & (blocks >= _BLOCKS)
    while free.any():
        planes = _planes(start, free, samples, places)
        _, left, _ = _left_by(planes, samples, places)
        helped = free & (left < before / 2)
        if (helped == free).all():
            break
        planes, left, free = start, before, helped
    planes = planes * reduction[:, None, None]
    planes -= planes.mean(axis=0)
    return Fits(planes[:, 0], planes[:, 1:], left * reduction)


def _planes(start: np.ndarray, free: np.ndarray, samples: Sequence[Sample], places: np.ndarray) -> np.ndarray:
    """Return the planes of least squares of the images that are ``free``, those of the others as they were."""
    planes = start.copy()
    for _ in range(_STEPS):
        sums, _, _ = _left_by(planes, samples, places)
        whole = np.einsum("si,snkl,sj->nikjl", places, sums[..., :2], places).reshape(-1, 6, 6)
        right = np.einsum("si,snk->nik", places, sums[..., 2]).reshape(-1, 6, 1)
        step, solvable = np.zeros_like(planes), free & (np.linalg.cond(whole) < _SOLVABLE)
        step[solvable] = np.linalg.solve(whole[solvable], right[solvable]).reshape(-1, 3, 2)
        planes += step
        if np.abs(step).max() <= _ENOUGH:
            break
    return planes


def _left_by(
    planes: np.ndarray, samples: Sequence[Sample], places: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the equations of all blocks beyond planes, ``(blocks, images, 2, 3)``, and what planes leave of images.

    That is the root mean square of what each block alone finds, weighted by what its grey values tell. Also return the
    number of blocks that tell something of each image.
    """
    sums = np.array([_equations(one, at @ planes) for one, at in zip(samples, places, strict=True)])
    solvable = np.linalg.det(sums[..., :2]) > 0
    total, weight = np.zeros(sums.shape[:2]), np.where(solvable, np.trace(sums[..., :2], axis1=2, axis2=3) / 2, 0.0)
    steps = np.linalg.solve(sums[solvable, :, :2], sums[solvable, :, 2:])
    total[solvable] = (steps * sums[solvable, :, 2:]).sum(axis=(1, 2))
    known = weight.sum(axis=0)
    return sums, np.sqrt(total.sum(axis=0) / np.where(known > 0, known, np.nan)), solvable.sum(axis=0)


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
