"""How far the rows of two images differ: a smooth function of the place, fitted to looks at blocks of the pair."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.rows import RowOffsets
from sat_intervals.match.sampling import Look, noise_of
from sat_intervals.products import plain
from sat_intervals.tiling import Window

# Looks that a constant and a plane need, and each further degree per coefficient.
_FEWEST, _PER_COEFFICIENT = 3, 4
# Share of the residual that a further degree must take away.
_BETTER = 0.7
# Steps of the fit, and the least scale of its residuals in pixels: residuals of twice the scale count half.
_STEPS, _SCALE = 30, 0.05
# Pixels of offset from which on rows are taken out, and that are searched.
_TAKEN, _MOST = 0.3, 12.0
# Pixels from the middle of a look to the rim of its block.
_HALF = 128
# Pixels of residual that a smooth function should not leave in a quarter of the looks, or in half of them.
_JITTER, _CONTRADICTING = 0.3, 0.5


@dataclass(frozen=True)
class RowFit:
    """The row offsets of a pair with their evidence.

    Attributes
    ----------
    offsets
        The function.
    matches
        Number of matches that were measured.
    most
        Largest offset in the region, in pixels.
    before, after
        Median and 90 % quantile of the sizes of offsets of the looks, and of what the function leaves of them, each
        fitted to the other half of the looks, in pixels.
    looks
        Row, column of the right image, offset, and what the function, fitted to the other half, leaves of it, in
        pixels, of each look.
    """

    offsets: RowOffsets
    matches: int
    most: float
    before: tuple[float, float]
    after: tuple[float, float]
    looks: tuple[tuple[float, float, float, float], ...]

    @property
    def has_jitter(self) -> bool:
        """Return whether offsets are not smooth: detector joins, or oscillations of the satellite."""
        return bool(np.quantile([abs(look[3]) for look in self.looks], 0.75) > _JITTER)

    @property
    def contradiction(self) -> str | None:
        """Return why the pair is not epipolar: offsets are larger than is searched, or contradict each other."""
        before, after = self.before[0], self.after[0]
        if before <= _MOST and self.most <= 2 * _MOST and after <= _CONTRADICTING:
            return None
        return (
            f"not an epipolar pair: rows differ by {before:.1f} px in the median, up to {self.most:.1f} px, and by "
            f"{after:.1f} px from a smooth function, over {self.matches} matches; {_MOST:g} px are searched"
        )

    @property
    def way_out(self) -> str:
        """Return what to do about a `contradiction`."""
        if self.after[0] > _CONTRADICTING:
            return (
                "leave out the search range if it is given, check that both images show the same place, resample the "
                "pair, or give --rows none"
            )
        return f"crop or shift the right image, which lies {np.median([look[2] for look in self.looks]):.0f} rows lower"

    @classmethod
    def of_report(cls, report: Mapping[str, Any]) -> "RowFit":
        """Read what a report of a survey has of it."""
        offsets = RowOffsets.of_report(report["offsets"])
        pairs = {name: tuple(report[name]) for name in ("before", "after")}
        return cls(**dict(report) | pairs | {"offsets": offsets, "looks": tuple(map(tuple, report["looks"]))})


@dataclass(frozen=True)
class Survey:
    """What looks at blocks of a region of the left image tell of a pair, over disparities ``search``.

    ``noise``, see `noise_of`, and ``rows`` are None if unknown.
    """

    region: Window
    search: tuple[int, int]
    noise: float | None
    rows: RowFit | None

    @classmethod
    def of_looks(
        cls, region: Window, search: tuple[int, int], looks: Sequence[Look], shape: tuple[int, int]
    ) -> "Survey":
        """Return what looks tell of a pair whose right image has so many rows and columns; see `fit_rows`."""
        return cls(region, search, noise_of(looks), fit_rows(looks, *shape))

    @property
    def is_large(self) -> bool:
        """Return whether row offsets are large enough to be taken out: below that, resampling costs more."""
        return self.rows is not None and self.rows.most >= _TAKEN

    def taken(self, rows: str) -> RowOffsets | None:
        """Return the row offsets to take out by the setting ``rows``; raise if the pair is not epipolar."""
        if rows == "none" or self.rows is None:
            return None
        if line := self.rows.contradiction:
            raise SatIntervalsError(f"{line}: {self.rows.way_out}")
        return self.rows.offsets if self.is_large else None

    def report(self) -> dict[str, Any]:
        """Return the mapping that the store and run.json hold."""
        report: dict[str, Any] = plain(asdict(self))  # lists, as a file gives them back
        return report

    @classmethod
    def of_report(cls, report: Mapping[str, Any]) -> "Survey":
        """Read the mapping that `report` makes."""
        rows = report["rows"] and RowFit.of_report(report["rows"])
        return cls(Window(**report["region"]), tuple(report["search"]), report["noise"], rows)


def fit_rows(looks: Sequence[Look], rows: int, columns: int) -> RowFit | None:
    """Fit the row offsets of looks at a pair; ``rows`` and ``columns`` are those of the right image.

    Of polynomials the one of the lowest degree is taken unless a higher one leaves clearly less in looks that it was
    not fitted to. None with fewer than three looks.
    """
    if len(looks) < _FEWEST:
        return None
    row, column, offset = np.array([(look.row, look.column, look.rows) for look in looks]).T
    nothing = RowOffsets((), rows, columns)
    counts = [1, *(count for count in (3, 6, 10) if len(looks) >= _PER_COEFFICIENT * count)]
    left = {count: _left_by_others(nothing.design(row, column, count), offset) for count in counts}
    best = counts[0]
    for count in counts[1:]:
        if np.median(np.abs(left[count])) < _BETTER * np.median(np.abs(left[best])):
            best = count
    found = _fit(nothing.design(row, column, best), offset)
    offsets = RowOffsets(tuple(round(float(value), 6) for value in found), rows, columns)
    # the looks are the middles of blocks
    around = [
        np.linspace(max(0, places.min() - _HALF), min(size - 1, places.max() + _HALF), 9)
        for places, size in ((row, rows), (column, columns))
    ]
    most = float(np.abs(offsets.at(around[0][:, np.newaxis], around[1])).max())
    before, after = np.abs(offset), np.abs(left[best])
    places = np.stack([row, column, offset, left[best]], axis=1).round(3)
    return RowFit(
        offsets,
        sum(look.number for look in looks),
        round(most, 3),
        (_rounded(before, 0.5), _rounded(before, 0.9)),
        (_rounded(after, 0.5), _rounded(after, 0.9)),
        tuple(map(tuple, places.tolist())),
    )


def _rounded(sizes: np.ndarray, share: float) -> float:
    return round(float(np.quantile(sizes, share)), 3)


def _left_by_others(design: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return what fits to one half of the looks leave of the offsets of the other half."""
    half = np.arange(len(offset)) % 2 == 0
    left = np.empty(len(offset))
    for part in (half, ~half):
        left[part] = offset[part] - design[part] @ _fit(design[~part], offset[~part])
    return left


def _fit(design: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Fit coefficients by least squares, reweighted (Cauchy) so that wrong looks hardly count."""
    weights = np.ones(len(offset))
    found: np.ndarray = np.zeros(design.shape[1])
    for _ in range(_STEPS):
        found = np.linalg.lstsq(design * weights[:, np.newaxis], offset * weights, rcond=None)[0]
        residual = offset - design @ found
        scale = max(_SCALE, 1.48 * float(np.median(np.abs(residual))))
        weights = np.asarray(1 / np.sqrt(1 + (residual / (2 * scale)) ** 2), np.float64)
    return found
