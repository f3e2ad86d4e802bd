"""Intervals from cost curves, and their regularisation in low-confidence areas (METHOD.md, sections 5 and 8).

Letters: s and t segments (runs of low-confidence pixels in a row).
"""

import numpy as np

from sat_intervals.kernels.compiled import cached, inlined, inlined_unchecked, part
from sat_intervals.kernels.vector import LANES, first_lane, lanes_above_last, lanes_at_most, load
from sat_intervals.products import IMPOSSIBLE_COST


@inlined
def first_at_most(curve, span, limit):
    """First index of a cost of at most ``limit``; there is one: 14 ns for 64 disparities, 36 ns by single costs."""
    k = span.start
    mask = lanes_at_most(load(curve, k), limit)
    while mask == 0:
        k += LANES
        mask = lanes_at_most(load(curve, k), limit)
    return k + first_lane(mask)


@inlined
def alpha_cut(curve, span, limit):
    """First and last index whose cost is at most ``limit`` (paper eq. 5 to 7)."""
    # It is ``lowest + floor((1 - alpha) * cost_span)``. The vectors of ``span`` have costs above every limit at other
    # candidates. Vectors take 19 ns for 64 disparities and 38 ns for 128, single costs 70 and 129 ns.
    first = first_at_most(curve, span, limit)
    last = span.stop - LANES
    cut = lanes_at_most(load(curve, last), limit)
    while cut == 0:
        last -= LANES
        cut = lanes_at_most(load(curve, last), limit)
    return first, last + LANES - 1 - lanes_above_last(cut)


@inlined
def _ceil(value):
    """Round up a number that is not negative."""
    whole = np.int64(value)
    return whole + (whole < value)


@inlined_unchecked
def _crossing(curve, inside, outside, limit, settings):
    """Steps from index ``inside`` to where the linear curve crosses ``limit`` before ``outside``, rounded up."""
    # 0 at the end of the range and beside an impossible candidate. ``curve[outside]`` is above ``limit``. Both cuts of
    # a pixel take 26 ns more than `alpha_cut` with these selections, 125 ns with branches, which are hard to predict.
    near = min(max(outside, 0), settings.count - 1)
    here, there = np.int64(curve[inside]), np.int64(curve[near])
    steps = _ceil(settings.steps * (limit - here) / max(there - here, 1))
    return steps * ((near == outside) & (there != IMPOSSIBLE_COST))


@inlined
def _limit(lowest, level):
    """Largest whole cost of a cut at a level above the lowest cost."""
    return np.uint16(min(lowest + np.int64(level), IMPOSSIBLE_COST - 1))


@inlined
def _whole_cuts(curve, span, one, other):
    """First and last index of the cuts at two limits, in one pass over the curve: ``(first, last)`` of each."""
    # Every vector is visited, so that no branch depends on the curve: 16 ns for 64 disparities, 23 ns for 128.
    first_1 = first_2 = curve.size
    last_1 = last_2 = -1
    for k in range(span.start, span.stop, LANES):
        costs = load(curve, k)
        inside_1, inside_2 = lanes_at_most(costs, one), lanes_at_most(costs, other)
        first_1 = min(first_1, k + first_lane(inside_1) if inside_1 != 0 else curve.size)
        first_2 = min(first_2, k + first_lane(inside_2) if inside_2 != 0 else curve.size)
        last_1 = k + LANES - 1 - lanes_above_last(inside_1) if inside_1 != 0 else last_1
        last_2 = k + LANES - 1 - lanes_above_last(inside_2) if inside_2 != 0 else last_2
    return (first_1, last_1), (first_2, last_2)


@inlined
def _subpixel_cut(curve, limit, cut, winner, settings):
    """Bounds in steps of the whole range, where the curve crosses ``limit`` around a cut, widened to ``winner``."""
    (first, last), origin = cut, settings.offset * settings.steps
    lower = first * settings.steps - _crossing(curve, first, first - 1, limit, settings)
    upper = last * settings.steps + _crossing(curve, last, last + 1, limit, settings)
    return origin + min(lower, np.int64(winner)), origin + max(upper, _ceil(winner))


