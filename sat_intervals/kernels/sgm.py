"""Semi-global matching over 8 paths (Hirschmuller 2008; method: section 2).

    L(p, d) = C(p, d) + min(L(q, d), L(q, d - 1) + P1, L(q, d + 1) + P1, min L(q) + P2) - min L(q)

with q the pixel before p on the path; P1 and P2 are constant, or those of the candidate on the path. A sweep down the
rows, columns ascending, advances the four paths that come from the left, the upper left, above and the upper right; a
sweep up the rows, columns descending, the other four.

Letters: r row, c column, k disparity index, in blocks of 32 lanes.
"""

import numpy as np
from numba import njit

from sat_intervals.kernels.cost import candidate_costs
from sat_intervals.kernels.penalties import penalty
from sat_intervals.kernels.vector import (
    LANES,
    add,
    load,
    slide_down,
    slide_up,
    smaller,
    smallest,
    splat,
    store,
    subtract,
)

# Above every L of a candidate: an impossible one reaches at most 2 P2 + 2 and the largest cost twice, < 16505.
WALL = 32768


@njit(nogil=True, forceinline=True)
def _advance(before, here, after, costs, p1, jump, lowest):
    """The recurrence for 32 disparities: ``jump = lowest + P2``, ``lowest = min L(q)``."""
    best = smaller(here, add(smaller(slide_up(before, here), slide_down(here, after)), p1))
    return add(costs, subtract(smaller(best, jump), lowest))


@njit(nogil=True, forceinline=True)
def _block_after(paths, start, k, size):
    """The block behind ``k``, or a wall at the end of the curve."""
    if k + LANES < size:
        return load(paths, start + k + LANES)
    return splat(np.uint16(WALL))


@njit(nogil=True, forceinline=True)
def advance_pixel(left, right, barrier, beyond, r, c, p1, p2, edges, paths, lowest, slots, target, offset):
    """Advance four paths by the pixel ``(r, c)`` and write the sum of their L.

    Parameters
    ----------
    left, right, barrier, beyond
        See ``candidate_costs``.
    p1, p2, edges
        See ``row_penalties``.
    paths
        ``(slots, size)`` uint16: the last L of each path under way; updated in place.
    lowest
        ``(slots,)`` uint16: its minimum. A path that starts here has all zeros in both, which makes ``L = C``.
    slots
        Where the four paths of this pixel live.
    target, offset
        The sum goes to ``target.ravel()[offset : offset + size]``.
    """
    size = paths.shape[1]
    slot_1, slot_2, slot_3, slot_4 = slots
    lowest_1, lowest_2 = splat(lowest[slot_1]), splat(lowest[slot_2])
    lowest_3, lowest_4 = splat(lowest[slot_3]), splat(lowest[slot_4])
    wall = splat(np.uint16(WALL))
    start_1, start_2, start_3, start_4 = slot_1 * size, slot_2 * size, slot_3 * size, slot_4 * size
    here_1, here_2 = load(paths, start_1), load(paths, start_2)
    here_3, here_4 = load(paths, start_3), load(paths, start_4)
    before_1 = before_2 = before_3 = before_4 = wall
    minimum_1 = minimum_2 = minimum_3 = minimum_4 = splat(np.uint16(65535))
    for k in range(0, size, LANES):
        costs = candidate_costs(left, right, barrier, beyond, r, c, k)
        after_1, after_2 = _block_after(paths, start_1, k, size), _block_after(paths, start_2, k, size)
        after_3, after_4 = _block_after(paths, start_3, k, size), _block_after(paths, start_4, k, size)
        small, jump = penalty(p1, edges, 0, c, k), add(lowest_1, penalty(p2, edges, 0, c, k))
        path_1 = _advance(before_1, here_1, after_1, costs, small, jump, lowest_1)
        small, jump = penalty(p1, edges, 1, c, k), add(lowest_2, penalty(p2, edges, 1, c, k))
        path_2 = _advance(before_2, here_2, after_2, costs, small, jump, lowest_2)
        small, jump = penalty(p1, edges, 2, c, k), add(lowest_3, penalty(p2, edges, 2, c, k))
        path_3 = _advance(before_3, here_3, after_3, costs, small, jump, lowest_3)
        small, jump = penalty(p1, edges, 3, c, k), add(lowest_4, penalty(p2, edges, 3, c, k))
        path_4 = _advance(before_4, here_4, after_4, costs, small, jump, lowest_4)
        before_1, before_2, before_3, before_4 = here_1, here_2, here_3, here_4
        here_1, here_2, here_3, here_4 = after_1, after_2, after_3, after_4
        store(paths, start_1 + k, path_1)
        store(paths, start_2 + k, path_2)
        store(paths, start_3 + k, path_3)
        store(paths, start_4 + k, path_4)
        minimum_1, minimum_2 = smaller(minimum_1, path_1), smaller(minimum_2, path_2)
        minimum_3, minimum_4 = smaller(minimum_3, path_3), smaller(minimum_4, path_4)
        store(target, offset + k, add(add(path_1, path_2), add(path_3, path_4)))
    lowest[slot_1], lowest[slot_2] = smallest(minimum_1), smallest(minimum_2)
    lowest[slot_3], lowest[slot_4] = smallest(minimum_3), smallest(minimum_4)


@njit(nogil=True, forceinline=True)
def path_slots(c, columns, falling, rising):
    """Where the paths through column ``c`` live: along the row, the falling and the rising diagonal, the column.

    A slot belongs to the line, not to the pixel, so that a sweep updates it in place, in either direction. The
    diagonals through ``(r, c)`` are the lines ``c - r`` and ``c + r``, modulo the columns; ``falling = -r % columns``
    and ``rising = r % columns`` belong to the row.
    """
    falling += c
    rising += c
    if falling >= columns:
        falling -= columns
    if rising >= columns:
        rising -= columns
    return 0, 1 + falling, 1 + columns + rising, 1 + 2 * columns + c


@njit(nogil=True, forceinline=True)
def restart(paths, lowest, slot):
    """Let the path in a slot start at its next pixel."""
    paths[slot] = 0
    lowest[slot] = 0


@njit(nogil=True, forceinline=True)
def restart_all(paths, lowest, slots):
    """Let the four paths of a pixel start at their next pixels: behind one without candidates nothing is known."""
    for slot in slots:
        restart(paths, lowest, slot)


@njit(nogil=True, forceinline=True)
def add_curve(curve, volume, offset):
    """Add ``volume.ravel()[offset : offset + curve.size]`` to a curve."""
    for k in range(0, curve.size, LANES):
        store(curve, k, add(load(curve, k), load(volume, offset + k)))


@njit(nogil=True)
def enter_row(paths, lowest, columns, falling, rising, down):
    """Restart the paths that enter the patch in this row: along it, and the diagonals at its two ends.

    A diagonal's slot that wraps around holds the path that left the patch at the other end of the row before.
    """
    first, last = path_slots(0, columns, falling, rising), path_slots(columns - 1, columns, falling, rising)
    restart(paths, lowest, 0)
    restart(paths, lowest, first[1] if down else last[1])
    restart(paths, lowest, last[2] if down else first[2])
