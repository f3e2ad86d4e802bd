"""Margins that make intervals reach a coverage: split-conformal prediction by class of width (Vovk et al. 2005)."""

import numpy as np


def least_number(coverage: float) -> int:
    """Return the number of values that a margin needs."""
    return int(np.ceil(max(30, 10 / (1 - coverage)) - 1e-9))


def margins(scores: np.ndarray, classes: np.ndarray, count: int, coverage: float) -> np.ndarray:
    """Return the margin of each class: ``(count,)``. Each class has at least `least_number` values.

    scores: ``(n,)``: how far a truth is outside its interval, negative inside: ``max(lower - truth, truth - upper)``.
    classes: ``(n,)`` from 0 to ``count - 1``.
    coverage: share of the truths to be inside, once both bounds are moved outwards by the margin of their class.
    """
    found = np.empty(count)
    for kind in range(count):
        own = scores[classes == kind]
        rank = int(np.ceil((own.size + 1) * coverage - 1e-9)) - 1
        found[kind] = np.partition(own, rank)[rank]
    return found


def widened(
    height: np.ndarray, lower: np.ndarray, upper: np.ndarray, limits: np.ndarray, margin: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Move both bounds outwards by the margin of their class, or inwards by a negative one, never past the height.

    height, lower, upper: of any shape, NaN bounds without an interval.
    limits, margin: ``(classes - 1,)`` widths between the classes, ``(classes,)`` margins.
    """
    own = margin[np.searchsorted(limits, upper - lower, side="right")]
    return np.minimum(lower - own, height), np.maximum(upper + own, height)