@inlined
def subpixel_cuts(curve, span, lowest, disparity, settings):
    """Bounds of the cuts at the levels ``high`` and ``low`` above ``lowest``, in steps (METHOD.md, section 16).

    They are rounded outwards and hold ``disparity``, the refined winner ``k + shift``. Returns ``(lower, upper)`` of
    both levels.
    """
    high, low = _whole_cuts(curve, span, _limit(lowest, settings.high), _limit(lowest, settings.low))
    winner = disparity * settings.steps
    return (
        _subpixel_cut(curve, lowest + settings.high, high, winner, settings),
        _subpixel_cut(curve, lowest + settings.low, low, winner, settings),
    )


@part
def find_segments(low):
    """Find the runs of low-confidence pixels.

    Returns the columns ``[start, stop)`` of each segment, int32; the first segment of each row, ``(rows + 1,)`` int64,
    whose last entry is the number of segments; and the touching segments in the rows above and below, ``(segments, 2)``
    int64, see `_find_touching`.
    """
    rows, columns = low.shape
    count = 0
    for r in range(rows):
        for c in range(columns):
            if low[r, c] and (c == 0 or not low[r, c - 1]):
                count += 1
    start, stop = np.empty(count, np.int32), np.empty(count, np.int32)
    row_start = np.empty(rows + 1, np.int64)
    s = 0
    for r in range(rows):
        row_start[r] = s
        for c in range(columns):
            if low[r, c]:
                if c == 0 or not low[r, c - 1]:
                    start[s] = c
                if c == columns - 1 or not low[r, c + 1]:
                    stop[s] = c + 1
                    s += 1
    row_start[rows] = s
    above, below = np.zeros((count, 2), np.int64), np.zeros((count, 2), np.int64)
    _find_touching(start, stop, row_start, above, -1)
    _find_touching(start, stop, row_start, below, 1)
    return start, stop, row_start, above, below


@part
def _find_touching(start, stop, row_start, neighbours, step):
    """Fill ``neighbours[s]`` with ``first, stop`` of the segments in row ``r + step`` that share a column with s."""
    rows = row_start.size - 1
    for r in range(rows):
        if not 0 <= r + step < rows:
            continue
        begin, end = row_start[r + step], row_start[r + step + 1]
        first = begin
        for s in range(row_start[r], row_start[r + 1]):
            while first < end and stop[first] <= start[s]:
                first += 1
            last = first
            while last < end and start[last] < stop[s]:
                last += 1
            neighbours[s, 0], neighbours[s, 1] = first, last


@part
def _area(s, depth, above, below, visited, area):
    """Collect the segments reached from s in at most ``depth`` steps, marked s in ``visited``; return their number."""
    area[0] = s
    visited[s] = s
    count = 1
    reached = 0
    for _ in range(depth):
        frontier = count
        for i in range(reached, frontier):
            for neighbours in (above[area[i]], below[area[i]]):
                for t in range(neighbours[0], neighbours[1]):
                    if visited[t] != s:
                        visited[t] = s
                        area[count] = t
                        count += 1
        reached = frontier
    return count


@part
def _count_bounds(steps, segment_row, start, stop, area, members, counts):
    """Fill the histograms of both bounds over the pixels of an area; return the number of pixels."""
    counts[:] = 0
    size = 0
    for i in range(members):
        s = area[i]
        lower, upper = steps[0, segment_row[s]], steps[1, segment_row[s]]
        for c in range(start[s], stop[s]):
            counts[0, lower[c]] += 1
            counts[1, upper[c]] += 1
        size += stop[s] - start[s]
    return size


@part
def _quantile(counts, size, quantile):
    """Quantile of the ``size`` values of a histogram, interpolated linearly between the two nearest ranks."""
    rank = quantile * (size - 1)
    below = int(rank)
    value = 0
    cumulative = counts[0]
    while cumulative <= below:
        value += 1
        cumulative += counts[value]
    first = value
    while cumulative <= min(below + 1, size - 1):
        value += 1
        cumulative += counts[value]
    return first + (value - first) * (rank - below)


