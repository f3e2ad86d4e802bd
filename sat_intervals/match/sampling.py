"""Match blocks spread over a pair at full resolution: how noisy it is, and how far its rows differ."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from sat_intervals.kernels.cost import Codes, census
from sat_intervals.kernels.resampling import Step, reduced
from sat_intervals.kernels.row_offsets import shift_equations
from sat_intervals.match.coarse import Matches, match_level, settings
from sat_intervals.match.whole import cut, match_whole
from sat_intervals.tiling import View, Window, facing

# Side of a block, and blocks along each side of the image at most; side of its part that is matched at full resolution.
_SIDE = 256
_BLOCKS = 5
_PART = 96
# What a block is reduced by first, the pixels of a surface there, and the rows of that level that are tried first.
_STEP = Step(4, 4)
_SPECKLE = 40
_MOST = 4
# Rows up and down that are tried at a level, and the box over which costs are summed.
_ROWS, _BOX = 2, 9
# Side of the cells in which rows are tried first.
_CELL = 8
# Matches of a level and of a part that are needed at least.
_FEWEST_COARSE, _FEWEST = 100, 500
_CENSUS, _BITS = 5, 24
# Share of matches that a pixel of a level farther from the middle of a block must be worth.
_AWAY_FROM_MIDDLE = 0.0005
# Distance of the random candidates that a match is compared with, in columns.
_AWAY = 16
# Least-squares windows: pixels between centres, from the centre to the sides, and the share that must be matched.
_BETWEEN = 4
_RADIUS = 4
_MATCHED = 0.5
# Gain of a likely window, the largest shift that is believed, shifts that are enough, and steps.
_LIKELY = 0.2
_FARTHEST = 1.5
_ENOUGH = 30
_STEPS = 3


class SampleBlock(NamedTuple):
    """A block of the left image to match, and the disparities to search there."""

    left: Window
    minimum: int
    maximum: int

    @property
    def views(self) -> tuple[Window, Window]:
        """Return the windows of both images that `block_match` needs."""
        return self.left, facing(self.left, self.minimum, self.maximum).grown(_MOST * _STEP.rows, 0)


class BlockMatch(NamedTuple):
    """Figures of a block.

    row, column: middle of the part that was matched, row of the left and column of the right image.
    number, share: matches there, and their share of its pixels.
    matched, random: mean distances of their codes, and of those of random candidates.
    rows: median of the rows by which the right image lies lower, in pixels.
    """

    row: float
    column: float
    number: int
    share: float
    matched: float
    random: float
    rows: float


def sample_blocks(region: Window, minimum: int, maximum: int) -> list[SampleBlock]:
    """Return blocks spread over a region of the left image, to be searched over a range of disparities."""
    rows, columns = _starts(region.row, region.height), _starts(region.column, region.width)
    blocks = (Window(row, column, _SIDE, _SIDE).clipped(region) for row in rows for column in columns)
    return [SampleBlock(block, minimum, maximum) for block in blocks]


def _starts(first: int, size: int) -> list[int]:
    """Return where blocks begin along a side of a region; they share at most three quarters of their pixels."""
    number = min(_BLOCKS, max(1, 4 * size // _SIDE - 3))
    return [first + max(0, size - _SIDE) * i // max(1, number - 1) for i in range(number)]


def block_match(sample: SampleBlock, left: View, right: View) -> BlockMatch | None:
    """Match the views of a block coarsely, then a part at full resolution; None if too little is matched."""
    if (coarse := _coarse(left, right)) is None:
        return None
    matches, rows = coarse
    part, first, last = _part(matches, sample.left)
    here = cut(left, part)
    for _ in range(3):
        there = Window(part.row + rows, part.column + sample.minimum + first, part.height, part.width + last - first)
        found = _fine(here, cut(right, there.grown(4, 4)), sample.minimum + first)
        if found is None:
            return None
        if abs(found.rows) <= 0.5:  # of rows farther apart too little is matched well
            row, column = part.row + (part.height - 1) / 2, found.column + part.column + (part.width - 1) / 2
            return found._replace(row=row, column=column, rows=rows + found.rows)
        rows += round(found.rows)
    return None


def _coarse(left: View, right: View) -> tuple[Matches, int] | None:
    """Return matches of a reduced block, and the rows of the image by which the right one lies lower there."""
    here, there = (reduced(view.pixels, view.state, _STEP) for view in (left, right))
    last = there.shape[1] - here.shape[1]
    if min(here.shape) < _CELL or last < 0:
        return None
    rows = _likeliest_rows(here, there)
    there = there[_MOST + rows : _MOST + rows + len(here)]
    matches = match_level(here, there, (0, last), _SPECKLE)
    offsets = _coarse_offsets(here, there, matches) if matches.kept.sum() >= _FEWEST_COARSE else np.empty(0)
    if not offsets.size:
        return None
    return matches._replace(step=_STEP), round(_STEP.rows * (rows + float(np.median(offsets))))


def _likeliest_rows(left: np.ndarray, right: np.ndarray) -> int:
    """Return the rows of a level, whose right image has `_MOST` more at both ends, at which candidates fit best."""
    # Each cell of some pixels has the candidate, one disparity for all, whose codes differ least.
    margin = _CENSUS // 2
    views = (_view(image) for image in (left, right))
    here, there = (census(*cut(view, view.window.grown(margin, margin))[1:], _CENSUS) for view in views)
    rows, columns = (size // _CELL * _CELL for size in left.shape)
    words = np.lib.stride_tricks.sliding_window_view(there.words[0], columns, axis=1)
    states = np.lib.stride_tricks.sliding_window_view(there.state, columns, axis=1)
    fits = []
    for row in range(2 * _MOST + 1):
        differ = np.bitwise_count(here.words[0][:rows, np.newaxis, :columns] ^ words[row : row + rows])
        differ[states[row : row + rows] != 0] = _BITS
        cells = differ.reshape(rows // _CELL, _CELL, differ.shape[1], columns // _CELL, _CELL)
        fits.append(cells.sum(axis=(1, 4), dtype=np.int64).min(axis=1).mean())
    return int(np.argmin(fits)) - _MOST


def _coarse_offsets(left: np.ndarray, right: np.ndarray, matches: Matches) -> np.ndarray:
    """Return rows of a level by which the right image lies lower, of the matches that determine them."""
    index = np.rint(matches.disparity).astype(int)
    first, last = int(index[matches.kept].min()) - 1, int(index[matches.kept].max()) + 1
    there = Window(0, first, left.shape[0], left.shape[1] + last - first)
    margin, views = _CENSUS // 2, (_view(left), _view(right))
    codes = (
        census(*cut(views[0], views[0].window.grown(margin, margin))[1:], _CENSUS),
        census(*cut(views[1], there.grown(margin + _ROWS, margin))[1:], _CENSUS),
    )
    return row_offsets(*codes, index - first, matches.kept)


def _part(matches: Matches, block: Window) -> tuple[Window, int, int]:
    """Return the part of a block where most is matched, rather in its middle, and the range of disparities there."""
    side = min(_PART // _STEP.rows, *matches.kept.shape)
    shares = np.lib.stride_tricks.sliding_window_view(matches.kept, (side, side)).mean(axis=(2, 3))
    away = [np.abs(np.arange(size) - (size - 1) / 2) for size in shares.shape]
    score = shares - _AWAY_FROM_MIDDLE * np.maximum(away[0][:, np.newaxis], away[1])
    r, c = map(int, np.unravel_index(np.argmax(score), score.shape))
    here = np.s_[r : r + side, c : c + side]
    low, high = np.quantile(matches.disparity[here][matches.kept[here]] * _STEP.columns, [0.02, 0.98])
    part = Window(block.row + r * _STEP.rows, block.column + c * _STEP.columns, side * _STEP.rows, side * _STEP.columns)
    more = 2 * _STEP.columns
    return part, int(low) - more, int(high) + more


def _fine(left: View, right: View, minimum: int) -> BlockMatch | None:
    """Match a part; ``right`` is grown by 4 pixels. The column is the median disparity. None with too few matches."""
    inner = right.cropped(right.window.grown(-4, -4))
    here, there = (np.ma.array(view.pixels, mask=view.state != 0) for view in (left, inner))
    found = match_whole(here, there, settings(0, inner.window.width - left.window.width))
    known = found.valid & (found.confidence > 0)
    if known.sum() < _FEWEST:
        return None
    disparity = np.nan_to_num(found.disparity).astype(np.float64)
    shift, margin = 0.0, _CENSUS // 2
    for _ in range(_STEPS):
        pixels = left.pixels.astype(np.float64), right.pixels.astype(np.float64)
        shifts = _shifts(*shift_equations(*pixels, disparity, known, shift, _BETWEEN, _RADIUS))
        if shifts.size < _ENOUGH:
            return None
        before, shift = shift, float(np.clip(shift + np.median(shifts), -_FARTHEST, _FARTHEST))
        if abs(shift - before) < 0.01:
            break
    codes = census(left.pixels, left.state, _CENSUS), census(inner.pixels, inner.state, _CENSUS)
    where = known[margin:-margin, margin:-margin]
    index = np.rint(disparity).astype(int)[margin:-margin, margin:-margin]
    matched = _distances(*codes, index, 0)[where].mean()
    column = np.arange(index.shape[1])
    random = _distances(*codes, (index + _AWAY + column) % codes[1].state.shape[1] - column, 0)[where].mean()
    middle = float(np.median(disparity[known])) + minimum
    return BlockMatch(0.0, middle, int(known.sum()), float(known.mean()), float(matched), float(random), shift)


def _shifts(equations: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the likely row shifts of `shift_equations` in pixels."""
    enough = pixels >= _MATCHED * (2 * _RADIUS + 1) ** 2
    matrix, side = equations[enough, :, :4], equations[enough, :, 4:]
    sizes = np.einsum("nii->ni", matrix) ** 0.5
    sizes[sizes == 0] = 1
    matrix, side = matrix / sizes[:, :, np.newaxis] / sizes[:, np.newaxis], side / sizes[:, :, np.newaxis]
    solvable = np.linalg.det(matrix) > 1e-6
    found = np.linalg.solve(matrix[solvable], side[solvable])[..., 0] / sizes[solvable]
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = found[:, 3] / found[:, 0]
    return np.asarray(shift[(found[:, 0] > _LIKELY) & (np.abs(shift) < _FARTHEST)])


