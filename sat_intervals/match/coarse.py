"""The search range of a pair, found by matching reduced images from coarse to fine (METHOD.md, section 17).

A level has its step: the images averaged over ``rows x columns`` pixels. The coarsest is searched widely, each finer
one within what the level before found. Disparities of a level are in its own pixels; times the step they are in pixels.
"""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.config import Config, load_config
from sat_intervals.config.sections import MOST_PIXELS
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.components import component_sizes
from sat_intervals.kernels.disparity import median
from sat_intervals.kernels.resampling import Step, reduced
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.whole import match_whole

# Columns of the coarsest level at most, and of the finest level at least by its step: larger steps are refined less,
# since there the time counts.
_TOP, _FINEST = 400, {2: 300, 4: 300, 8: 240}
# Rows of a level at least, where the image has them.
_ROWS = 100
# Share of the width that disparities of the coarsest level are first searched in, to both sides.
_REACH = 0.3
# Pixels of a connected surface at the coarsest level; smaller ones are stray matches. At finer levels it has more.
_SPECKLE = 60
# Share of the usable pixels that a surface needs to be trusted wherever it lies, and how far from such surfaces, in
# widths of their range and in pixels of the level, smaller ones may lie.
_LARGE = 0.005
_NEAR = 0.5
_NEAR_PIXELS = 8
# Share of matches beyond the range at each end, and the margin beyond it: pixels of the level, and widths of the range.
_BEYOND, _MARGIN = 0.0005, (2, 0.05)
_MARGIN_BETWEEN = 2, 0.1
# Share of matches at an end of what was searched above which the search goes on there, and how often at most.
_AT_END, _EXTENSIONS = 0.01, 3
# Share of usable pixels with a consistent match below which there is no range: unrelated images have at most .05,
# pairs have .7 and more.
_FEWEST = 0.1
# Bytes of the cost volume of a strip of a level, and its rows above and below that support it.
_STRIP_BYTES, _SUPPORT = 1 << 26, 16
_BINS = 32
# Side of a cell of the local ranges in pixels of the level, share of its usable pixels that must be matched, and the
# margin of its range: pixels of the level, and pixels.
_CELL = 32
_UNDERSTOOD = 0.2
_LOCAL_MARGIN = (2, 1)


class NoRangeError(SatIntervalsError):
    """The images have too few consistent matches to determine the search range."""


@dataclass(frozen=True)
class Level:
    """What was searched at a level, in pixels of the image, and the share of usable pixels that it matched."""

    step: int
    minimum: int
    maximum: int
    matched: float


