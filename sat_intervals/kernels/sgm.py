"""Semi-global matching over 8 paths (Hirschmuller 2008; METHOD.md, section 2).

    L(p, d) = C(p, d) + min(L(q, d), L(q, d - 1) + P1, L(q, d + 1) + P1, min L(q) + P2) - min L(q)

where q is the pixel before p on the path. P1 and P2 are constant, or depend on candidate and path. A sweep down the
rows, columns ascending, advances the four paths from the left, the upper left, above and the upper right. A sweep up,
columns descending, advances the other four. Candidates k are in blocks of 32 lanes.
"""

from typing import NamedTuple

import numpy as np

from sat_intervals.kernels import vector
from sat_intervals.kernels.compiled import inlined, part
from sat_intervals.kernels.cost import candidate_costs
from sat_intervals.kernels.penalties import penalties_of
from sat_intervals.kernels.vector import LANES
from sat_intervals.tiling import Window

# Above every L of a candidate: an impossible one is at most 2 P2 + 2 plus twice the largest cost, < 16505.
WALL = 32768


class Paths(NamedTuple):
    """State of the paths. A path that starts at its next pixel has zeros in both arrays, which makes ``L = C``.

    curves: ``(slots, size)`` uint16: L at the last pixel of each path.
    lowest: ``(slots,)`` uint16: its minimum.
    spans: ``(slots, 2)`` int64: the whole vectors ``[start, stop)`` of the curve that are not all walls; None if every
        pixel searches all of them.
    """

    curves: np.ndarray
    lowest: np.ndarray
    spans: np.ndarray | None


def new_paths(columns: int, size: int, has_cells: bool) -> Paths:
    """Allocate the paths of a sweep, which all start at their next pixels."""
    slots = 1 + 3 * columns
    spans = np.tile(np.array([0, size]), (slots, 1)) if has_cells else None
    return Paths(np.zeros((slots, size), np.uint16), np.zeros(slots, np.uint16), spans)


@inlined
def _fill_span(spans, slot, size):
    """Mark all vectors of a curve as in use."""
    if spans is not None:
        spans[slot, 0], spans[slot, 1] = 0, size


@inlined
def _begin(paths, slot, first):
    """State of a path before a candidate: start of its curve, ``min L(q)``, L(q) of two blocks, least L so far."""
    start = slot * paths.curves.shape[1]
    before = vector.load(paths.curves, start + first - LANES) if first > 0 else vector.splat(np.uint16(WALL))
    here = vector.load(paths.curves, start + first)
    return start, vector.splat(paths.lowest[slot]), before, here, vector.splat(np.uint16(65535))


@inlined
def _wall_up(curves, spans, span, slots):
    """Set walls where earlier pixels of the paths in ``slots`` have searched and this one does not."""
    if spans is None:
        return
    wall, size = vector.splat(np.uint16(WALL)), curves.shape[1]
    for slot in slots:
        for k in range(spans[slot, 0], span.start, LANES):
            vector.store(curves, slot * size + k, wall)
        for k in range(span.stop, spans[slot, 1], LANES):
            vector.store(curves, slot * size + k, wall)
        spans[slot, 0], spans[slot, 1] = span.start, span.stop


@inlined
def _advance(path, curves, k, costs, penalties):
    """Apply the recurrence to the candidates ``k .. k + 31`` of a path; return its next state and their L."""
    start, lowest, before, here, minimum = path
    p1, p2 = penalties
    after = vector.load(curves, start + k + LANES) if k + LANES < curves.shape[1] else vector.splat(np.uint16(WALL))
    beside = vector.smaller(vector.slide_up(before, here), vector.slide_down(here, after))
    best = vector.smaller(here, vector.add(beside, p1))
    best = vector.add(costs, vector.subtract(vector.smaller(best, vector.add(lowest, p2)), lowest))
    return (start, lowest, here, after, vector.smaller(minimum, best)), best


