"""How far the rows of two images differ: a smooth function of the place, fitted to sample blocks of the pair."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.row_offsets import RowOffsets
from sat_intervals.match.coarse import Found, NoRangeError
from sat_intervals.match.sampling import BlockMatch
from sat_intervals.products import plain
from sat_intervals.tiling import Window

# Sample blocks that a constant and a plane need, and each further degree per coefficient.
_FEWEST, _PER_COEFFICIENT = 3, 4
# Share of the residual that a further degree must take away.
_BETTER = 0.7
# Steps of the fit, and the least scale of its residuals in pixels: residuals of twice the scale count half.
_STEPS, _SCALE = 30, 0.05
# Pixels of offset from which on rows are taken out, and that are searched.
_TAKEN, _MOST = 0.3, 12.0
# Pixels from the middle of a sample block to its rim.
_HALF = 128
# Share of matches of a sample block that sees the same ground in both images: in others up to .6 match by chance.
_MATCHED = 0.62
# Pixels of residual in a quarter of the sample blocks from which on they have jitter, and are no epipolar pair; and in
# half of them above which no polynomial holds, so that a constant is taken.
_JITTER = 0.3
_CONTRADICTING = 4.0
_HOLDING = 0.5


@dataclass(frozen=True)
class RowFit:
    """The row offsets of a pair with their evidence, in pixels.

    offsets, matches, most: the function, how many matches were measured, and its largest value in the region.
    before, after: median and 90 % quantile of the sizes of offsets of the samples, and of what is left of them.
    samples: row, column of the right image, offset, and what the function, fitted to the other half, leaves of it.
    share: of the samples that were measured, those that match; without any the others are here, to judge the pair.
    """

    offsets: RowOffsets
    matches: int
    most: float
    before: tuple[float, float]
    after: tuple[float, float]
    samples: tuple[tuple[float, float, float, float], ...]
    share: float

    @property
    def has_jitter(self) -> bool:
        """Return whether offsets are not smooth: detector joins, or oscillations of the satellite."""
        return self.share > 0 and self._scatter > _JITTER

    @property
    def _scatter(self) -> float:
        return float(np.quantile([abs(sample[3]) for sample in self.samples], 0.75))

    @property
    def farthest(self) -> float:
        """Return the largest offset that was measured, in pixels."""
        return max(abs(sample[2]) for sample in self.samples)

    @property
    def kind(self) -> str:
        """Return what was fitted, in words."""
        return "a smooth function" if len(self.offsets.coefficients) > 1 else "a constant"

    @property
    def contradiction(self) -> str | None:
        """Return why the pair is not epipolar, and the way out: offsets are large, or contradict each other."""
        if self.before[0] <= _MOST and self.most <= 2 * _MOST and self._scatter <= _CONTRADICTING:
            return None
        lower = np.median([sample[2] for sample in self.samples])
        return (
            f"not an epipolar pair: rows differ by {self.before[0]:.1f} px in the median, at most {self.farthest:.1f}, "
            f"and by {self.after[0]:.1f} px from {self.kind}, over {self.matches} matches; {_MOST:g} px are searched: "
            f"check that both images show the same place, crop or shift the right image, which lies {lower:.0f} rows "
            "lower, resample the pair, or give --rows none"
        )

    @classmethod
    def of_report(cls, report: Mapping[str, Any]) -> "RowFit":
        """Read what a report of a survey has of it."""
        offsets = RowOffsets.of_report(report["offsets"])
        pairs = {name: tuple(report[name]) for name in ("before", "after")}
        return cls(**dict(report) | pairs | {"offsets": offsets, "samples": tuple(map(tuple, report["samples"]))})


@dataclass(frozen=True)
class Survey:
    """What sample blocks of a region of the left image tell of a pair, over disparities ``search``.

    ``noise``, see `noise_of`, and ``rows`` are None if unknown.
    """

    region: Window
    search: tuple[int, int]
    noise: float | None
    rows: RowFit | None

    @property
    def is_large(self) -> bool:
        """Return whether row offsets are large enough to be taken out: below that, resampling costs more."""
        return self.rows is not None and self.rows.share > 0 and self.rows.most >= _TAKEN

    def missed(self, find: Callable[[], Found]) -> str:
        """Return a line if few blocks match, since the range that was given misses most of the matches to find."""
        with suppress(NoRangeError):
            if self.rows and self.rows.share < 0.5 and (share := (found := find()).share(*self.search)) < 0.5:
                return (
                    f"disparities {self.search[0]} to {self.search[1]} are searched, but have {100 * share:.0f} % of "
                    f"the matches, which are at {found.minimum} to {found.maximum}: give those, or leave out the range"
                )
        return ""

    def taken(self, rows: str, missed: str = "") -> RowOffsets | None:
        """Return the row offsets to take out by the setting ``rows``; raise if the pair is not epipolar."""
        if rows == "none" or self.rows is None:
            return None
        if line := missed or self.rows.contradiction:
            raise SatIntervalsError(line)
        return self.rows.offsets if self.is_large else None

    def report(self) -> dict[str, Any]:
        """Return the mapping that the store and run.json hold."""
        return dict(plain(asdict(self)))  # lists, as a file gives them back

    @classmethod
    def of_report(cls, report: Mapping[str, Any]) -> "Survey":
        """Read the mapping that `report` makes."""
        rows = report["rows"] and RowFit.of_report(report["rows"])
        return cls(Window(**report["region"]), tuple(report["search"]), report["noise"], rows)


def fit_rows(samples: Sequence[BlockMatch], rows: int, columns: int) -> RowFit | None:
    """Fit the row offsets of sample blocks of a pair; ``rows`` and ``columns`` are those of the right image."""
    # Of polynomials the one of the lowest degree is taken unless a higher one leaves clearly less in samples that it
    # was not fitted to; a constant where none holds. None with fewer than three samples.
    matching = [sample for sample in samples if sample.share >= _MATCHED]
    share, samples = len(matching) / max(1, len(samples)), matching or samples
    if len(samples) < _FEWEST:
        return None
    row, column, offset = np.array([(sample.row, sample.column, sample.rows) for sample in samples]).T
    nothing = RowOffsets((), rows, columns)
    counts = [1, *(count for count in (3, 6, 10) if len(samples) >= _PER_COEFFICIENT * count)]
    left = {count: _left_by_others(nothing.design(row, column, count), offset) for count in counts}
    best = counts[0]
    for count in counts[1:]:
        if np.median(np.abs(left[count])) < _BETTER * np.median(np.abs(left[best])):
            best = count
    best = best if np.median(np.abs(left[best])) <= _HOLDING else 1
    found = _fit(nothing.design(row, column, best), offset)
    offsets = RowOffsets(tuple(round(float(value), 6) for value in found), rows, columns)
    # the samples are the middles of blocks
    around = [
        np.linspace(max(0, places.min() - _HALF), min(size - 1, places.max() + _HALF), 9)
        for places, size in ((row, rows), (column, columns))
    ]
    most = float(np.abs(offsets.at(around[0][:, np.newaxis], around[1])).max())
    before, after = np.abs(offset), np.abs(left[best])
    places = np.stack([row, column, offset, left[best]], axis=1).round(3)
    return RowFit(
        offsets,
        sum(sample.number for sample in samples),
        round(most, 3),
        (_rounded(before, 0.5), _rounded(before, 0.9)),
        (_rounded(after, 0.5), _rounded(after, 0.9)),
        tuple(map(tuple, places.tolist())),
        round(share, 3),
    )


def _rounded(sizes: np.ndarray, share: float) -> float:
    return round(float(np.quantile(sizes, share)), 3)


def _left_by_others(design: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return what fits to one half of the samples leave of the offsets of the other half."""
    half = np.arange(len(offset)) % 2 == 0
    left = np.empty(len(offset))
    for part in (half, ~half):
        left[part] = offset[part] - design[part] @ _fit(design[~part], offset[~part])
    return left


def _fit(design: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Fit coefficients by least squares, reweighted (Cauchy) so that wrong samples hardly count."""
    weights = np.ones(len(offset))
    found: np.ndarray = np.zeros(design.shape[1])
    for _ in range(_STEPS):
        found = np.linalg.lstsq(design * weights[:, np.newaxis], offset * weights, rcond=None)[0]
        residual = offset - design @ found
        scale = max(_SCALE, 1.48 * float(np.median(np.abs(residual))))
        weights = np.asarray(1 / np.sqrt(1 + (residual / (2 * scale)) ** 2), np.float64)
    return found
