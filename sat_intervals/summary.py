"""What a run says of itself in figures, gathered from the final bands strip by strip."""

from typing import Any

import numpy as np

from sat_intervals.products import FLAGS, INVALID, REGULARIZED

# Widths are counted in steps of a hundredth of a pixel.
_WIDTH_STEP = 0.01


class Tally:
    """Counts over the pixels of a run."""

    def __init__(self, count: int) -> None:
        """``count``: number of disparities, so one more than the widest interval."""
        self.pixels = 0
        self.valid = 0
        self.low = 0
        self.flags = dict.fromkeys((flag.name for flag in FLAGS), 0)
        self.widths = np.zeros(round(count / _WIDTH_STEP) + 1, np.int64)

    def add(self, intervals: np.ndarray, validity: np.ndarray) -> None:
        """Count some rows: ``intervals`` ``(4, rows, columns)`` in the order of BANDS, and their ``validity``."""
        valid = validity & INVALID == 0
        self.pixels += validity.size
        self.valid += int(valid.sum())
        self.low += int((valid & (validity & REGULARIZED != 0)).sum())
        for flag in FLAGS:
            self.flags[flag.name] += int(np.count_nonzero(validity & flag.value))
        width = (intervals[2] - intervals[1])[valid]
        width = np.rint(width[np.isfinite(width)] / _WIDTH_STEP).astype(np.int64)
        self.widths += np.bincount(width, minlength=self.widths.size)

    def report(self) -> dict[str, Any]:
        """Counts and shares; the median width in pixels, to 0.01, is None where there is no interval."""
        upto = np.cumsum(self.widths)
        median = float(np.searchsorted(upto, upto[-1] / 2) * _WIDTH_STEP) if upto[-1] else None
        return {
            "pixels": self.pixels,
            "valid": self.valid,
            "low_confidence": self.low,
            "flags": self.flags,
            "median_interval_width": None if median is None else round(median, 2),
        }
