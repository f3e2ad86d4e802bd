"""Levels of a calibration from measured intervals: worked examples and properties."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sat_intervals.config import load_config
from sat_intervals.config.calibration import COVERAGES, Calibration
from sat_intervals.match.levels import choose, expected, left_out, means, not_below, pooled
from sat_intervals.match.measurement import (
    COUNTS,
    EDGE,
    FIELDS,
    HIGH,
    INSIDE,
    LOW,
    MISSED,
    QUANTILES,
    SCHEMES,
    WIDTH,
    Measured,
    ThresholdSweep,
    measure,
    threshold_sweep,
)

LEVELS = np.array([0.0, 1, 2, 4, 8, 16, 32, 64])
SWEEP = ThresholdSweep(LEVELS, LEVELS)
PART = np.zeros(4, np.int64)


def part(needed_high, needed_low, group="one", widen=None, needed_edge=()):
    """A measurement of pixels that need these levels; an interval is as wide as its level, or as ``widen`` tells."""
    table = np.zeros((LEVELS.size, SCHEMES, FIELDS))
    for threshold, level in enumerate(LEVELS):
        for scheme in range(SCHEMES):
            needed = np.asarray({HIGH: needed_high, EDGE: needed_edge}.get(scheme, needed_low), float)
            width = np.full(needed.size, widen(scheme, level) if widen else level)
            truth = np.where(needed <= level, 0.0, width + 1)  # missed by 1 px
            table[threshold, scheme] = measure(0 * width, width, truth, 0.0, np.zeros(needed.size, int), 1)[0]
    return Measured(group, 1 / (len(needed_high) + len(needed_low)), table)


def test_measure__a_worked_example():
    lower, upper = np.array([0.0, 0, 0, -1]), np.array([2.0, 2, 2, 20.25])
    fields = measure(lower, upper, np.array([1.0, 2.5, 4, 3]), 0.5, np.array([0, 0, 1, 1]), 2)
    np.testing.assert_array_equal(fields[:, [INSIDE, WIDTH, MISSED]], [[2, 4, 0], [1, 23.25, 1.5]])
    np.testing.assert_array_equal(fields[:, COUNTS:].sum(axis=1), [2, 2])


def test_measure__the_widest_interval_is_counted():
    fields = measure(np.array([-16000.0]), np.array([16000.0]), np.zeros(1), 0.0, PART[:1], 1)
    assert fields[0, COUNTS:].sum() == 1


@pytest.mark.parametrize("preset", ["paper", "satellite"])
def test_threshold_sweep__hold_every_candidate(preset):
    config = load_config({"preset": preset, "disparity": {"minimum": 0, "maximum": 5}})
    high, low = threshold_sweep(config)
    assert low[-1] == pytest.approx(config.largest_sum)
    for thresholds in (high, low):
        assert thresholds[0] == 0
        assert (np.diff(thresholds) > 0).all()
        assert thresholds.size == low.size
    assert threshold_sweep(config).are_one == (preset == "paper")
    assert (0.1 * 0.3 * high[-1] > 500) == (preset == "satellite")


def test_choose__factors_and_levels_have_rungs_of_their_own():
    factors = ThresholdSweep(LEVELS / 8, LEVELS)
    pool = pooled([part([4] * 2000, [20] * 2000)])
    choice, _ = choose(pool, factors, 0.9)
    one, _ = choose(pool, SWEEP, 0.9)
    assert (8 * choice.high, choice.low) == (one.high, one.low)
    assert choice.edge == factors.high[-1]  # no edges, and none of these levels is for them
    pool = pooled([part([4] * 2000, [20] * 2000, needed_edge=[20] * 2000)])
    assert 8 * choose(pool, factors, 0.9)[0].edge == choose(pool, factors, 0.9)[0].low
    assert one.edge is None
    few, notes = choose(pooled([part([4] * 2000, [20] * 190, needed_edge=[20] * 300)]), factors, 0.9)
    assert few.low > 16  # not that of the other class, which is a factor
    assert notes == ["190 pixels of low confidence, 200 are needed"]


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 0.8, 0.9, 0.99]))
def test_choose__each_class_reaches_the_coverage_by_the_smallest_level(seed, coverage):
    random = np.random.default_rng(seed)
    parts = [part(random.exponential(4, 1500), random.exponential(9, 1200), str(i)) for i in range(2)]
    pool = pooled(parts)
    choice, notes = choose(pool, SWEEP, coverage)
    figures = expected(pool.table, SWEEP, choice)
    assert not notes
    assert choice.reached
    for name in ("high", "low"):
        assert figures[name] == pytest.approx(coverage, abs=1e-6)
    higher, _ = choose(pool, SWEEP, coverage + 0.005)
    assert higher.high > choice.high


def test_choose__every_pair_weighs_the_same():
    large, small = part([1] * 9000, [1] * 9000), part([20] * 600, [1] * 600)
    choice, _ = choose(pooled([large, small]), SWEEP, 0.75)
    assert 16 < choice.high <= 32  # half of the weight, though a fifteenth of the pixels


def test_choose__a_class_with_few_pixels_takes_the_level_of_the_other():
    pool = pooled([part([4] * 2000, [20] * 190)])
    choice, notes = choose(pool, SWEEP, 0.9)
    assert choice.high == choice.low <= 4
    assert choice.quantile == 0.9
    assert notes == ["190 pixels of low confidence, 200 are needed: the level of high confidence is used"]
    pool = pooled([part([4] * 900, [20] * 1200)])
    at_975, notes = choose(pool, SWEEP, 0.975)
    assert not notes
    choice, notes = choose(pool, SWEEP, 0.99)
    assert choice.high > 16
    assert choice.low > at_975.low > 31  # its own
    assert notes == ["900 pixels of high confidence, 1000 are needed: the level of low confidence is used"]
    both, notes = choose(pooled([part([4] * 900, [20] * 900)]), SWEEP, 0.99)
    assert both.high <= 4
    assert [note.split()[:4] for note in notes] == [["900", "pixels", "of", name] for name in ("high", "low")]


@pytest.mark.parametrize("pixels", [(300, 5000), (5000, 300)])
def test_not_below__levels_of_a_class_with_few_pixels_do_not_fall(pixels):
    random = np.random.default_rng(0)
    pool = pooled([part(random.exponential(40, pixels[0]), random.exponential(8, pixels[1]))])
    choice, chosen = None, []
    for coverage in COVERAGES:
        choice = not_below(choose(pool, SWEEP, coverage)[0], choice)
        chosen.append(choice)
    Calibration(name="few", key={}, levels=tuple(chosen))


def test_choose__says_what_no_level_reaches():
    """Truths outside the search range are missed at any level."""
    pool = pooled([part([1] * 800 + [1e9] * 200, [1] * 1000)])
    choice, notes = choose(pool, SWEEP, 0.9)
    assert (choice.high, choice.reached) == (LEVELS[-1], False)
    assert notes == ["high confidence does not reach it at any level"]
    low = part([1] * 1000, [1e9] * 500 + [1] * 500)
    low.table[:, LOW + QUANTILES.index(0.8), INSIDE] += 1
    choice, notes = choose(pooled([low]), SWEEP, 0.9)
    assert (choice.low, choice.quantile, choice.reached) == (LEVELS[-1], 0.8, False)  # it comes nearest
    assert notes == ["low confidence does not reach it at any level"]


def test_choose__the_narrowest_of_nearly_the_best_scores():
    def widen(scheme, level):
        return level * {LOW + 2: 0.99, LOW + 3: 1.0}.get(scheme, 2.0)

    choice, _ = choose(pooled([part([4] * 1000, [4] * 1000, widen=widen)]), SWEEP, 0.9)
    assert choice.quantile == QUANTILES[2]


def test_left_out__judges_a_group_with_levels_of_the_others():
    easy = [part([2] * 1000, [2] * 1000, "easy") for _ in range(2)]
    hard = part([30] * 1000, [2] * 1000, "hard")
    (groups,) = left_out([*easy, hard], SWEEP, [0.9])
    assert groups.keys() == {"easy", "hard"}
    assert groups["hard"]["high"] == pytest.approx(0)
    assert groups["easy"]["high"] == 1
    assert means(groups.values())["lowest"] == groups["hard"]["all"] == pytest.approx(0.45)  # of low, by interpolation
    assert left_out(easy, SWEEP, [0.9]) == [{}]
    assert means([]) == {}
