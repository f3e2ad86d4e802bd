"""Every kernel again, slow and obvious: the method's text in loops, exact integers and fractions.

Nothing here is shared with the kernels but the table of constants. Letters: r row, c column, k disparity
index, d = minimum + k disparity, R = window // 2. Left pixel (r, c) at index k faces ``right[r, c + k]``:
right arrays have ``columns + count - 1`` columns. Section numbers are those of METHOD.md.

Costs are int64 ``(rows, columns, count)`` with IMPOSSIBLE_COST at impossible candidates; indices of
disparities are int64 with -1 where there is none.
"""

import math
from decimal import Decimal
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sat_intervals.products import (
    IMPOSSIBLE_COST,
    INVALID,
    LEFT_MASKED,
    LEFT_WINDOW,
    MASKED,
    MISMATCH,
    NO_CANDIDATE,
    NO_DATA,
    NO_DISPARITY,
    NOT_REFINED,
    OCCLUSION,
    OPEN_ABOVE,
    OPEN_BELOW,
    RANGE_END,
    RANGE_INCOMPLETE,
    REGULARIZED,
    REJECTED,
    RIGHT_MASKED,
)

NONE = -1  # the index of a disparity that does not exist
PATHS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


# ---- 1. Matching cost --------------------------------------------------------------------------------------
def census(pixels, window):
    """Section 1: ``(rows - 2R, columns - 2R, window^2)`` bits, 1 where the neighbour is above the centre."""
    radius = window // 2
    rows, columns = (size - 2 * radius for size in pixels.shape)
    bits = np.zeros((rows, columns, window * window), bool)
    for r in range(rows):
        for c in range(columns):
            bits[r, c] = (pixels[r : r + window, c : c + window] > pixels[r + radius, c + radius]).ravel()
    return bits


def window_state(state, window):
    """Section 1: the union of the states of a window's pixels, 0 where the whole window is usable."""
    radius = window // 2
    rows, columns = (size - 2 * radius for size in state.shape)
    union = np.zeros((rows, columns), np.uint8)
    for r in range(rows):
        for c in range(columns):
            union[r, c] = np.bitwise_or.reduce(state[r : r + window, c : c + window], axis=None)
    return union


def possible(left_state, right_state):
    """Section 1: a candidate is impossible when either window's state is not 0."""
    rows, columns = left_state.shape
    count = right_state.shape[1] - columns + 1
    result = np.zeros((rows, columns, count), bool)
    for k in range(count):
        result[:, :, k] = (left_state == 0) & (right_state[:, k : k + columns] == 0)
    return result


def census_cost(left, right, left_state, right_state, window):
    """Section 1: Hamming distances of the windows of two padded patches."""
    left_bits, right_bits = census(left, window), census(right, window)
    searched = possible(window_state(left_state, window), window_state(right_state, window))
    columns = left_bits.shape[1]
    cost = np.full(searched.shape, IMPOSSIBLE_COST, np.int64)
    for k in range(cost.shape[2]):
        distance = (left_bits != right_bits[:, k : k + columns]).sum(axis=2)
        cost[:, :, k] = np.where(searched[:, :, k], distance, IMPOSSIBLE_COST)
    return cost


# ---- 2, 3. Semi-global matching and the cost span ----------------------------------------------------------
def aggregate(cost, window, p1, p2):
    """Section 2: the sum of the eight path costs; paths restart behind a pixel without a candidate."""
    return aggregate_with(cost, window * window + p2 + 1, lambda step: (p1, p2))


def aggregate_with(cost, price, penalties):
    """Section 2, with the cost of an impossible candidate; ``penalties(step)`` gives P1 and P2 of a path.

    Both are numbers, or arrays of the shape of the cost that hold what it takes to come to (r, c, k) on that path.
    """
    impossible = cost == IMPOSSIBLE_COST
    empty = impossible.all(axis=2)
    priced = np.where(impossible, price, cost)
    total = 0
    for step in PATHS:
        p1, p2 = (np.broadcast_to(p, cost.shape) for p in penalties(step))
        total = total + path_cost(priced, empty, step, p1, p2)
    return np.where(impossible, IMPOSSIBLE_COST, total)


