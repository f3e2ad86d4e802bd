"""Count pixels of the final bands, strip by strip, for run.json."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sat_intervals.products import FLAGS, INVALID, RANGE_END, RANGE_INCOMPLETE, REGULARIZED, Bands, cause

# Widths are counted in steps of a hundredth of a pixel.
_WIDTH_STEP = 0.01


class Tally:
    """Counts over the pixels of a run."""

    def __init__(self, count: int, minimum: int = 0) -> None:
        """``count``: number of disparities, so one more than the widest interval; ``minimum``: the first."""
        self._middle = minimum + (count - 1) / 2
        self._ends = np.zeros(2, np.int64)
        # Histogram of the sums of flags, from which all counts follow.
        self._sums = np.zeros(1 << (max(flag.bit for flag in FLAGS) + 1), np.int64)
        self._agreement = np.zeros(2, np.int64)
        self._widths = np.zeros(round(count / _WIDTH_STEP) + 1, np.int64)
        self._whole = round((count - 1) / _WIDTH_STEP)

    def add(self, bands: Bands) -> None:
        """Count some rows."""
        self._sums += np.bincount(bands.validity.ravel(), minlength=self._sums.size)
        # beside missing data of the right image, winners stand at an end because the true candidate is impossible
        at_end = bands.validity & (RANGE_END | RANGE_INCOMPLETE) == RANGE_END
        ends = bands.disparity[bands.valid & at_end]
        self._ends += np.count_nonzero(ends < self._middle), np.count_nonzero(ends >= self._middle)
        self._agreement += np.count_nonzero(bands.agreement == 0), np.count_nonzero(bands.agreement == 1)
        width = (bands.upper - bands.lower)[bands.valid]
        width = np.rint(width[np.isfinite(width)] / np.float32(_WIDTH_STEP)).astype(np.int32)
        widest = self._widths.size - 1  # bounds that a calibration of heights has moved may be farther apart
        self._widths += np.bincount(np.minimum(width, widest), minlength=self._widths.size)

    def counts(self) -> dict[str, list[list[int]]]:
        """Return all counts, each with its place; `merge` adds them."""
        found = {name: getattr(self, f"_{name}") for name in ("ends", "agreement", "sums", "widths")}
        return {
            name: [[int(place), int(counts[place])] for place in np.flatnonzero(counts)]
            for name, counts in found.items()
        }

    def merge(self, counts: Mapping[str, Sequence[Sequence[int]]]) -> None:
        """Add what another tally of the same range has counted, see `counts`."""
        for name, there in counts.items():
            for place, count in there:
                getattr(self, f"_{name}")[place] += count

    def _count(self, wanted: np.ndarray) -> int:
        """Pixels whose sum of flags is wanted."""
        return int(self._sums[wanted].sum())

    def report(self) -> dict[str, Any]:
        """Counts of pixels, and the median width in pixels, None where there is no interval.

        ``ambiguous``: valid, as wide as the search range. ``flags`` counts a pixel under each of its flags, ``causes``
        each invalid pixel once, see `products.cause`: with ``valid`` they sum to ``pixels``.
        """
        upto = np.cumsum(self._widths)
        median = round(float(np.searchsorted(upto, upto[-1] / 2) * _WIDTH_STEP), 2) if upto[-1] else None
        sums = np.arange(self._sums.size)
        valid, causes = sums & INVALID == 0, cause(sums)
        return {
            "pixels": int(self._sums.sum()),
            "valid": self._count(valid),
            "ambiguous": int(self._widths[self._whole :].sum()),
            "low_confidence": self._count(valid & (sums & REGULARIZED != 0)),
            "flags": {flag.name: self._count(sums & flag.value != 0) for flag in FLAGS},
            "causes": {flag.name: self._count(causes == flag.value) for flag in FLAGS if flag.invalid},
            "range_ends": {"minimum": int(self._ends[0]), "maximum": int(self._ends[1])},
            "agreement": {"outside": int(self._agreement[0]), "inside": int(self._agreement[1])},
            "median_interval_width": median,
        }
