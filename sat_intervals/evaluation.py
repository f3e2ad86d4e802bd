"""Figures of merit of intervals against a known truth (method: section 10; paper section 4)."""

from typing import NamedTuple

import numpy as np


class IntervalFigures(NamedTuple):
    """What intervals are worth.

    Attributes
    ----------
    count
        Pixels with an interval and a known truth inside the search range.
    accuracy
        Share of them whose interval holds the truth; NaN of no pixel, as the following.
    relative_size
        Median width of an interval over the width of the search range.
    mean_width
        Mean width in pixels.
    """

    count: int
    accuracy: float
    relative_size: float
    mean_width: float


def interval_figures(
    lower: np.ndarray, upper: np.ndarray, truth: np.ndarray, minimum: int, maximum: int
) -> IntervalFigures:
    """Judge intervals by a true disparity.

    Parameters
    ----------
    lower, upper, truth
        Pixels, of one shape; NaN where there is none.
    minimum, maximum
        The search range; a truth outside it is not judged.
    """
    judged = np.isfinite(lower) & np.isfinite(upper) & (truth >= minimum) & (truth <= maximum)
    low, high, true = lower[judged], upper[judged], truth[judged]
    if true.size == 0:
        return IntervalFigures(0, np.nan, np.nan, np.nan)
    return IntervalFigures(
        count=true.size,
        accuracy=float(((low <= true) & (true <= high)).mean()),
        relative_size=float(np.median(high - low) / max(maximum - minimum, 1)),
        mean_width=float((high - low).mean()),
    )