def path_cost(cost, empty, step, p1, p2):
    """Section 2: L along one path; ``step`` leads from the previous pixel q to the pixel p."""
    rows, columns = cost.shape[:2]
    path = np.zeros_like(cost)
    for r in range(rows)[:: step[0] or 1]:
        for c in range(columns)[:: step[1] or 1]:
            if empty[r, c]:
                continue
            q = r - step[0], c - step[1]
            path[r, c] = cost[r, c]
            if 0 <= q[0] < rows and 0 <= q[1] < columns and not empty[q]:
                least = path[q].min()
                jump = least + p2[r, c]
                smaller, larger = jump.copy(), jump.copy()
                smaller[1:] = path[q][:-1] + p1[r, c, 1:]
                larger[:-1] = path[q][1:] + p1[r, c, :-1]
                path[r, c] += np.minimum.reduce([path[q], smaller, larger, jump]) - least
    return path


def edge_penalties(left, right, count, step, tables, edges):
    """P1 and P2 of a path by the number of images, none to both, whose gradient along it is above its edge.

    ``tables`` are P1 and P2 by that number.
    """
    shape = *left.shape, count
    p1, p2 = np.zeros(shape, int), np.zeros(shape, int)
    for r, c, k in np.ndindex(shape):
        found = gradient(left, (r, c), step) > edges[0], gradient(right, (r, c + k), step) > edges[1]
        p1[r, c, k], p2[r, c, k] = (table[sum(found)] for table in tables)
    return p1, p2


def gradient(image, p, step):
    """Between a pixel and the one before it on a path; 0 where there is none."""
    q = p[0] - step[0], p[1] - step[1]
    inside = 0 <= q[0] < image.shape[0] and 0 <= q[1] < image.shape[1]
    return abs(float(image[p]) - float(image[q])) if inside else 0.0


def correlation(left, right):
    """1 - cosine of unit vectors ``(features, rows, columns)``; ``right`` has count - 1 columns more."""
    _, rows, columns = left.shape
    cost = np.zeros((rows, columns, right.shape[2] - columns + 1))
    for r, c, k in np.ndindex(cost.shape):
        cost[r, c, k] = 1 - np.dot(left[:, r, c].astype(float), right[:, r, c + k].astype(float))
    return cost


def span(window, p2):
    """Section 3: the declared span of the cost; ``p2=None`` without SGM."""
    return window * window - 1 if p2 is None else 8 * (window * window - 1 + p2)


# ---- 4. Ambiguity and confidence ---------------------------------------------------------------------------
def etas(eta_max, eta_step):
    """Section 4: 0, step, 2 step, ... below eta_max, as exact fractions of the decimals in the settings."""
    stop, step = Fraction(Decimal(str(eta_max))), Fraction(Decimal(str(eta_step)))
    return [i * step for i in range(math.ceil(stop / step))]


def ambiguity(volume, eta_max, eta_step, cost_span):
    """Section 4: candidates within eta * span of the minimum or impossible, over all etas; 0 where empty."""
    result = np.zeros(volume.shape[:2], np.int64)
    fractions = etas(eta_max, eta_step)
    for r, c in np.ndindex(result.shape):
        searched = volume[r, c] != IMPOSSIBLE_COST
        if searched.any():
            above = volume[r, c] - volume[r, c].min()
            for eta in fractions:
                # above <= eta * span, multiplied by eta's denominator: integers on both sides
                near = above * eta.denominator <= eta.numerator * cost_span
                result[r, c] += np.count_nonzero(near | ~searched)
    return result


def normalize(amounts, searched, p1, p99):
    """Section 4: confidence float32, NaN where no candidate was searched."""
    result = np.full(amounts.shape, np.nan, np.float32)
    for r, c in np.argwhere(searched):
        amount = float(amounts[r, c])
        if p99 <= p1:
            result[r, c] = 1 if amount <= p1 else 0
        else:
            result[r, c] = 1 - min(max((amount - p1) / (p99 - p1), 0.0), 1.0)
    return result


