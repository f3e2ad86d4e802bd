"""Shifts between points and surfaces: found on relief and in towns, refused on planes and in noise; uncertainty."""

import numpy as np
import pytest

from sat_intervals.kernels import registration
from sat_intervals.kernels.registration import LEAST, REACH, Blocks, register, summary

CELL, SIDE = 0.5, 64


def hills(x, y):
    return 3 * np.sin(0.11 * x + 0.03 * y) + 2 * np.sin(0.05 * x - 0.17 * y) + np.sin(0.3 * y)


def plane(x, y):
    return 0.05 * x - 0.02 * y


def town(x, y):
    """Boxes of 6 to 13 m, 9 m apart, whose walls are midway between cells."""
    x, y = x + CELL / 2, y + CELL / 2
    inside = (x % 19 < 10) & (y % 23 < 14)
    return np.where(inside, 6 + 7 * np.sin(x // 19 + 2 * (y // 23)) ** 2, 0.0)


def blocks_of(heights_at, shift, moves=1, noise=0.0, count=500, number=9, seed=0):
    random = np.random.default_rng(seed)
    size = SIDE + 2 * REACH
    column, row = np.meshgrid(np.arange(size), np.arange(size))
    surfaces, parts = [], []
    for index in range(number):
        left, top = 47.0 * (index % 3), 53.0 * (index // 3)
        surface = heights_at(left + column * CELL, top - row * CELL)
        surfaces.append(surface + noise * random.normal(size=surface.shape))
        x, y = random.uniform(REACH, REACH + SIDE, (2, count))
        east, north = left + x * CELL - moves * shift[0], top - y * CELL - moves * shift[1]
        height = heights_at(east, north) + moves * shift[2]
        parts.append((np.full(count, index), x, y, height + noise * random.normal(size=count)))
    block, x, y, height = map(np.concatenate, zip(*parts, strict=True))
    return Blocks(np.array(surfaces), CELL, block, x, y, height, moves)


@pytest.mark.parametrize(("heights_at", "within", "moves"), [(hills, 0.05, 1), (hills, 0.05, -1), (town, 0.25, 1)])
def test_register__finds_a_shift(heights_at, within, moves):
    found = register(blocks_of(heights_at, (3.0, -2.0, 5.0), moves))
    assert found.is_horizontal
    np.testing.assert_allclose(found.shift, (3, -2, 5), atol=within)
    assert np.median(found.after) == pytest.approx(0, abs=0.01)
    assert np.std(found.after) < np.std(found.before)


def test_register__states_its_uncertainty():
    found = [register(blocks_of(hills, (3.0, -2.0, 5.0), noise=0.2, seed=seed)) for seed in range(4)]
    errors = np.array([one.shift - (3, -2, 5) for one in found])
    stated = np.array([one.deviation for one in found])
    assert np.abs(errors).max() < 0.15
    ratio = np.sqrt((errors**2).mean(axis=0) / (stated**2).mean(axis=0))
    assert (ratio < 3).all()
    assert (ratio > 0.2).all()


def aligned(shift, noise, seed):
    """Blocks whose points are the centres of the surface's cells, before they are moved."""
    blocks = blocks_of(hills, shift, noise=noise, count=600, seed=seed)
    random, block = np.random.default_rng(seed), blocks.block
    x, y = np.rint(blocks.x), np.rint(blocks.y)
    left, top = 47.0 * (block % 3), 53.0 * (block // 3)
    height = hills(left + x * CELL - shift[0], top - y * CELL - shift[1]) + shift[2]
    return blocks._replace(x=x, y=y, height=height + noise * random.normal(size=x.size))


def test_register__noise_does_not_move_aligned_surfaces():
    """Nothing is moved, and differences stay as they are: the noise is not averaged away."""
    found = [register(aligned((0.0, 0.0, 0.0), 0.7, seed)) for seed in range(4)]
    assert sum((one.shift == 0).all() for one in found) >= 3
    for one in found:
        assert (np.abs(one.shift) <= 3 * one.deviation).all()
        assert np.std(one.after) == pytest.approx(np.std(one.before), rel=0.02)
        assert np.std(one.after) == pytest.approx(0.7 * np.sqrt(2), rel=0.05)


def test_register__deviations_cover_shifts_of_a_quarter_of_a_cell():
    """In 9 of 10 trials at .9, under noise of .5 m."""
    errors, deviations = [], []
    for seed in range(12):
        blocks = aligned((CELL / 4, -CELL / 4, 1.0), 0.5, seed)
        most = registration._most(blocks, np.zeros(2))
        place, deviation = registration._solved(blocks, np.zeros(2), most)
        errors.append(place - (CELL / 4, -CELL / 4))
        deviations.append(deviation)
    inside = np.abs(errors) <= 1.645 * np.array(deviations)
    assert inside.mean() >= 0.75
    assert np.abs(np.mean(errors, axis=0)).max() < CELL / 8
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.sqrt(np.mean(np.square(deviations))), rel=0.5)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_register__refuses_the_horizontal_part_on_a_plane(noise):
    found = register(blocks_of(plane, (0.0, 0.0, 5.0), noise=noise))
    assert not found.is_horizontal
    assert np.isnan(found.deviation[:2]).all()
    np.testing.assert_allclose(found.shift, (0, 0, 5), atol=0.05)


def test_register__refuses_a_shift_beyond_its_reach():
    found = register(blocks_of(hills, (0.98 * REACH * CELL, 0.0, 0.0)))
    assert not found.is_horizontal


def test_register__needs_some_points():
    few = blocks_of(hills, (0.0, 0.0, 0.0), count=1)
    assert len(few.height) < LEAST
    assert register(few) is None
    assert register(blocks_of(hills, (0.0, 0.0, np.nan))) is None


def test_summary__worked_example():
    # -1 0 1 10: mean 2.5, median 0.5, distances 1.5 .5 .5 9.5 with median 1, squares 1 0 1 100
    figures = summary(np.array([-1.0, 0.0, 1.0, 10.0]))
    assert (figures["count"], figures["bias"], figures["median"]) == (4, 2.5, 0.5)
    assert figures["nmad"] == pytest.approx(1.4826)
    assert figures["rmse"] == pytest.approx(np.sqrt(102 / 4))
    assert figures["le90"] == pytest.approx(1 + 0.7 * 9)  # between the third and the fourth of 0 1 1 10
