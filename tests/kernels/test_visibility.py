"""Lines of sight on surfaces: exact crossings, walls, holes, and a slow twin."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.kernels.visibility import seen_disparities, tops

NO_WALL = 1e9


def level_lattice(rows, columns, view, high, low, per_metre=1.0):
    """Lines of sight of an affine camera: column = x + view * z, row = y; disparity = per_metre * z."""
    spacing = float(rows - 1), float(columns - 1), per_metre * (low - high)
    row, column, z = np.meshgrid([0, rows - 1], [0, columns - 1], [high, low], indexing="ij")
    lattice = np.stack([column - view * z, row, z], axis=-1).astype(np.float64)
    return lattice, spacing, (0.0, 0.0, per_metre * high)


def seen(surface, view, high=60.0, low=-20.0, steepest=NO_WALL, per_metre=1.0):
    surface = np.asarray(surface, np.float32)
    lattice, spacing, first = level_lattice(*surface.shape, view, high, low, per_metre)
    return seen_disparities(surface, tops(surface), lattice, spacing, first, surface.shape, steepest)


def slow(surface, view, high, low):
    """The highest height on each line of sight that is on or below the surface, from the top in small steps."""
    z = np.arange(high, low, -0.01)
    result = np.full(surface.shape, np.nan)
    for r, c in np.ndindex(surface.shape):
        there = np.interp(c - view * z, np.arange(surface.shape[1]), surface[r], left=np.nan, right=np.nan)
        met = np.flatnonzero(z <= there)
        if met.size and met[0] and np.isfinite(there[met[0] - 1]):
            result[r, c] = z[met[0]]
    return result


@settings(max_examples=20)
@given(data=st.data())
def test_seen_disparities__equal_their_slow_twin(data):
    random = np.random.default_rng(data.draw(st.integers(0, 1000)))
    view = data.draw(st.sampled_from([-1.3, -0.4, 0.0, 0.2, 0.9]))
    surface = np.cumsum(random.uniform(-0.7, 0.7, (2, 40)), axis=1).astype(np.float32)
    fast, expected = seen(surface, view, 9.0, -9.0), slow(surface, view, 9.0, -9.0)
    fast, expected = fast[:, 3:-3], expected[:, 3:-3]
    both = np.isfinite(fast) & np.isfinite(expected)
    assert both.sum() >= np.isfinite(expected).sum() - 2
    # a corner of less than half a cell may be stepped over
    assert (np.abs(fast - expected)[both] < 0.02).mean() > 0.9


@pytest.mark.parametrize("per_metre", [0.3, -0.7])
def test_seen_disparities__of_a_slope_are_exact(per_metre):
    # z = x / 4 and column = x + z / 2: z = column / 4.5
    surface = np.tile(np.arange(50) / 4, (30, 1))
    found = seen(surface, 0.5, per_metre=per_metre)
    expected = per_metre * np.arange(50) / 4.5
    np.testing.assert_allclose(found[1:-1, 1:-8], np.broadcast_to(expected, found.shape)[1:-1, 1:-8], atol=1e-4)


def block(columns=60):
    """Ground at 0, and a block of 8 m at columns 20 to 39."""
    surface = np.zeros((20, columns))
    surface[:, 20:40] = 8.0
    return surface


def test_seen_disparities__of_a_block_are_those_of_its_roof_and_nan_at_its_wall():
    # column = x + z: the roof is at columns 28 to 47; it hides the ground at 40 to 47, and the wall at 20 is seen
    # from column 20 (its foot) to 28.
    found = seen(block(), 1.0, steepest=2.0)[10]
    np.testing.assert_allclose(found[28:47], 8.0, atol=1e-4)
    assert np.isnan(found[20:27]).all()
    np.testing.assert_allclose(found[49:], 0.0, atol=1e-4)
    np.testing.assert_allclose(found[1:19], 0.0, atol=1e-4)


def test_seen_disparities__disappear_under_holes_and_go_on_behind_them():
    surface = np.zeros((20, 60))
    surface[:, 20:30] = np.nan
    found = seen(surface, 1.0)[10]
    assert np.isnan(found[20:29]).all()
    np.testing.assert_allclose(found[31:], 0.0, atol=1e-4)  # they pass high above the hole
    np.testing.assert_allclose(found[1:19], 0.0, atol=1e-4)
    assert np.isnan(seen(np.full((20, 60), np.nan), 1.0)).all()


def test_tops__are_the_largest_heights_of_nine_blocks():
    surface = np.full((40, 50), np.nan, np.float32)
    surface[20, 20] = 5.0
    expected = np.full((3, 4), -np.inf)
    expected[:3, :3] = 5.0
    np.testing.assert_array_equal(tops(surface), expected)
