"""How noisy a pair is, and how far its rows differ: matches of sample windows at full resolution.

Letters: r row, c column.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.kernels.cost import Codes, census
from sat_intervals.match.search_range import Matches, Step, match_level, reduced, settings
from sat_intervals.match.whole import cut, match_whole
from sat_intervals.tiling import View, Views, Window, facing

# Side of a window in pixels of the image, and windows along each side of the image; side in pixels of the part of a
# level that determines the row offset.
_SIDE, _WINDOWS, _PART = 64, 2, 128
# Rows up and down that are tried, and the box over which costs are summed.
ROWS, _BOX = 2, 9
# Side of the middle of a tile that is looked at, what it is reduced by first, and pixels of a surface there.
_MIDDLE, _STEP, _SPECKLE = 192, Step(4, 4), 40
# Matches of a window that are needed at least.
_FEWEST = 200
_CENSUS, _BITS = 5, 24
# Distance of the random candidates that a match is compared with, in columns.
_AWAY = 16


class Sample(NamedTuple):
    """A window to look at.

    left: window of the left image.
    minimum, maximum: disparities to search there.
    rows: rows by which the right window lies lower, rounded from the row offset of the coarse matches.
    """

    left: Window
    minimum: int
    maximum: int
    rows: int

    @property
    def views(self) -> tuple[Window, Window]:
        """Windows of both images that `look` needs."""
        margin = _CENSUS // 2
        right = Window(self.left.row + self.rows, self.left.column + self.minimum, *self._shape).grown(ROWS, 0)
        return self.left.grown(margin, margin), right.grown(margin, margin)

    @property
    def _shape(self) -> tuple[int, int]:
        return self.left.height, self.left.width + self.maximum - self.minimum


class Look(NamedTuple):
    """Figures of a window: number of matches, their mean distance, that of random candidates, and the row offset."""

    number: int
    matched: float
    random: float
    rows: float


def samples(matches: Matches, rows: float) -> list[Sample]:
    """Windows spread over the image, where enough is matched; ``rows`` is the row offset of the coarse matches."""
    step = matches.step
    height, width = max(1, _SIDE // step.rows), max(1, _SIDE // step.columns)
    shares = _shares(matches.kept, height, width)
    found = []
    for part in _parts(shares.shape):
        there = shares[part.slices]
        usual = np.median(there[there > 0.5]) if (there > 0.5).any() else 1.0  # not the easiest windows of all
        place = np.unravel_index(np.argmin(np.abs(there - usual)), there.shape)
        r, c = (part.row + int(place[0])) * height, (part.column + int(place[1])) * width
        here = np.s_[r : r + height, c : c + width]
        values = matches.disparity[here][matches.kept[here]] * step.columns
        if values.size * 2 > height * width:
            low, high = np.quantile(values, [0.02, 0.98])
            window = Window(r * step.rows, c * step.columns, height * step.rows, width * step.columns)
            more = 2 * step.columns + 2
            found.append(Sample(window, int(low) - more, int(high) + more, round(rows)))
    return found


def _shares(kept: np.ndarray, height: int, width: int) -> np.ndarray:
    """Share of kept pixels in each block of ``height x width`` pixels."""
    rows, columns = kept.shape[0] // height, kept.shape[1] // width
    inner = kept[: rows * height, : columns * width]
    return np.asarray(inner.reshape(rows, height, columns, width).mean(axis=(1, 3)))


def _parts(number: tuple[int, int]) -> Iterable[Window]:
    """Parts of a grid of windows, `_WINDOWS` along each side if it has so many."""
    ends = [np.linspace(0, count, min(_WINDOWS, count) + 1).astype(int) for count in number]
    for top, bottom in zip(ends[0], ends[0][1:], strict=False):
        for first, last in zip(ends[1], ends[1][1:], strict=False):
            yield Window(int(top), int(first), int(bottom - top), int(last - first))


def look(sample: Sample, left: tuple[np.ndarray, np.ndarray], right: tuple[np.ndarray, np.ndarray]) -> Look | None:
    """Match a sample; ``left`` and ``right`` are pixels and states of its views. None if too little is matched."""
    here, there = (np.ma.array(pixels, mask=state != 0) for pixels, state in (left, right))
    margin = _CENSUS // 2
    config = settings(0, sample.maximum - sample.minimum)
    found = match_whole(here, there[ROWS:-ROWS], config)
    inner = slice(margin, -margin), slice(margin, -margin)
    known = (found.valid & (found.confidence > 0))[inner]
    index = np.rint(np.nan_to_num(found.disparity[inner])).astype(int)
    codes = census(*left, _CENSUS), census(*right, _CENSUS)
    return _look(codes, index, known, sample.rows)


def _look(codes: tuple[Codes, Codes], index: np.ndarray, known: np.ndarray, rows: int) -> Look | None:
    """Figures of the matches of a window; ``rows`` is how much lower the right codes were read."""
    offsets = row_offsets(*codes, index, known)
    if known.sum() < _FEWEST or not offsets.size:
        return None
    matched = _distances(*codes, index, ROWS)[known]
    width = codes[1].state.shape[1]
    column = np.arange(index.shape[1])
    random = _distances(*codes, (index + _AWAY + column) % width - column, ROWS)[known]
    return Look(int(known.sum()), float(matched.mean()), float(random.mean()), rows + float(np.median(offsets)))


def row_offsets(left: Codes, right: Codes, index: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Rows by which the right image lies lower, one figure for each match that determines it.

    left, right: codes; the right ones have `ROWS` rows more at both ends, and ``right[r + ROWS, c + k]`` faces
        ``left[r, c]``.
    index: ``(rows, columns)`` integers: k of each match.
    known: bool of the same shape: the matches.
    """
    shifted = np.stack([index - 1, index, index + 1])[:, np.newaxis]
    rows = np.arange(2 * ROWS + 1)[:, np.newaxis, np.newaxis]
    stack = _boxed(_distances(left, right, shifted, rows), known).min(axis=0)
    best = np.argmin(stack, axis=0)
    told = known & np.isfinite(stack[0]) & (stack.min(axis=0) < np.median(stack, axis=0))
    at = np.clip(best, 1, 2 * ROWS - 1)[np.newaxis]
    before, here, after = (np.take_along_axis(stack, at + step, axis=0)[0] for step in (-1, 0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = (before - after) / (2 * (np.maximum(before, after) - here))  # as V-fit
    inner = (best > 0) & (best < 2 * ROWS)
    return np.asarray((best - ROWS + np.where(inner, np.nan_to_num(shift), 0))[told])


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


def coarse_rows(left: np.ndarray, right: np.ndarray, matches: Matches) -> float:
    """Rows of the image by which the right image is lower, from a part of a level; 0 if its matches do not show it."""
    height, width = (min(_PART, side) for side in left.shape)
    shares = _shares(matches.kept, height, width)
    place = np.unravel_index(np.argmax(shares), shares.shape)
    part = Window(int(place[0]) * height, int(place[1]) * width, height, width)
    index = np.rint(matches.disparity[part.slices]).astype(int)
    known = matches.kept[part.slices]
    if not known.any():
        return 0.0
    first, last = int(index[known].min()) - 1, int(index[known].max()) + 1
    margin, facing = _CENSUS // 2, Window(part.row, part.column + first, height, width + last - first)
    codes = (
        census(*_cut(_view(left), part.grown(margin, margin)), _CENSUS),
        census(*_cut(_view(right), facing.grown(margin + ROWS, margin)), _CENSUS),
    )
    offsets = row_offsets(*codes, index - first, known)
    return float(np.median(offsets)) * matches.step.rows if offsets.size else 0.0


def _cut(view: View, window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and states of a window, which may leave the view."""
    return cut(view, window)[1:]


def _view(image: np.ndarray) -> View:
    """View of an image with NaN where not usable."""
    return View(Window(0, 0, *image.shape), np.nan_to_num(image), np.isnan(image).view(np.uint8))


def look_in_tile(views: Views, core: Window, minimum: int, maximum: int) -> list[Look]:
    """Estimate noise and row offset of the pair from the middle of a tile, ``core``, over a search range."""
    row, column = (max(0, (side - _MIDDLE) // 2) for side in (core.height, core.width))
    middle = Window(core.row + row, core.column + column, *(min(_MIDDLE, side) for side in (core.height, core.width)))
    there = facing(middle, minimum, maximum)
    left, right = (reduced(*_cut(view, window), _STEP) for view, window in zip(views, (middle, there), strict=True))
    if 0 in left.shape:
        return []
    matches = match_level(left, right, (0, (maximum - minimum) // _STEP.columns), _SPECKLE)._replace(step=_STEP)
    looks = []
    for sample in samples(matches, coarse_rows(left, right, matches)):
        windows = [
            Window(middle.row + one.row, first + one.column, one.height, one.width)
            for one, first in zip(sample.views, (middle.column, there.column), strict=True)
        ]
        looks.append(look(sample, *(_cut(view, window) for view, window in zip(views, windows, strict=True))))
    return [found for found in looks if found is not None]


def summary(looks: Iterable[Look | None]) -> dict[str, Any]:
    """Noise and row offset of a pair from its samples; None if no window determines them.

    ``noise`` is the mean distance of matches over that of random candidates; ``row_offset`` has the median size of the
    windows' offsets in rows, positive where the right image lies lower.
    """
    told = [found for found in looks if found is not None]
    if not told:
        return {"noise": None, "row_offset": None}
    weights = np.array([found.number for found in told], float)
    matched = np.average([found.matched for found in told], weights=weights)
    random = np.average([found.random for found in told], weights=weights)
    size = np.median([abs(found.rows) for found in told])
    sign = np.sign(np.median([found.rows for found in told])) or 1.0
    return {"noise": round(float(matched / random), 3), "row_offset": round(float(sign * size), 2)}
