"""Slopes of surfaces with holes."""

import numpy as np


def rises(height: np.ndarray, axis: int) -> np.ndarray:
    """Return what a surface rises by along an axis in a cell: the mean to both neighbours, to a known one, or 0."""
    ends = [np.diff(height, axis=axis, prepend=np.nan), np.diff(height, axis=axis, append=np.nan)]
    known = np.isfinite(ends).sum(axis=0)
    return np.asarray(np.nansum(ends, axis=0) / np.maximum(known, 1))