def low_confidence(confidence, threshold, kernel):
    """Section 8: the least confidence over 1 x kernel is at most the threshold; never where there is none."""
    rows, columns = confidence.shape
    low = np.zeros(confidence.shape, bool)
    for r in range(rows):
        for c in range(columns):
            near = confidence[r, max(0, c - kernel // 2) : c + kernel // 2 + 1]
            least = min([np.float32(1), *near[~np.isnan(near)]])
            low[r, c] = not np.isnan(confidence[r, c]) and least <= np.float32(threshold)
    return low


def textureless(view, minimum, count, window):
    """Section 1: no usable window of the pixel and of its candidates changes along a row."""
    radius = window // 2
    result = np.zeros(view.left.shape, bool)

    def flat(image, state, r, c):
        """None where the window is not usable."""
        rows, columns = image.shape
        if not (radius <= r < rows - radius and radius <= c < columns - radius):
            return None
        around = np.s_[r - radius : r + radius + 1, c - radius : c + radius + 1]
        return None if state[around].any() else bool((np.ptp(image[around], axis=1) == 0).all())

    for r, c in np.ndindex(result.shape):
        candidates = [flat(view.right, view.right_state, r, c + minimum + k) for k in range(count)]
        result[r, c] = flat(view.left, view.left_state, r, c) is True and False not in candidates
    return result


# ---- 5. Possibility and alpha-cut --------------------------------------------------------------------------
def alpha_cut(volume, alpha, cost_span, extend):
    """Section 5: the first and the last index with possibility >= alpha, pushed out at S = min S."""
    lower, upper = (np.full(volume.shape[:2], NONE) for _ in range(2))
    count = volume.shape[2]
    for r, c in np.ndindex(lower.shape):
        costs = {k: int(s) for k, s in enumerate(volume[r, c]) if s != IMPOSSIBLE_COST}
        if not costs:
            continue
        least = min(costs.values())
        cut = [k for k, s in costs.items() if 1 - Fraction(s - least, cost_span) >= Fraction(Decimal(str(alpha)))]
        first, last = min(cut), max(cut)
        lower[r, c] = max(first - 1, 0) if extend and costs[first] == least else first
        upper[r, c] = min(last + 1, count - 1) if extend and costs[last] == least else last
    return lower, upper


def subpixel_cut(volume, level, steps, refine):
    """Section 16: where the linear curve leaves ``min S + level`` (a Fraction), in steps, widened to hold the V-fit."""
    lower, upper = (np.full(volume.shape[:2], NONE) for _ in range(2))
    for r, c in np.ndindex(lower.shape):
        costs = {k: int(s) for k, s in enumerate(volume[r, c]) if s != IMPOSSIBLE_COST}
        if not costs:
            continue
        limit = min(costs.values()) + level
        cut = [k for k, s in costs.items() if s <= limit]
        ends = []
        for k, step in ((min(cut), -1), (max(cut), 1)):
            beside = costs.get(k + step)
            ends.append(k + (0 if beside is None else step * (limit - costs[k]) / Fraction(beside - costs[k])))
        winner = min(costs, key=lambda k: (costs[k], k))
        winner += vfit_shift(volume[r, c], winner)[0] if refine else 0
        lower[r, c] = math.floor(steps * min(ends[0], winner))
        upper[r, c] = math.ceil(steps * max(ends[1], winner))
    return lower, upper


def cut_level(alpha, cost_span):
    """Section 5: the largest ``S - min S`` that belongs to the cut."""
    return int((1 - Decimal(str(alpha))) * cost_span)


# ---- 6. Disparity ------------------------------------------------------------------------------------------
def winner_takes_all(volume):
    """Section 6: the index of the least cost, the smallest at ties."""
    return np.where(volume.min(axis=2) == IMPOSSIBLE_COST, NONE, volume.argmin(axis=2))


def vfit(volume, winner, minimum):
    """Section 6: float32 disparities and where the refinement was done."""
    disparity = np.full(winner.shape, np.nan, np.float32)
    refined = np.zeros(winner.shape, bool)
    for r, c in np.argwhere(winner != NONE):
        shift, refined[r, c] = vfit_shift(volume[r, c], int(winner[r, c]))
        disparity[r, c] = float(minimum + int(winner[r, c]) + shift)
    return disparity, refined


def vfit_shift(curve, k):
    """The shift of the winner k, a Fraction, and whether it was refined."""
    if 0 < k < curve.size - 1:
        before, here, after = (int(s) for s in curve[k - 1 : k + 2])
        if before != IMPOSSIBLE_COST and after != IMPOSSIBLE_COST and max(before, after) > here:
            return Fraction(before - after, 2 * (max(before, after) - here)), True
    return Fraction(0), False


def right_winners(volume):
    """Section 6, ``fast``: argmin over k of ``S(r, j - k, k)`` for right column j, the largest k at ties."""
    rows, columns, count = volume.shape
    winners = np.full((rows, columns + count - 1), NONE)
    costs = np.full(winners.shape, IMPOSSIBLE_COST)
    for r, j in np.ndindex(winners.shape):
        for k in range(count):
            here = volume[r, j - k, k] if 0 <= j - k < columns else IMPOSSIBLE_COST
            if here != IMPOSSIBLE_COST and here <= costs[r, j]:
                winners[r, j], costs[r, j] = k, here
    return winners, costs


def absolute(index, minimum):
    """Indices as disparities, int16 with NO_DISPARITY."""
    return np.where(index == NONE, NO_DISPARITY, index + minimum).astype(np.int16)


def cross_check(winner, right_winner, minimum, tolerance):
    """Section 6: 0 where kept or without winner, else OCCLUSION or MISMATCH, of ``absolute`` disparities."""
    count = right_winner.shape[1] - winner.shape[1] + 1
    result = np.zeros(winner.shape, np.uint16)
    for r, c in np.argwhere(winner != NO_DISPARITY):
        seen = [int(d) for d in right_winner[r, c : c + count]]
        d, back = int(winner[r, c]), seen[winner[r, c] - minimum]
        if back == NO_DISPARITY or abs(d - back) > tolerance:
            agrees = any(seen[k] == minimum + k for k in range(count))
            result[r, c] = MISMATCH if agrees else OCCLUSION
    return result


# ---- 7. Median ---------------------------------------------------------------------------------------------
def median(values, kept, size):
    """Section 7: kept pixels get the median over the kept pixels of their window."""
    result = values.copy()
    radius = size // 2
    for r, c in np.argwhere(kept):
        near = np.s_[max(0, r - radius) : r + radius + 1, max(0, c - radius) : c + radius + 1]
        ordered = sorted(values[near][kept[near]])
        middle = len(ordered) // 2
        if len(ordered) % 2:
            result[r, c] = ordered[middle]
        else:
            result[r, c] = (ordered[middle - 1] + ordered[middle]) / np.float32(2)
    return result


# ---- 8. Regularisation of intervals ------------------------------------------------------------------------
def segments(low):
    """Section 8: runs of low-confidence pixels in a row, as sets of pixels."""
    runs = []
    for r in range(low.shape[0]):
        for c in range(low.shape[1]):
            if low[r, c]:
                if c == 0 or not low[r, c - 1]:
                    runs.append(set())
                runs[-1].add((r, c))
    return runs


def neighbourhood(runs, i, depth):
    """Section 8: A(segment i), the segments reached in at most ``depth`` steps between touching segments."""
    reached = {i}
    for _ in range(depth):
        beside = {(r + step, c) for j in reached for r, c in runs[j] for step in (-1, 1)}
        reached |= {j for j, run in enumerate(runs) if run & beside}
    return reached


def quantile(values, share):
    """Sections 4 and 8: linear interpolation between order statistics, as a Fraction."""
    ordered = sorted(Fraction(float(value)) for value in values)
    position = share * (len(ordered) - 1)
    below = math.floor(position)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (position - below) * (ordered[above] - ordered[below])


def regularize(lower, upper, low, depth, share):
    """Section 8: low pixels get the quantiles ``1 - share`` and ``share`` of all bounds of A."""
    lower, upper = lower.copy(), upper.copy()
    old_lower, old_upper = lower.copy(), upper.copy()
    share = Fraction(Decimal(str(share)))
    runs = segments(low)
    for i, run in enumerate(runs):
        pixels = [pixel for j in neighbourhood(runs, i, depth) for pixel in runs[j]]
        for pixel in run:
            lower[pixel] = float(quantile([old_lower[p] for p in pixels], 1 - share))
            upper[pixel] = float(quantile([old_upper[p] for p in pixels], share))
    return lower, upper


# ---- 9. Validity -------------------------------------------------------------------------------------------
def right_bits(right_window_state, columns):
    """Section 9, bits 1 and 7: no right window is usable; bit 7 if the right mask is one of the reasons."""
    count = right_window_state.shape[1] - columns + 1
    bits = np.zeros((right_window_state.shape[0], columns), np.uint16)
    for r, c in np.ndindex(bits.shape):
        facing = right_window_state[r, c : c + count]
        if (facing != 0).all():
            bits[r, c] = RIGHT_MASKED if (facing & MASKED).any() else NO_CANDIDATE
    return bits


def validity(left_pixel_state, left_window_state, right_window_state, refined):
    """Section 9: the bits that are set in a tile. Without refinement ``refined`` is False everywhere."""
    searched = possible(left_window_state, right_window_state)
    bits = right_bits(right_window_state, left_window_state.shape[1])
    for r, c in np.ndindex(bits.shape):
        if left_window_state[r, c]:
            bits[r, c] |= LEFT_WINDOW
        if left_pixel_state[r, c] & MASKED:
            bits[r, c] |= LEFT_MASKED
        if searched[r, c].any():
            if not searched[r, c].all():
                bits[r, c] |= RANGE_INCOMPLETE
            if not refined[r, c]:
                bits[r, c] |= NOT_REFINED
    return bits


# ---- The whole method on one pair, untiled -----------------------------------------------------------------
def cut(image, column, width, radius, fill):
    """Columns ``[column, column + width)`` and ``radius`` pixels more on every side, ``fill`` outside."""
    rows, columns = image.shape
    result = np.full((rows + 2 * radius, width + 2 * radius), fill, image.dtype)
    for c in range(width + 2 * radius):
        if 0 <= column - radius + c < columns:
            result[radius : radius + rows, c] = image[:, column - radius + c]
    return result


def match_view(view, minimum, maximum, config):
    """Sections 1, 2: the cost volume of ``view.left`` over a search range, and the states of the windows."""
    window, radius = config.cost.window, config.cost.window // 2
    columns = view.left.shape[1]
    facing = columns + maximum - minimum
    left, right = cut(view.left, 0, columns, radius, 0), cut(view.right, minimum, facing, radius, 0)
    states = (
        cut(view.left_state, 0, columns, radius, NO_DATA),
        cut(view.right_state, minimum, facing, radius, NO_DATA),
    )
    volume = census_cost(left, right, *states, window)
    if config.sgm is not None:
        volume = aggregate(volume, window, int(config.sgm.p1), int(config.sgm.p2))
    return volume, *(window_state(state, window) for state in states)


def facing_winners(view, volume, config):
    """Section 6: d_R of every right pixel that faces the left image, by either method."""
    minimum, maximum = config.disparity.minimum, config.disparity.maximum
    if config.cross_check.method == "fast":
        return absolute(right_winners(volume)[0], minimum)
    swapped = SimpleNamespace(
        left=view.right, right=view.left, left_state=view.right_state, right_state=view.left_state
    )
    right_volume, _, _ = match_view(swapped, -maximum, -minimum, config)
    # The right view's disparity is -d: its smallest at ties is the largest d.
    seen = absolute(winner_takes_all(right_volume), -maximum)
    seen = np.where(seen == NO_DISPARITY, NO_DISPARITY, -seen).astype(np.int16)
    return cut(seen, minimum, volume.shape[1] + maximum - minimum, 0, NO_DISPARITY)


def percentiles_of(amounts, searched, config):
    """Section 4: p1 and p99 as given, of the whole image, or 0 and the largest ambiguity if those are equal."""
    settings = config.ambiguity
    if settings.p1 is not None:
        return settings.p1, settings.p99
    largest = float(len(etas(settings.eta_max, settings.eta_step)) * config.disparity.count)
    if settings.normalization == "range":
        return 0.0, largest
    p1, p99 = (float(quantile(amounts[searched], Fraction(percent, 100))) for percent in (1, 99))
    return (p1, p99) if p1 < p99 else (0.0, largest)


def cuts_of(volume, cost_span, config):
    """Sections 5 and 16: bounds of each pixel as indices, those of alpha or those of both classes of a coverage."""
    refine = config.refinement is not None
    if config.interval.coverage is None:
        yield alpha_cut(volume, config.interval.alpha, cost_span, extend=refine)
        return
    for level in (config.cuts.high, config.cuts.low):
        yield tuple(bound / 64 for bound in subpixel_cut(volume, Fraction(level), 64, refine))


def match_arrays(left, right, left_state, right_state, config):
    """All sections on one small pair; ``config`` has the YAML's sections as attributes, None = switched off.

    Returns ``disparity``, ``lower``, ``upper``, ``confidence`` (float32) and ``validity`` (uint16) as in the files.
    """
    left_state = left_state | np.where(np.isfinite(left), 0, NO_DATA).astype(np.uint8)
    right_state = right_state | np.where(np.isfinite(right), 0, NO_DATA).astype(np.uint8)
    view = SimpleNamespace(left=left, right=right, left_state=left_state, right_state=right_state)
    minimum, maximum = config.disparity.minimum, config.disparity.maximum
    volume, left_windows, right_windows = match_view(view, minimum, maximum, config)
    cost_span = span(config.cost.window, config.sgm and int(config.sgm.p2))

    is_subpixel = config.interval is not None and config.interval.coverage is not None
    winner = winner_takes_all(volume)
    searched = winner != NONE
    disparity, refined = vfit(volume, winner, minimum)
    if config.refinement is None:
        disparity = np.where(searched, winner + minimum, np.nan).astype(np.float32)
        refined[:] = False
    flags = validity(left_state, left_windows, right_windows, refined)
    lower, upper = (np.full(winner.shape, np.nan, np.float32) for _ in range(2))
    untextured = searched & textureless(view, minimum, config.disparity.count, config.cost.window)
    of_levels = []
    if config.interval is not None:
        for bounds in cuts_of(volume, cost_span, config):
            lower, upper = (np.where(searched, b + minimum, np.nan).astype(np.float32) for b in bounds)
            lower[untextured], upper[untextured] = minimum, maximum
            of_levels.append((lower, upper))
        lower, upper = of_levels[0]
    count = maximum - minimum + 1
    below, above = (searched & ~untextured & end for end in (winner <= 1, winner >= count - 2))
    if count > 8:
        flags[below | above] |= RANGE_END

    if config.cross_check is not None:
        seen = facing_winners(view, volume, config)
        flags |= cross_check(absolute(winner, minimum), seen, minimum, config.cross_check.tolerance)
    kept = (flags & INVALID) == 0

    confidence = np.full(winner.shape, np.nan, np.float32)
    if config.ambiguity is not None and searched.any():
        amounts = ambiguity(volume, config.ambiguity.eta_max, config.ambiguity.eta_step, cost_span)
        amounts[untextured] = len(etas(config.ambiguity.eta_max, config.ambiguity.eta_step)) * config.disparity.count
        confidence = normalize(amounts, searched, *percentiles_of(amounts, searched, config))
    if (config.disparity.open_ends or is_subpixel) and count > 8:
        confidence[below | above] = 0
        flags[below] |= OPEN_BELOW
        flags[above] |= OPEN_ABOVE

    if config.regularization is not None:
        low = low_confidence(confidence, config.regularization.threshold, config.regularization.kernel)
        if len(of_levels) == 2:
            lower, upper = (np.where(low, *bounds) for bounds in zip(*of_levels[::-1], strict=True))
    if config.median is not None:
        disparity = median(disparity, kept, config.median.size)
        if config.interval is not None:
            lower, upper = (median(bound, kept, config.median.size) for bound in (lower, upper))
    if config.regularization is not None:
        share = config.cuts.quantile if is_subpixel else config.regularization.quantile
        if share is not None and is_subpixel:
            lower, upper = (
                np.where(low, rounded(8 * bound) / 8, bound) for rounded, bound in ((np.floor, lower), (np.ceil, upper))
            )
        if share is not None:
            lower, upper = regularize(lower, upper, low, config.regularization.depth, share)
        flags |= np.where(low, REGULARIZED, 0).astype(np.uint16)
    if config.interval is not None:
        lower, upper = np.minimum(lower, disparity), np.maximum(upper, disparity)
    if is_subpixel:
        lower, upper = np.floor(64 * lower) / 64, np.ceil(64 * upper) / 64

    hidden = INVALID & ~REJECTED if config.products.keep_rejected else INVALID
    shown = (flags & hidden) == 0
    disparity, lower, upper = (np.where(shown, band, np.float32(np.nan)) for band in (disparity, lower, upper))
    return SimpleNamespace(disparity=disparity, lower=lower, upper=upper, confidence=confidence, validity=flags)


def waves(row, column, steepness, deviation, seed=0):
    """Grey values at any place: 300 waves of random direction, with frequencies of this deviation, about 500."""
    random = np.random.default_rng(seed)
    down, across = np.clip(random.normal(0, steepness, (2, 300)), -2.4, 2.4)
    phase = random.uniform(0, 2 * np.pi, 300)
    total = sum(np.cos(i * row + j * column + start) for i, j, start in zip(down, across, phase, strict=True))
    return 500 + deviation * np.sqrt(2 / 300) * total


# ---- Least squares -----------------------------------------------------------------------------------------
def cubic(t):
    """Keys' kernel with a = -1/2."""
    t = np.abs(t)
    return np.where(t <= 1, (1.5 * t - 2.5) * t * t + 1, np.where(t < 2, ((-0.5 * t + 2.5) * t - 4) * t + 2, 0))


def facing_value(row, place):
    """Section 19: value and derivative of a row of the right image at a place; NaN at no data."""
    near = int(np.floor(place)) + np.arange(-1, 3)
    along = (8 * (row[near + 1] - row[near - 1]) - row[near + 2] + row[near - 2]) / 12
    return cubic(place - near) @ row[near], cubic(place - near) @ along


def around(shape, r, c, radius=2):
    """Window of a pixel inside an image, as indices, and its rows and columns from the pixel."""
    rows, columns = np.mgrid[r - radius : r + radius + 1, c - radius : c + radius + 1]
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    return (rows[inside], columns[inside]), rows[inside] - r, columns[inside] - c


def fit(left, value, slope, disparity, r, c):
    """Section 19: shift and standard deviation of the least-squares fit of one pixel; NaN for none."""
    nothing = np.nan, np.nan
    if not np.isfinite([left[r, c], value[r, c], disparity[r, c]]).all():
        return nothing
    window, _, _ = around(left.shape, r, c)
    b, v, g = (image[window].astype(np.float64) for image in (left, value, slope))
    told = (np.abs(disparity[window] - disparity[r, c]) <= 1) & np.isfinite(b) & np.isfinite(v) & np.isfinite(g)
    if told.sum() < 6:
        return nothing
    b, v, g = b[told] - left[r, c], v[told] - value[r, c], g[told]
    design = np.stack([v, g, np.ones_like(v)], axis=1)
    centred = design[:, :2] - design[:, :2].mean(axis=0)
    (vv, vg), (_, gg) = centred.T @ centred
    if not (vv > 0 and vv * gg - vg**2 > 1e-5 * vv * gg):
        return nothing
    found, *_ = np.linalg.lstsq(design, b, rcond=None)
    gain, moved, _ = found
    if gain <= 0.1 or abs(moved) > gain:
        return nothing
    variance = ((b - design @ found) ** 2).sum() / (told.sum() - 3)
    variance *= np.linalg.inv(design.T @ design)[1, 1] / gain**2
    return moved / gain * 0.0625 / (0.0625 + variance), np.sqrt(variance)


def on_plane(disparity, deviation, r, c):
    """Section 19: the middle of the plane through the disparities around a pixel with a fit."""
    if np.isnan(deviation[r, c]):
        return disparity[r, c]
    window, down, across = around(disparity.shape, r, c, 4)
    x = disparity[window].astype(np.float64) - disparity[r, c]
    told = np.abs(x) <= 0.75
    weight = 1 / (np.nan_to_num(deviation[window][told].astype(np.float64), nan=1.0) ** 2 + 0.01)
    design = np.stack([np.ones(told.sum()), down[told], across[told]], axis=1)
    matrix = design.T @ (weight[:, np.newaxis] * design) + 1e-3 * weight.sum() * np.diag([0, 1, 1])
    return disparity[r, c] + np.linalg.solve(matrix, design.T @ (weight * x[told]))[0]


# ---- Inputs for the tests ----------------------------------------------------------------------------------
def patch_pair(seed, rows, columns, count, window, style="shifted"):
    """A padded pair of patches with few grey levels, so that ties abound: float32 pixels, no states yet.

    ``shifted``: the right view is the left one moved by a varying disparity, with some noise; ``noise``:
    nothing in common; ``flat``: almost no texture.
    """
    random = np.random.default_rng(seed)
    rows, columns = rows + 2 * (window // 2), columns + 2 * (window // 2)
    left = random.integers(0, 2 if style == "flat" else 12, (rows, columns))
    right = random.integers(0, 2 if style == "flat" else 12, (rows, columns + count - 1))
    if style == "flat":
        left[random.random(left.shape) < 0.9] = 0
        right[random.random(right.shape) < 0.9] = 0
    if style == "shifted":
        for r in range(rows):
            if r % 4 == 0:
                k = int(random.integers(0, count))
            right[r, k : k + columns] = left[r]
            noisy = random.random(right.shape[1]) < 0.1
            right[r, noisy] = random.integers(0, 12, noisy.sum())
    return left.astype(np.float32), right.astype(np.float32)


@st.composite
def states(draw, shape):
    """Pixel states of a patch: usable, scattered holes and masks, edges without data, or nothing usable."""
    rows, columns = shape
    kind = draw(st.sampled_from(["usable", "scattered", "scattered", "scattered", "edges", "both", "empty"]))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    state = np.zeros(shape, np.uint8)
    if kind in ("scattered", "both"):
        for _ in range(random.integers(1, 4)):
            state[random.integers(rows), random.integers(columns)] = random.integers(1, 4)
    if kind in ("edges", "both"):
        state[: random.integers(0, 2)] |= NO_DATA
        state[rows - random.integers(0, 2) :] |= MASKED
        state[:, : random.integers(0, columns // 4 + 1)] |= NO_DATA
        state[:, columns - random.integers(0, columns // 4 + 1) :] |= np.uint8(random.integers(1, 3))
    if kind == "empty" and draw(st.booleans()):
        state[:] = draw(st.integers(1, 3))
    return state


def scene_of(patches, *, window, minimum, count, states=None, p1=8, p2=32, regularized=True):
    """Two padded patches with their states, by default valid, a window, a search range and penalties."""
    states = states or [np.zeros(patch.shape, np.uint8) for patch in patches]
    images = dict(zip(("left", "right", "left_state", "right_state"), (*patches, *states), strict=True))
    settings = {"window": window, "minimum": minimum, "count": count, "p1": p1, "p2": p2, "regularized": regularized}
    return SimpleNamespace(**images, **settings)


@st.composite
def scenes(draw, counts=(1, 2, 3, 5, 9, 16, 31, 32, 33), windows=(3, 3, 5, 7), rows=8, columns=20):
    """Two padded patches with their states, a window, a search range and penalties, as a namespace."""
    window, count = draw(st.sampled_from(windows)), draw(st.sampled_from(counts))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rows, columns = int(random.integers(1, rows + 1)), int(random.integers(1, columns + 1))
    style = draw(st.sampled_from(["shifted", "shifted", "noise", "flat"]))
    patches = patch_pair(random, rows, columns, count, window, style)
    p1 = draw(st.integers(0, 40))
    return scene_of(
        patches,
        states=[draw(states(patch.shape)) for patch in patches],
        window=window,
        minimum=draw(st.sampled_from([0, -count + 1, -200, 7])),
        count=count,
        p1=p1,
        p2=p1 + draw(st.integers(0, 60)),
        regularized=draw(st.sampled_from([True, True, False])),
    )


def volume_of(scene):
    """The cost volume of a scene."""
    cost = census_cost(scene.left, scene.right, scene.left_state, scene.right_state, scene.window)
    return aggregate(cost, scene.window, scene.p1, scene.p2) if scene.regularized else cost


def span_of(scene):
    """The declared span of a scene's cost."""
    return span(scene.window, scene.p2 if scene.regularized else None)


def settings_of(scene, alpha="0.9", eta_max="0.7", eta_step="0.01", refine=True, cuts=(-1, -1), steps=1):
    """The fields of ``sat_intervals.kernels.sweeps.Settings`` for a scene; None = the step is off."""
    cost_span = span_of(scene)
    weights = np.zeros(0, np.uint16)
    if eta_max is not None:
        levels = np.array([math.floor(eta * cost_span) for eta in etas(eta_max, eta_step)])
        weights = np.array([np.count_nonzero(x <= levels) for x in range(cost_span + 1)], np.uint16)
    return {
        "minimum": scene.minimum,
        "count": scene.count,
        "impossible": scene.window**2 + scene.p2 + 1,
        "p1": scene.p1,
        "p2": scene.p2,
        "regularized": scene.regularized,
        "cut_level": NONE if alpha is None else cut_level(alpha, cost_span),
        "weights": weights,
        "refine": refine,
        "high": float(cuts[0]),
        "low": float(cuts[1]),
        "steps": steps,
    }


def halves(shape, least=-16, most=16):
    """Hypothesis float32 images of halves of integers, whose values often tie."""
    return hnp.arrays(np.float32, shape, elements=st.integers(least, most).map(lambda value: value / 2))


# ---- Voids of surfaces (section 23) --------------------------------------------------------------------------
def rim_of(height, i, j, reach):
    """The first known cells from a cell in 16 directions, and known ones twice as far: rows and columns."""
    turn = math.sqrt(2) - 1
    first = (0, 1), (1, 0), (1, 1), (turn, 1), (1, turn)
    steps = {(a * m, b * n) for m in (-1, 1) for n in (-1, 1) for a, b in first}
    found, behind = [], []

    def is_known(row, column):
        return 0 <= row < height.shape[0] and 0 <= column < height.shape[1] and not np.isnan(height[row, column])

    for down, across in steps:
        for step in range(1, math.floor(reach / math.hypot(down, across)) + 1):
            cell, far = ([math.floor(i + m * down + 0.5), math.floor(j + m * across + 0.5)] for m in (step, 2 * step))
            if is_known(*cell):
                found.append(cell)
                behind += [far] * is_known(*far)
                break
    return found, behind


def filled(height, lower, upper, voids, reach, apart):
    result = np.full((3, *height.shape), np.nan)
    for i, j in zip(*np.nonzero(voids), strict=True):
        rim, behind = rim_of(height, i, j, reach)
        if len(rim) < 10:
            continue
        both = tuple(np.transpose(rim + behind))
        y, x = both[0] - i, both[1] - j
        root = 1 / np.hypot(x, y)  # of the weights
        terms = np.stack([np.ones(len(x)), x, y], axis=1)
        plane = np.linalg.lstsq(terms * root[:, None], height[both] * root, rcond=None)[0]
        is_smooth = np.abs(height[both] - terms @ plane).max() <= apart
        at = tuple(np.transpose(rim))
        z = height[at]
        value = plane[0] if is_smooth else np.sort(z)[1]
        two = np.argsort(z)[:2]
        below, above = (max(one.mean(), one[two].mean()) for one in (z - lower[at], upper[at] - z))
        top = value + max(above, 0 if is_smooth else 0.95 * (z.max() - value))
        result[:, i, j] = value, value - below, top
    return result
