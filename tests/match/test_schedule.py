"""Order of tiles and of the path states that they hand to each other."""

import pytest

from sat_intervals.config import load_config
from sat_intervals.kernels.sgm import LAST
from sat_intervals.match.schedule import Schedule, Step, blocks_of, needs
from sat_intervals.tiling import Grid, Window

GRID = Grid(Window(10, 20, 4 * 64, 5 * 64 - 7), 64)


def in_turn(schedule):
    """Steps that can be done together, turn by turn."""
    while schedule:
        together = []
        while (step := schedule.next()) is not None:
            together.append(step)
        yield together
        for step in together:
            schedule.ended(step)


def test_schedule__draws_the_order_of_a_grid():
    # The turn in which each of 4 x 5 tiles hands on its states, by wavefront: from the four corners.
    turns = {
        step: turn for turn, steps in enumerate(in_turn(Schedule(GRID, GRID, set().__contains__))) for step in steps
    }
    drawn = [
        [[turns.get(Step(GRID.tile(row, column), wavefront)) for column in range(5)] for row in range(4)]
        for wavefront in range(4)
    ]
    upper_left = [[0, 1, 2, 3, 4], [1, 2, 3, 4, 5], [2, 3, 4, 5, 6], [3, 4, 5, 6, None]]
    upper_right, lower_right = [row[::-1] for row in upper_left], [row[::-1] for row in upper_left[::-1]]
    assert drawn == [upper_left, upper_right, lower_right, upper_left[::-1]]
    tiles = [[turns[Step(GRID.tile(row, column))] for column in range(5)] for row in range(4)]
    assert tiles == [[7, 6, 5, 6, 7], [6, 5, 4, 5, 6], [6, 5, 4, 5, 6], [7, 6, 5, 6, 7]]


def test_schedule__of_one_worker_leaves_the_last_wavefront_to_the_tiles():
    schedule, done = Schedule(GRID, GRID, set().__contains__), []
    while (step := schedule.next()) is not None:
        done.append(step)
        schedule.ended(step)
    assert [step.wavefront for step in done].count(None) == 20
    assert {step.wavefront for step in done} == {None, 0, 1, 2}


@pytest.mark.parametrize("borders", [set(), {"0_0_0", "1_1_2"}])
def test_schedule__comes_after_what_it_needs_and_does_nothing_twice(borders):
    done = []
    for steps in in_turn(Schedule(GRID, GRID, borders.__contains__)):
        for step in steps:
            for other in needs(GRID, step):
                is_given = other.wavefront == LAST and Step(other.block) in done
                assert is_given or other in done or other.name in borders
        done += steps
    assert len(done) == len(set(done))
    assert {step.block for step in done if step.wavefront is None} == set(GRID)
    assert not borders & {step.name for step in done}


def test_schedule__of_one_tile_asks_for_its_neighbours_only_as_far_as_it_must():
    (corner,) = in_turn(
        Schedule(GRID, [GRID.tile(0, 0)], {"0_1_3", "1_0_1", "0_1_1", "1_0_3", "1_0_2", "1_1_2", "0_1_2"}.__contains__)
    )
    assert [step.name for step in corner] == ["0_0"]


def test_schedule__drops_what_needs_a_failed_step():
    schedule = Schedule(GRID, GRID, set().__contains__)
    while (step := schedule.next()) is not None:
        if step.name == "0_0_0":
            schedule.failed(step)
        else:
            schedule.ended(step)
    assert not schedule


def test_schedule__traces_what_a_failed_tile_would_have_given():
    schedule, failed = Schedule(GRID, GRID, set().__contains__), Step(GRID.tile(2, 2))
    done = set()
    while (step := schedule.next()) is not None:
        if step == failed:
            schedule.failed(step)
        else:
            schedule.ended(step)
            done.add(step)
    assert Step(failed.block, LAST) in done
    assert {step.block for step in done if step.wavefront is None} == set(GRID) - {failed.block}
    assert not schedule


@pytest.mark.parametrize("block_fails", [False, True])
def test_schedule__takes_from_a_block_under_way_what_cannot_be_traced(block_fails):
    schedule, under_way = Schedule(GRID, GRID, set().__contains__), []
    while (step := schedule.next()) is None or step.wavefront != LAST:
        if step is None:
            schedule.ended(under_way.pop(0))
        elif step.wavefront is None:
            under_way.append(step)
        else:
            schedule.ended(step)
    last, block, others = step, Step(step.block), []
    while (step := schedule.next()) != block:
        others.append(step)
    assert not schedule.failed(last)  # its block gives it
    if block_fails:
        assert schedule.failed(block)
    else:
        schedule.ended(block)
    for step in under_way + others:
        schedule.ended(step)
    traced = []
    while (step := schedule.next()) is not None:
        traced.append(step)
        schedule.ended(step)
    assert (last in traced) == block_fails
    assert not schedule


def test_schedule__ends_after_what_a_block_has_given_while_it_was_traced():
    schedule, late = Schedule(GRID, GRID, set().__contains__), []
    while together := list(iter(schedule.next, None)):
        late += [step for step in together if step.wavefront == LAST]
        for step in together:
            if step.wavefront != LAST:
                schedule.ended(step)
    assert late
    while late:
        assert len(schedule) == len(late)
        schedule.ended(late.pop())
    assert not schedule


def test_schedule__of_blocks_traces_inside_each():
    turns = list(in_turn(Schedule(GRID, GRID, set().__contains__, together=2)))
    traced = [step for steps in turns for step in steps if step.wavefront in (0, 1, 2)]
    assert len(traced) == len(set(traced)) == 3 * len(GRID)


@pytest.mark.parametrize(
    ("tiles", "size", "settings", "block"),
    [
        ((16, 16), 256, {}, 1024),
        ((8, 16), 256, {}, 512),
        ((3, 16), 256, {}, 256),
        ((40, 40), 64, {}, 128),
        ((40, 40), 1024, {}, 1024),
        ((16, 16), 256, {"tiles": {"overlap": 100}}, 256),
        ((16, 16), 256, {"preset": "satellite-mccnn"}, 256),
    ],
)
def test_blocks_of__are_as_large_as_a_default_tile_and_at_least_four_along_a_side(tiles, size, settings, block):
    grid = Grid(Window(3, 5, tiles[0] * size, tiles[1] * size - 1), size)
    blocks = blocks_of(grid, load_config({"disparity": {"minimum": 0, "maximum": 9}} | settings))
    assert (blocks.size, blocks.region) == (block, grid.region)
    inside = [tile for there in blocks for tile in grid.within(there.core)]
    assert len(inside) == len(set(inside)) == len(grid)