def row_offsets(left: Codes, right: Codes, index: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Rows by which the right image lies lower, one figure for each match that determines it.

    left, right: codes; the right ones have `_ROWS` rows more at both ends, and ``right[r + _ROWS, c + k]`` faces
        ``left[r, c]``.
    index: ``(rows, columns)`` integers: k of each match.
    known: bool of the same shape: the matches.
    """
    shifted = np.stack([index - 1, index, index + 1])[:, np.newaxis]
    rows = np.arange(2 * _ROWS + 1)[:, np.newaxis, np.newaxis]
    stack = _boxed(_distances(left, right, shifted, rows), known).min(axis=0)
    best = np.argmin(stack, axis=0)
    told = known & np.isfinite(stack[0]) & (stack.min(axis=0) < np.median(stack, axis=0))
    at = np.clip(best, 1, 2 * _ROWS - 1)[np.newaxis]
    before, here, after = (np.take_along_axis(stack, at + step, axis=0)[0] for step in (-1, 0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = (before - after) / (2 * (np.maximum(before, after) - here))  # as V-fit
    inner = (best > 0) & (best < 2 * _ROWS)
    return np.asarray((best - _ROWS + np.where(inner, np.nan_to_num(shift), 0))[told])


def _distances(left: Codes, right: Codes, index: np.ndarray, rows: np.ndarray | int) -> np.ndarray:
    """Hamming distances of left codes from the right ones ``index`` columns and ``rows`` rows further, as float32.

    ``index`` is ``(..., rows, columns)``; ``rows`` is a number or an array with two last axes of length 1.
    """
    height, width = index.shape[-2:]
    column = np.clip(np.arange(width) + index, 0, right.state.shape[1] - 1)
    row = np.arange(height)[:, np.newaxis] + rows
    differ = np.bitwise_count(left.words[0] ^ right.words[0][row, column]).astype(np.float32)
    return np.where(right.state[row, column] == 0, differ, np.float32(_BITS))


def _boxed(costs: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Mean over the known pixels of a box around each pixel; of arrays ``(..., rows, columns)``."""
    radius = _BOX // 2

    def sums(values: np.ndarray) -> np.ndarray:
        height, width = values.shape[-2:]
        total = np.zeros((*values.shape[:-2], height + _BOX, width + _BOX))
        total[..., radius + 1 : height + radius + 1, radius + 1 : width + radius + 1] = values
        total = total.cumsum(-2).cumsum(-1)
        high, low = total[..., _BOX:, :], total[..., :-_BOX, :]
        return np.asarray(high[..., _BOX:] - low[..., _BOX:] - high[..., :-_BOX] + low[..., :-_BOX])

    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(sums(np.where(known, costs, 0)) / sums(known))


def _view(image: np.ndarray) -> View:
    """View of an image with NaN where not usable."""
    return View(Window(0, 0, *image.shape), np.nan_to_num(image), np.isnan(image).view(np.uint8))


def noise_of(samples: Iterable[BlockMatch]) -> float | None:
    """Return the mean distance of matches over that of random candidates; None without samples."""
    if not (told := list(samples)):
        return None
    weights = np.array([found.number for found in told], float)
    matched = np.average([found.matched for found in told], weights=weights)
    random = np.average([found.random for found in told], weights=weights)
    return round(float(matched / random), 3)
