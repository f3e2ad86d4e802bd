"""Strips of a region give the same final bands as the whole region."""

import numpy as np
import pytest

from sat_intervals.config import load_config
from sat_intervals.kernels.refinement import MARGIN
from sat_intervals.match.gauge import at_levels
from sat_intervals.match.postprocess import (
    ConfidenceScale,
    RawRows,
    cut_rows,
    halo,
    inner_rows,
    postprocess_rows,
    postprocess_strips,
)
from sat_intervals.products import NO_DISPARITY, REGULARIZED

ROWS, COLUMNS, MINIMUM, COUNT = 90, 70, -9, 21


def raw_rows() -> RawRows:
    """Noise with areas of low confidence and pixels without disparity."""
    random = np.random.default_rng(0)
    winner = random.integers(MINIMUM + 2, MINIMUM + COUNT - 2, (ROWS, COLUMNS)).astype(np.int16)
    lower, upper = (
        (winner - MINIMUM + sign * random.integers(0, 3, winner.shape)).astype(np.uint16) for sign in (-1, 1)
    )
    disparity = (winner + random.uniform(-0.5, 0.5, winner.shape)).astype(np.float32)
    right = random.integers(MINIMUM, MINIMUM + COUNT, (ROWS, COLUMNS + COUNT - 1)).astype(np.int16)
    ambiguity = random.integers(0, 60, winner.shape).astype(np.uint32)
    winner[random.random(winner.shape) < 0.05] = NO_DISPARITY
    validity = np.where(winner == NO_DISPARITY, 4, 0).astype(np.uint16)
    return RawRows(winner, lower, upper, disparity, ambiguity, validity, lower, upper, right)


def fitted_rows() -> RawRows:
    """Raw rows whose disparities are about 0, with walls, and images that least squares can fit."""
    random, raw = np.random.default_rng(1), raw_rows()
    flat = (random.random((ROWS, COLUMNS)) < 0.97) & (raw.winner != NO_DISPARITY)
    disparity = np.where(flat, random.uniform(-0.4, 0.4, flat.shape), raw.disparity).astype(np.float32)
    other = random.normal(500, 80, (ROWS, COLUMNS + COUNT - 1 + 2 * MARGIN)).astype(np.float32)
    left = other[:, MARGIN - MINIMUM :][:, :COLUMNS] + np.float32(5)
    return raw._replace(winner=np.where(flat, 0, raw.winner), disparity=disparity, left=left, right=other)


@pytest.mark.parametrize(
    "sections",
    [{}, {"median": {"size": 7}, "regularization": {"depth": 4}}, {"median": None}, {"preset": "satellite"}],
)
def test_inner_rows__of_a_strip_equal_those_of_the_whole_region_in_every_bit(sections):
    search = {"minimum": MINIMUM, "maximum": MINIMUM + COUNT - 1}
    config = load_config({"preset": "paper", "disparity": search, "cross_check": {"tolerance": 9}} | sections)
    config = at_levels(config, 0.5, 100, 0.9) if config.fits else config
    raw, scale, margin = fitted_rows() if config.fits else raw_rows(), ConfidenceScale(3.0, 70.0), halo(config)
    whole = postprocess_rows(raw, 0, ROWS, scale, config)
    assert (whole.validity & REGULARIZED != 0).any()
    for first in range(0, ROWS, 32):
        last = min(first + 32, ROWS)
        top, bottom = max(0, first - margin), min(ROWS, last + margin)
        pieces = (cut_rows(raw, row, min(row + 11, bottom)) for row in range(top, bottom, 11))
        parts = list(inner_rows(postprocess_strips(pieces, scale, config), first - top, last - first))
        for name in ("disparity", "lower", "upper", "confidence", "validity"):
            found = np.concatenate([getattr(part, name) for part in parts])
            np.testing.assert_array_equal(found, getattr(whole, name)[first:last], err_msg=name)