@dataclass(frozen=True)
class Found:
    """A search range with its evidence.

    minimum, maximum: the range in pixels, both ends included.
    matched: share of the usable left pixels with a consistent match at the finest level.
    levels: from coarse to fine.
    histogram: matches of the finest level between the first and the last disparity: ``edges`` in pixels and ``counts``.
    undeclared: the value and share of pixels of the `undeclared_border` of an image, by side.
    cells: the local ranges, see `LocalRanges.report`.
    """

    minimum: int
    maximum: int
    matched: float
    levels: tuple[Level, ...]
    histogram: dict[str, list[float]] = field(default_factory=dict)
    undeclared: dict[str, Any] = field(default_factory=dict)
    cells: dict[str, Any] = field(default_factory=dict)

    @property
    def local(self) -> LocalRanges:
        """Return the local ranges."""
        return LocalRanges.of_report(self.cells)

    def fitted(self, columns: int) -> "Found":
        """Return the range cut to as many disparities as the right image has columns, where it has most matches."""
        if max(-self.minimum, self.maximum) > MOST_PIXELS:
            raise NoRangeError(
                f"disparities of {self.minimum} to {self.maximum} px, beyond {MOST_PIXELS}: crop or shift the images "
                "so that they are near 0"
            )
        beyond = max(0, self.maximum - self.minimum + 1 - columns)
        starts = self.minimum + np.arange(beyond + 1)
        shares = self.share(starts, starts + (self.maximum - self.minimum - beyond)).round(2)
        best = starts[shares == shares.max()]
        first = int(best[(len(best) - 1) // 2])
        return replace(self, minimum=first, maximum=first + self.maximum - self.minimum - beyond)

    def share(self, first: Any, last: Any) -> np.ndarray:
        """Return the share of the matches between disparities."""
        below, edges = np.cumsum([0, *self.histogram["counts"]]), self.histogram["edges"]
        return np.asarray((np.interp(last, edges, below) - np.interp(first, edges, below)) / below[-1])

    def report(self) -> dict[str, Any]:
        """Return the mapping that the store and run.json hold."""
        return asdict(self) | {"levels": [asdict(level) for level in self.levels]}

    @classmethod
    def of_report(cls, report: dict[str, Any]) -> "Found":
        """Read the mapping that `report` makes."""
        return cls(**report | {"levels": tuple(Level(**level) for level in report["levels"])})


def with_range(config: Config, found: Found) -> Config:
    """The settings with a range that was found."""
    ends = {"minimum": found.minimum, "maximum": found.maximum, "open_ends": True}
    return config.model_copy(update={"disparity": config.disparity.model_copy(update=ends)})


class Matches(NamedTuple):
    """Matches of a level.

    disparity: ``(rows, columns)`` float32 in pixels of the level.
    kept: bool of the same shape: consistent matches that belong to a surface.
    searched: first and last disparity searched, in pixels of the level.
    matched: share of the usable pixels that are kept.
    step, images: of the level; the left image and the right one.
    """

    disparity: np.ndarray
    kept: np.ndarray
    searched: tuple[int, int]
    matched: float
    step: Step
    images: tuple[np.ndarray, np.ndarray]


def finest_step(rows: int, columns: int) -> Step:
    """Step of the finest level of a pair of this size."""
    step = max((step for step, least in _FINEST.items() if columns >= step * least), default=1)
    return Step(min(step, _most_rows(rows)), step)


def _most_rows(rows: int) -> int:
    """Largest power of two that leaves `_ROWS` rows, at least 1."""
    return 1 << max(1, rows // _ROWS).bit_length() - 1


def _coarser(image: np.ndarray, step: Step) -> np.ndarray:
    """The next level of an image with NaN where not usable; ``step`` counts its pixels."""
    state = np.isnan(image)
    return reduced(np.where(state, np.float32(0), image), state.view(np.uint8), step)


def undeclared_border(image: np.ndarray, smallest: float) -> np.ndarray:
    """Pixels of a level that have only the smallest usable value and reach the border along a row or column: bool."""
    has = np.isclose(image, smallest, rtol=1e-6, atol=0) if np.isfinite(smallest) else np.zeros(image.shape, bool)
    found = np.zeros(image.shape, bool)
    for axis in (0, 1):
        for flipped in (slice(None), slice(None, None, -1)):
            turn = (flipped, slice(None)) if axis == 0 else (slice(None), flipped)
            found[turn] |= np.logical_and.accumulate(has[turn], axis)
    return found


def find_range(left: np.ndarray, right: np.ndarray, step: Step, shape: tuple[int, int]) -> tuple[Found, Matches]:
    """Find the search range of a pair.

    left, right: both images at the finest level, of `finest_step`: float32, NaN where not usable; of as many rows.
    shape: rows and columns of the left image itself.
    Returns the range, and the matches of the finest level that has as many as the coarser ones.
    """
    pyramid = [(step, left, right)]
    while max(pyramid[-1][1].shape[1], pyramid[-1][2].shape[1]) > _TOP:
        here, left, right = pyramid[-1]
        more = Step(2 if 2 * here.rows <= min(2 * here.columns, _most_rows(shape[0])) else 1, 2)
        there = Step(here.rows * more.rows, here.columns * more.columns)
        pyramid.append((there, _coarser(left, more), _coarser(right, more)))
    levels: list[Level] = []
    matches, search = None, None
    for here, left, right in reversed(pyramid):
        speckle = _SPECKLE * pyramid[-1][0].columns // here.columns
        found = _matches_of(left, right, search, speckle)._replace(step=here)
        first, last = found.searched
        levels.append(Level(here.columns, first * here.columns, last * here.columns, round(found.matched, 4)))
        if found.matched < (_FEWEST if matches is None else matches.matched / 2):
            break
        matches = found
        search = np.array(_range_of(found, _MARGIN_BETWEEN)) * here.columns / max(1, here.columns // 2)
    if matches is None:
        top = levels[0]
        raise NoRangeError(
            f"only {100 * top.matched:.0f} % of the pixels have a consistent match between disparities {top.minimum} "
            f"and {top.maximum} in images reduced by a factor of {top.step}, {100 * _FEWEST:.0f} % are needed"
        )
    size = matches.step.columns
    low, high = (size * end for end in _range_of(matches, _MARGIN))
    counts, edges = np.histogram(matches.disparity[matches.kept] * size, _BINS)
    histogram = {"edges": [round(float(edge), 2) for edge in edges], "counts": counts.tolist()}
    minimum, maximum = int(np.floor(low)), int(np.ceil(high))
    cells = _local(matches, minimum, maximum, shape).report()
    return Found(minimum, maximum, round(matches.matched, 4), tuple(levels), histogram, cells=cells), matches


def _local(matches: Matches, minimum: int, maximum: int, shape: tuple[int, int]) -> LocalRanges:
    """Local ranges from the matches of a level: those of a cell and its neighbours, with a margin."""
    # Cells without enough matches get the whole range, cells without a usable pixel the range of their neighbours.
    rows, columns = (-(-side // (_CELL * size)) for side, size in zip(shape, matches.step, strict=True))

    def in_cells(values: np.ndarray, nothing: Any) -> np.ndarray:
        whole = np.full((rows * _CELL, columns * _CELL), nothing, values.dtype)
        whole[: values.shape[0], : values.shape[1]] = values
        return whole.reshape(rows, _CELL, columns, _CELL)

    usable = in_cells(np.isfinite(matches.images[0]), False).sum(axis=(1, 3))
    kept = in_cells(matches.kept, False)
    disparity = in_cells(matches.disparity, 0)
    low = _with_neighbours(np.where(kept, disparity, np.inf).min(axis=(1, 3))).min(axis=(2, 3))
    high = _with_neighbours(np.where(kept, disparity, -np.inf).max(axis=(1, 3))).max(axis=(2, 3))
    unknown = ((kept.sum(axis=(1, 3)) < _UNDERSTOOD * usable) & (usable > 0)) | (low > high)
    size = matches.step.columns
    least = np.floor(np.where(unknown, minimum, low * size - _LOCAL_MARGIN[0] * size - _LOCAL_MARGIN[1]))
    most = np.ceil(np.where(unknown, maximum, high * size + _LOCAL_MARGIN[0] * size + _LOCAL_MARGIN[1]))
    least, most = (np.clip(bound, minimum, maximum).astype(np.int16) for bound in (least, most))
    return LocalRanges(least, most, _CELL * matches.step.rows, _CELL * size)


def _with_neighbours(values: np.ndarray) -> np.ndarray:
    """Each value and its eight neighbours: ``(rows, columns, 3, 3)``."""
    return np.lib.stride_tricks.sliding_window_view(np.pad(values, 1, mode="edge"), (3, 3))


def settings(first: int, last: int) -> Config:
    """Settings that a level is matched with over the disparities ``first .. last``: Census, no intervals."""
    changes = {"ambiguity": {"eta_step": 0.1, "normalization": "range"}, "interval": None, "regularization": None}
    return load_config({"preset": "paper", "disparity": {"minimum": first, "maximum": last}} | changes)


def _matches_of(left: np.ndarray, right: np.ndarray, search: np.ndarray | None, speckle: int) -> Matches:
    """Match a level; search further where many matches stand at an end of what was searched."""
    # ``search`` is None at the coarsest level: there the second search is that of all disparities.
    most = 1 - left.shape[1], right.shape[1] - 1
    reach, wider = int(_REACH * left.shape[1]), right.shape[1] - left.shape[1]
    ends = (min(0, wider) - reach, max(0, wider) + reach) if search is None else search
    first, last = max(most[0], int(np.floor(ends[0]))), min(most[1], int(np.ceil(ends[1])))
    for _ in range(_EXTENSIONS):
        found = match_level(left, right, (first, last), speckle)
        values = found.disparity[found.kept]
        low = first > most[0] and (values <= first + 1).sum() > _AT_END * values.size
        high = last < most[1] and (values >= last - 1).sum() > _AT_END * values.size
        if search is None and (low or high or found.matched < _FEWEST) and (first, last) != most:
            first, last = most
        elif search is not None and (low or high):
            more = max(4, (last - first) // 2)
            first, last = max(most[0], first - more * bool(low)), min(most[1], last + more * bool(high))
        else:
            break
    return found


def match_level(left: np.ndarray, right: np.ndarray, searched: tuple[int, int], speckle: int) -> Matches:
    """Match float32 images, NaN where not usable, strip by strip; remove surfaces of less than ``speckle`` pixels."""
    first, last = searched
    usable = np.count_nonzero(np.isfinite(left))
    config = settings(first, last)
    rows, columns = left.shape
    strip = max(64, _STRIP_BYTES // (2 * columns * (last - first + 32)))
    images = [np.ma.masked_invalid(image) for image in (left, right)]
    disparity = np.empty(left.shape, np.float32)
    for row in range(0, rows, strip):
        top, stop = max(0, row - _SUPPORT), min(rows, row + strip)
        found = match_whole(images[0][top : stop + _SUPPORT], images[1][top : stop + _SUPPORT], config)
        # Confidence 0: the pixel and all its candidates have no texture.
        known = found.valid & (found.confidence > 0)
        disparity[row:stop] = np.where(known, found.disparity, np.nan)[row - top : stop - top]
    known = np.isfinite(disparity)
    disparity = np.nan_to_num(disparity)
    steady = known & (np.abs(disparity - median(disparity, known, 3)) <= 1)
    sizes = component_sizes(disparity, steady)
    kept = steady & (sizes >= speckle)
    large = kept & (sizes >= _LARGE * usable)
    if large.any():
        low, high = np.quantile(disparity[large], [_BEYOND, 1 - _BEYOND])
        near = _NEAR * (high - low) + _NEAR_PIXELS
        kept &= (disparity >= low - near) & (disparity <= high + near)
    return Matches(disparity, kept, (first, last), float(kept.sum() / max(1, usable)), Step(1, 1), (left, right))


def _range_of(found: Matches, margin: tuple[float, float]) -> tuple[float, float]:
    """Range of the matches of a level with a margin, within what was searched; in pixels of the level."""
    first, last = found.searched
    values = found.disparity[found.kept]
    inner = values[(values > first + 1) & (values < last - 1)]  # an end gathers the matches of what lies beyond it
    low, high = np.quantile(inner if inner.size else values, [_BEYOND, 1 - _BEYOND])
    more = margin[0] + margin[1] * (high - low)
    return max(low - more, float(first)), min(high + more, float(last))