@inlined
def advance_pixel(candidates, span, penalties, paths, slots, r, c, target):
    """Advance the four paths in ``slots`` by the pixel ``(r, c)`` and write their sums of L.

    ``target`` is an array and an offset: the sum of candidate k goes to ``array[offset + k]``.
    The four paths have names because numba does not unroll a loop over a tuple.
    """
    curves, lowest, spans = paths
    array, offset = target
    p1, p2, row = penalties
    path_1 = _begin(paths, slots[0], span.start)
    path_2 = _begin(paths, slots[1], span.start)
    path_3 = _begin(paths, slots[2], span.start)
    path_4 = _begin(paths, slots[3], span.start)
    for k in range(span.start, span.stop, LANES):
        costs = candidate_costs(candidates, r, c, k)
        path_1, cost_1 = _advance(path_1, curves, k, costs, penalties_of(p1, p2, row, 0, c, k))
        path_2, cost_2 = _advance(path_2, curves, k, costs, penalties_of(p1, p2, row, 1, c, k))
        path_3, cost_3 = _advance(path_3, curves, k, costs, penalties_of(p1, p2, row, 2, c, k))
        path_4, cost_4 = _advance(path_4, curves, k, costs, penalties_of(p1, p2, row, 3, c, k))
        # All stores after all loads: in `_advance` they would make sweeps 4 % slower.
        vector.store(curves, path_1[0] + k, cost_1)
        vector.store(curves, path_2[0] + k, cost_2)
        vector.store(curves, path_3[0] + k, cost_3)
        vector.store(curves, path_4[0] + k, cost_4)
        total = vector.add(vector.add(cost_1, cost_2), vector.add(cost_3, cost_4))
        vector.store(array, offset + k, total)
    lowest[slots[0]], lowest[slots[1]] = vector.smallest(path_1[4]), vector.smallest(path_2[4])
    lowest[slots[2]], lowest[slots[3]] = vector.smallest(path_3[4]), vector.smallest(path_4[4])
    _wall_up(curves, spans, span, slots)


@inlined
def advance_wave(candidates, span, penalties, paths, slots, wave, r, c):
    """Advance the two paths of a wave by the pixel ``(r, c)``."""
    curves, lowest, spans = paths
    p1, p2, row = penalties
    i, pair = (0, (slots[0], slots[1])) if wave == 0 else (2, (slots[2], slots[3]))
    path_1, path_2 = _begin(paths, pair[0], span.start), _begin(paths, pair[1], span.start)
    for k in range(span.start, span.stop, LANES):
        costs = candidate_costs(candidates, r, c, k)
        path_1, cost_1 = _advance(path_1, curves, k, costs, penalties_of(p1, p2, row, i, c, k))
        path_2, cost_2 = _advance(path_2, curves, k, costs, penalties_of(p1, p2, row, i + 1, c, k))
        vector.store(curves, path_1[0] + k, cost_1)
        vector.store(curves, path_2[0] + k, cost_2)
    lowest[pair[0]], lowest[pair[1]] = vector.smallest(path_1[4]), vector.smallest(path_2[4])
    _wall_up(curves, spans, span, pair)


@inlined
def path_slots(c, columns, falling, rising):
    """Slots of the paths through ``(r, c)``: along the row, the falling and the rising diagonal, the column."""
    # A slot belongs to a line, not to a pixel, so that a sweep updates it in place, in either direction. The diagonals
    # through ``(r, c)`` are the lines ``c - r`` and ``c + r``, modulo the columns; ``falling = -r % columns`` and
    # ``rising = r % columns`` come once a row: divisions at every pixel would make sweeps 5 % slower.
    falling += c
    rising += c
    if falling >= columns:
        falling -= columns
    if rising >= columns:
        rising -= columns
    return 0, 1 + falling, 1 + columns + rising, 1 + 2 * columns + c


@inlined
def restart(paths, slots):
    """Reset paths, so that they start at their next pixels."""
    for slot in slots:
        paths.curves[slot] = 0
        paths.lowest[slot] = 0
        _fill_span(paths.spans, slot, paths.curves.shape[1])


