"""Shifts between points and surfaces: found on relief and in towns, refused on planes and in noise; uncertainty."""

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from sat_intervals.kernels import registration
from sat_intervals.kernels.registration import LEAST, Blocks, register, summary

CELL, SIDE, REACH = 0.5, 64, registration.REACH
pytestmark = pytest.mark.usefixtures("thinned")


def hills(x, y):
    return 3 * np.sin(0.11 * x + 0.03 * y) + 2 * np.sin(0.05 * x - 0.17 * y) + np.sin(0.3 * y)


def plane(x, y):
    return 0.05 * x - 0.02 * y


def town(x, y):
    """Boxes of 6 to 13 m, 9 m apart, whose walls are midway between cells."""
    x, y = x + CELL / 2, y + CELL / 2
    inside = (x % 19 < 10) & (y % 23 < 14)
    return np.where(inside, 6 + 7 * np.sin(x // 19 + 2 * (y // 23)) ** 2, 0.0)


def mountains(x, y):
    return 150 * np.sin(x / 60) * np.cos(y / 70) + 40 * np.sin((x + y) / 23)


def houses(x, y):
    """Flat ground with boxes of many sizes, 5 to 14 m high: walls stand anywhere between cells."""
    column, row = np.floor(x / 11.37), np.floor(y / 13.61)
    drawn = [np.modf(np.abs(43758.5453 * np.sin(12.9898 * column + 78.233 * row + k)))[0] for k in range(5)]
    left, top = x - 11.37 * column - 3 * drawn[0], y - 13.61 * row - 4 * drawn[1]
    inside = (left > 0) & (top > 0) & (left < 3 + 4 * drawn[2]) & (top < 4 + 4 * drawn[3])
    return np.where(inside, 5 + 9 * drawn[4], 0.0)


def blocks_of(heights_at, shift, moves=1, noise=0.0, count=500, number=9, seed=0, aligned=False, wide=1):
    """Blocks of surfaces and points, anywhere or at centres of cells; noise of the surfaces is as wide as cells."""
    random = np.random.default_rng(seed)
    reach = registration.REACH
    size = SIDE + 2 * reach
    column, row = np.meshgrid(np.arange(size), np.arange(size))
    surfaces, parts = [], []
    for index in range(number):
        left, top = 47.0 * (index % 3) + 313.7 * seed, 53.0 * (index // 3)
        surface = heights_at(left + column * CELL, top - row * CELL)
        added = sliding_window_view(random.normal(size=(size + wide - 1,) * 2), (wide, wide)).mean(axis=(2, 3))
        surfaces.append(surface + noise * added / added.std())
        x, y = random.uniform(reach, reach + SIDE, (2, count))
        if aligned:
            x, y = np.rint(x), np.rint(y)
        east, north = left + x * CELL - moves * shift[0], top - y * CELL - moves * shift[1]
        height = heights_at(east, north) + moves * shift[2]
        parts.append((np.full(count, index), x, y, height + noise * random.normal(size=count)))
    block, x, y, height = map(np.concatenate, zip(*parts, strict=True))
    return Blocks(np.array(surfaces, np.float32), CELL, block, x, y, height, moves)


@pytest.mark.parametrize(
    ("heights_at", "within", "moves", "reach", "shift"),
    [
        (hills, 0.05, -1, 16, (3, -2, 5)),
        (hills, 0.05, 1, REACH, (20, -21, 5)),
        (town, 0.25, 1, REACH, (3, -2, 5)),
    ],
)
def test_register__finds_a_shift(monkeypatch, heights_at, within, moves, reach, shift):
    monkeypatch.setattr(registration, "REACH", reach)
    found = register(blocks_of(heights_at, shift, moves))
    assert found.is_horizontal
    np.testing.assert_allclose(found.shift, shift, atol=within)
    assert np.median(found.after) == pytest.approx(0, abs=0.01)
    assert np.std(found.after) < np.std(found.before)


def test_register__noise_does_not_move_aligned_surfaces():
    """Nothing is moved, and differences stay as they are: the noise is not averaged away."""
    found = [register(blocks_of(hills, (0.0, 0.0, 0.0), noise=0.7, seed=seed, aligned=True)) for seed in range(4)]
    assert sum((one.shift == 0).all() for one in found) >= 3
    for one in found:
        assert (np.abs(one.shift) <= 3 * one.deviation).all()
        assert np.std(one.after) == pytest.approx(np.std(one.before), rel=0.02)
        assert np.std(one.after) == pytest.approx(0.7 * np.sqrt(2), rel=0.05)


def errors_and_deviations(heights_at, kinds):
    """Those of horizontal shifts, in cells: ``kinds`` are noise (m), its width and the shift (cells), and alignment."""
    found = []
    for seed, (noise, wide, cells, aligned) in enumerate(kinds):
        shift = CELL * np.array([cells, -cells])
        blocks = blocks_of(heights_at, (*shift, 1.0), 1, noise, 500, 16, seed, aligned, wide)
        place, deviation = registration._horizontal(blocks)
        found.append([place - shift, deviation])
    return np.array(found).swapaxes(0, 1) / CELL


@pytest.mark.parametrize("heights_at", [houses, hills, mountains])
def test_register__deviations_hold(heights_at):
    """Without bias, and in about 9 of 10 trials at .9, of all kinds of noise; `benchmarks/registration.py` has more."""
    kinds = [(noise, wide, cells, wide == 1) for noise in (0.1, 0.7) for wide in (1, 3) for cells in (0.25, 3.7)]
    errors, deviations = errors_and_deviations(heights_at, kinds)
    assert (np.abs(errors) <= 1.645 * deviations).mean() >= 0.75
    size = np.sqrt((deviations**2).mean())
    assert np.abs(errors.mean(axis=0)).max() < 3 * size / np.sqrt(len(kinds))
    assert np.sqrt((errors**2).mean()) == pytest.approx(size, rel=0.5)


@pytest.mark.parametrize("aligned", [True, False])
@pytest.mark.parametrize("cells", [1, 2])
def test_register__noise_stays_as_it_is_in_towns(aligned, cells):
    """Walls are no noise, and the whole shift is found, also where houses are few cells wide."""
    blocks = blocks_of(lambda x, y: houses(cells * x, cells * y), (1.85, -1.85, 1.0), 1, 0.1, 500, 16, aligned=aligned)
    found = register(blocks)
    np.testing.assert_allclose(found.shift, (1.85, -1.85, 1.0), atol=0.06)
    assert summary(found.after)["nmad"] == pytest.approx(0.1 * np.sqrt(2), rel=0.07)


@pytest.mark.parametrize("seed", [0, 2])
def test_register__finds_a_town_where_most_heights_are_wrong(seed):
    """Patches of 6 m in which walls and roofs were matched wrongly: the rest decides."""
    shift = (0.85, -1.4, 1.0)
    blocks = blocks_of(houses, shift, 1, 0.3, 500, 16, seed, wide=3)
    random = np.random.default_rng(seed)
    patch = (np.floor(blocks.x / 12) + 20 * np.floor(blocks.y / 12) + 400 * blocks.block).astype(int)
    wrong = random.random(patch.max() + 1) < 0.7
    errors = np.where(wrong, random.normal(0, 15, wrong.size), 0.0)
    found = register(blocks._replace(height=blocks.height + errors[patch]))
    assert found.is_horizontal
    np.testing.assert_allclose(found.shift[:2], shift[:2], atol=0.3 * CELL)
    assert (np.abs(found.shift - shift) <= 3 * found.deviation).all()


def test_register__a_block_never_decides_alone():
    """Of the others, strips are known."""
    blocks = blocks_of(hills, (0.5, 0.0, 1.0))
    surface = blocks.surface.copy()
    surface[1:, :, np.arange(surface.shape[2]) % 24 >= 12] = np.nan
    found = register(blocks._replace(surface=surface))
    np.testing.assert_allclose(found.shift, (0.5, 0, 1), atol=0.05)


@pytest.mark.parametrize(("noise", "wide"), [(0.0, 1), (0.3, 1), (1.0, 3)])
def test_register__refuses_the_horizontal_part_on_a_plane(noise, wide):
    found = register(blocks_of(plane, (0.0, 0.0, 5.0), noise=noise, wide=wide))
    assert not found.is_horizontal
    assert np.isnan(found.deviation[:2]).all()
    np.testing.assert_allclose(found.shift, (0, 0, 5), atol=0.1)


def test_register__refuses_a_shift_beyond_its_reach():
    found = register(blocks_of(hills, (0.98 * registration.REACH * CELL, 0.0, 0.0)))
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