@part
def _in_steps(lower, upper, low, minimum, per_pixel):
    """Convert bounds to steps above ``minimum``, rounded outwards: number of bins, ``(2, rows, columns)`` uint16."""
    # uint16 takes half the time of int32.
    rows, columns = low.shape
    least = most = np.float32(minimum)
    scale = np.float32(per_pixel)
    steps = np.empty((2, rows, columns), np.uint16)
    for r in range(rows):
        for c in range(columns):  # selections, not branches: they vectorise
            most = max(most, upper[r, c] if low[r, c] else most)
            steps[0, r, c] = np.uint16(np.floor(scale * (lower[r, c] - least))) if low[r, c] else 0
            steps[1, r, c] = np.uint16(np.ceil(scale * (upper[r, c] - least))) if low[r, c] else 0
    return int(np.ceil(scale * (most - least))) + 1, steps


@part
def _same_neighbours(s, t, above, below):
    """Whether two segments of a row touch the same segments, and at least one."""
    for neighbours in (above, below):
        if neighbours[s, 0] != neighbours[t, 0] or neighbours[s, 1] != neighbours[t, 1]:
            return False
    return above[s, 0] < above[s, 1] or below[s, 0] < below[s, 1]


@cached
def regularize(lower, upper, low, minimum, depth, quantile, rows, per_pixel):
    """Replace the bounds of low-confidence pixels by quantiles of the bounds of their area (paper section 3.5).

    A segment's area is made of the segments reached in at most ``depth`` steps between segments of adjacent rows
    that share a column.

    lower, upper: ``(rows, columns)`` float32 bounds in pixels.
    low: bool of the same shape: low-confidence pixels.
    minimum: first disparity of the search range. Steps are counted from it, not from the smallest bound of these rows,
        so that the rounding of a quantile does not depend on the other rows.
    depth: largest number of steps, and so of rows that an area reaches above and below.
    quantile: of the upper bounds; the lower bounds take ``1 - quantile``.
    rows: ``(first, last)``: the rows ``[first, last)`` are returned; areas may reach the others.
    per_pixel: steps per pixel of the histograms of bounds, which are rounded outwards to them; 2 if bounds are whole
        pixels, whose medians are multiples of a half. All bounds are within ``65535 / per_pixel`` pixels.
    Returns ``(lower, upper)``, float32 of shape ``(last - first, columns)``; pixels that are not low keep their bounds.
    """
    first, last = rows
    start, stop, row_start, above, below = find_segments(low)
    segments = start.size
    segment_row = np.empty(segments, np.int64)
    for r in range(row_start.size - 1):
        segment_row[row_start[r] : row_start[r + 1]] = r
    visited, area = np.full(segments, -1, np.int64), np.empty(segments, np.int64)
    bins, steps = _in_steps(lower, upper, low, minimum, per_pixel)
    counts = np.empty((2, bins), np.int32)
    new_lower, new_upper = lower[first:last].copy(), upper[first:last].copy()
    low_bound = high_bound = 0.0
    for s in range(row_start[first], row_start[last]):
        # From two steps on, segments of a row that touch the same segments have the same area. Reusing it avoids
        # quadratic time for a row of short segments beside a long one, but not for two dotted rows below a full one.
        # 40 rows of 600 pixels, full and dotted in turn: 1.6 ms, else 49; ordinary areas: 2.9 ms, else 2.6.
        if not (depth > 1 and s > row_start[segment_row[s]] and _same_neighbours(s - 1, s, above, below)):
            members = _area(s, depth, above, below, visited, area)
            size = _count_bounds(steps, segment_row, start, stop, area, members, counts)
            low_bound = minimum + _quantile(counts[0], size, 1.0 - quantile) / per_pixel
            high_bound = minimum + _quantile(counts[1], size, quantile) / per_pixel
        new_lower[segment_row[s] - first, start[s] : stop[s]] = low_bound
        new_upper[segment_row[s] - first, start[s] : stop[s]] = high_bound
    return new_lower, new_upper