@inlined
def add_curve(curve, span, volume, offset):
    """Add the sums of the candidates of a pixel, of which candidate k is ``volume[offset + k]``, to its curve."""
    for k in range(span.start, span.stop, LANES):
        vector.store(curve, k, vector.add(vector.load(curve, k), vector.load(volume, offset + k)))


@inlined
def keep_curve(curve, span, volume, offset):
    """Copy the candidates of a pixel to where `add_curve` reads them."""
    for k in range(span.start, span.stop, LANES):
        vector.store(volume, offset + k, vector.load(curve, k))


@inlined
def copy_curve(curve, target):
    """Copy a curve. An assignment between slices would take seconds longer to compile."""
    for k in range(curve.size):
        target[k] = curve[k]


@part
def enter_row(paths, columns, falling, rising, down):
    """Restart the paths that enter the patch in this row: along it, and the diagonals at its two ends."""
    # The slot of a diagonal that enters holds the path that left the patch at the other end of the previous row.
    first, last = path_slots(0, columns, falling, rising), path_slots(columns - 1, columns, falling, rising)
    restart(paths, (0, first[1], last[2]) if down else (0, last[1], first[2]))


# The sweep of each wavefront, True for down, and its wave of that sweep. A wave is two paths: 0, along the row and the
# falling diagonal; 1, along the rising diagonal and the column. Wavefronts start at the upper left, the upper right,
# the lower right and the lower left corner of the image.
WAVEFRONTS = ((True, 0), (True, 1), (False, 0), (False, 1))
# The wavefront whose states a tile also hands on when it is matched, and its wave; it is of the sweep up.
LAST, LAST_WAVE = 3, WAVEFRONTS[3][1]


class Edge(NamedTuple):
    """Path states of one wavefront on a column and a row of pixels, both ``(pixels, 2, size)`` uint16.

    Those around a tile, in the column and the row that the wavefront comes from: empty without a neighbour, so paths
    start. Those of its last pixels, which it hands on: empty if nobody takes them over.
    """

    column: np.ndarray
    row: np.ndarray


class Borders(NamedTuple):
    """Path states around the pixels of a patch that are computed.

    inside: these pixels. The patch has one pixel more on each side that has a neighbour.
    around: by wavefront; a row has states for each column of the patch.
    """

    inside: Window
    around: tuple[Edge, ...]


@part
def take_over(paths, around, inside, r, falling, rising, down):
    """Set the paths that enter row ``r``, or the next row where ``r`` lies outside, to the states around."""
    columns = paths.lowest.size // 3
    for wave in range(2):
        column, row = around[wave]
        if not inside.row <= r < inside.row_stop:
            for c in range(row.shape[0]):
                _set_wave(paths, path_slots(c, columns, falling, rising), wave, row[c])
        elif column.shape[0]:
            c = 0 if down == (wave == 0) else columns - 1
            _set_wave(paths, path_slots(c, columns, falling, rising), wave, column[r - inside.row])


@inlined
def _set_wave(paths, slots, wave, states):
    for n in range(2):
        slot = slots[2 * wave + n]
        copy_curve(states[n], paths.curves[slot])
        lowest = states[n, 0]
        for k in range(1, states.shape[1]):
            lowest = min(lowest, states[n, k])
        paths.lowest[slot] = lowest
        _fill_span(paths.spans, slot, states.shape[1])


@part
def hand_on(paths, inside, r, falling, rising, wave, down, target):
    """Copy the states of a wave that leave the patch in row ``r`` to ``target``, an edge."""
    columns = paths.lowest.size // 3
    c = inside.column_stop - 1 if down == (wave == 0) else inside.column
    slots = path_slots(c, columns, falling, rising)
    for n in range(2):
        copy_curve(paths.curves[slots[2 * wave + n]], target.column[r - inside.row, n])
    if r == (inside.row_stop - 1 if down else inside.row):
        for c in range(inside.column, inside.column_stop):
            slots = path_slots(c, columns, falling, rising)
            for n in range(2):
                copy_curve(paths.curves[slots[2 * wave + n]], target.row[c - inside.column, n])
