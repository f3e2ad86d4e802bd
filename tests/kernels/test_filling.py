"""Voids filled from their rims."""

import numpy as np
import pytest
import reference
from numpy.testing import assert_allclose

from sat_intervals.kernels.filling import filled

SHAPE = 24, 30


def ground(seed, slope, roof):
    """Height and bounds of a slope with a roof and noise, and a third of its cells void."""
    random = np.random.default_rng(seed)
    row, column = np.indices(SHAPE)
    height = slope * column + random.normal(0, 0.1, SHAPE) + roof * ((column > 12) & (row > 6))
    lower, upper = height - random.uniform(0.1, 1, SHAPE), height + random.uniform(0.1, 1, SHAPE)
    surface = np.stack([height, lower, upper])
    surface[:, random.uniform(size=SHAPE) < 0.3] = np.nan
    surface[:, 8:15, 10:15] = np.nan
    return surface


@pytest.mark.parametrize(("slope", "roof"), [(0, 0), (2, 0), (0.2, 8)])
def test_filled__is_what_the_method_says(slope, roof):
    surface = ground(3, slope, roof)
    voids = np.isnan(surface[0])
    voids[:, :4] = False
    found = filled(*surface, voids, 9.0, 1.0)
    assert np.isfinite(found[0]).sum() > 100
    assert_allclose(found, reference.filled(*surface, voids, 9.0, 1.0), atol=1e-9)
    height, lower, upper = found[:, np.isfinite(found[0])]
    assert (lower <= height).all()
    assert (height <= upper).all()


def test_filled__takes_the_ground_beside_a_roof_and_the_slope_of_a_hill():
    street = np.full((3, *SHAPE), 5.0)
    street[:, :, 12:18] = 20
    street[1:] += [[[-0.5]], [[1.5]]]
    street[:, :, 9:12] = np.nan  # hidden by the building
    height, lower, upper = filled(*street, np.isnan(street[0]), 12.0, 1.0)[:, 3:-3, 9:12]
    assert (height == 5).all()
    assert (lower == 4.5).all()
    assert_allclose(upper, 5 + 0.95 * 15)
    hill = ground(1, 3, 0)
    hole = np.isnan(hill[0])
    found = filled(*hill, hole, 9.0, 1.0)[0, 6:-6, 6:-6]
    assert_allclose(found, np.where(hole, 3 * np.indices(SHAPE)[1], np.nan)[6:-6, 6:-6], atol=0.5)


def test_filled__leaves_what_is_beyond_a_border():
    surface = np.full((3, *SHAPE), 5.0)
    surface[:, :, :9] = np.nan
    assert np.isnan(filled(*surface, np.isnan(surface[0]), 20.0, 1.0)).all()
