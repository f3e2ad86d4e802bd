"""Costs of heights of ground cells: images resampled to the ground at each height and compared (METHOD.md, section 20).

Letters: h height, n image, p pair, r row, c column of cells; the fine grid of an image has FINE pixels along a cell.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached, inlined, part
from sat_intervals.kernels.row_offsets import cubic_weights

# Pixels of the fine grid along a cell: an image is resampled to it once, and to each height from there.
FINE = 2
# Radius of the Census window in cells, and its bits.
RADIUS = 2
BITS = (2 * RADIUS + 1) ** 2 - 1
# Hamming distance of a pair that does not see the cell: above every other.
_UNSEEN = 255


def planes_of(fine: np.ndarray) -> np.ndarray:
    """Return a fine grid ``(FINE R, FINE C)`` as planes ``(FINE, FINE, R, C)``: ``[i, j]`` has rows ``FINE r + i``."""
    rows, columns = (size // FINE for size in fine.shape)
    return np.ascontiguousarray(fine.reshape(rows, FINE, columns, FINE).transpose(1, 3, 0, 2))


@part
def _shifted(planes, down, across, grey):
    """Resample to ``grey``, whose pixel ``(0, 0)`` is at row ``down``, column ``across`` of the fine grid; cubic."""
    first, before = int(np.floor(down)) - 1, int(np.floor(across)) - 1
    weights, _ = cubic_weights(down - np.floor(down))
    along, _ = cubic_weights(across - np.floor(across))
    w0, w1, w2, w3 = np.float32(weights[0]), np.float32(weights[1]), np.float32(weights[2]), np.float32(weights[3])
    rows, columns = grey.shape
    for r in range(rows):
        i = first + FINE * r
        line = grey[r]
        for b in range(4):
            j = before + b
            x0, x1 = planes[i % 2, j % 2, i // 2, j // 2 :], planes[(i + 1) % 2, j % 2, (i + 1) // 2, j // 2 :]
            x2, x3 = (
                planes[(i + 2) % 2, j % 2, (i + 2) // 2, j // 2 :],
                planes[(i + 3) % 2, j % 2, (i + 3) // 2, j // 2 :],
            )
            share = np.float32(along[b])
            if b == 0:
                for c in range(columns):
                    line[c] = share * (w0 * x0[c] + w1 * x1[c] + w2 * x2[c] + w3 * x3[c])
            else:
                for c in range(columns):
                    line[c] += share * (w0 * x0[c] + w1 * x1[c] + w2 * x2[c] + w3 * x3[c])


@part
def _census(grey, words, seen):
    """Census words of the inner pixels of ``grey``, and whether their windows have no NaN (uint8)."""
    rows, columns = words.shape
    for r in range(rows):
        word, usable, centre = words[r], seen[r], grey[r + RADIUS, RADIUS : RADIUS + columns]
        for c in range(columns):
            word[c] = 0
            usable[c] = np.uint8(centre[c] == centre[c])
        for i in range(2 * RADIUS + 1):
            for j in range(2 * RADIUS + 1):
                if i != RADIUS or j != RADIUS:
                    other = grey[r + i, j : j + columns]
                    for c in range(columns):
                        word[c] = (word[c] << np.uint32(1)) | np.uint32(other[c] < centre[c])
            # gaps are wider than a cell: three columns of a window find them
            for j in (0, RADIUS, 2 * RADIUS):
                other = grey[r + i, j : j + columns]
                for c in range(columns):
                    usable[c] &= np.uint8(other[c] == other[c])


@inlined
def _bits(x):
    """Return the number of set bits of a uint32."""
    x = x - ((x >> np.uint32(1)) & np.uint32(0x55555555))
    x = (x & np.uint32(0x33333333)) + ((x >> np.uint32(2)) & np.uint32(0x33333333))
    x = (x + (x >> np.uint32(4))) & np.uint32(0x0F0F0F0F)
    x = x + (x >> np.uint32(8))
    return (x + (x >> np.uint32(16))) & np.uint32(63)


@part
def _pair_costs(words, seen, pairs, share, steps, lowest, costs):
    """Write the mean of the lowest ``share`` of the distances of the pairs that see a cell, in ``steps`` of a bit.

    lowest: ``(most + 1, columns)`` uint8: scratch for the ``most`` lowest distances of a row, and the next one.
    """
    rows, columns = costs.shape
    most = lowest.shape[0] - 1
    found, new = np.empty(columns, np.uint16), lowest[most]
    for r in range(rows):
        found[:] = 0
        lowest[:most] = _UNSEEN
        for p in range(pairs.shape[0]):
            a, b = pairs[p]
            one, other, sees, sees_too = words[a, r], words[b, r], seen[a, r], seen[b, r]
            for c in range(columns):
                both = sees[c] & sees_too[c]
                found[c] += both
                new[c] = np.uint8(_bits(one[c] ^ other[c])) | (both - np.uint8(1))
            for q in range(min(p + 1, most)):  # each of the lowest keeps the smaller one, and hands on the larger
                kept = lowest[q]
                for c in range(columns):
                    low, high = min(kept[c], new[c]), max(kept[c], new[c])
                    kept[c], new[c] = low, high
        for c in range(columns):
            count = int(np.ceil(share * found[c]))
            total = 0
            for q in range(count):
                total += lowest[q, c]
            costs[r, c] = np.uint8(steps * total / count + 0.5) if count else np.uint8(steps * BITS)


@cached
def sweep(planes, starts, sizes, moves, pairs, share, steps, costs, seen):
    """Costs of some cells at some heights: Census (Zabih and Woodfill 1994) of views resampled to the ground.

    planes: float32, of all images one after the other, each ``(FINE, FINE, *sizes[n])``, see `planes_of`, from
        ``starts[n]``; NaN where not usable.
    moves: ``(heights, images, 2)``: row and column on the fine grid of the first pixel of the window of the first cell.
    pairs: ``(pairs, 2)`` int64: images to compare.
    share: of the distances of the pairs that see a cell, the lowest of which are averaged (0 to 1].
    steps: costs for each bit; those that no pair sees get the largest, ``steps * BITS``.
    costs: ``(rows, columns, heights)`` uint8: filled.
    seen: ``(images, rows, columns)`` uint8: filled with whether an image sees a cell at the middle height.
    """
    heights, count = moves.shape[:2]
    rows, columns = costs.shape[:2]
    grey = np.empty((rows + 2 * RADIUS, columns + 2 * RADIUS), np.float32)
    words, usable = np.empty((count, rows, columns), np.uint32), np.empty((count, rows, columns), np.uint8)
    lowest = np.empty((int(np.ceil(share * pairs.shape[0])) + 1, columns), np.uint8)
    level = np.empty((rows, columns), np.uint8)
    for h in range(heights):
        for n in range(count):
            height, width = sizes[n]
            here = planes[starts[n] : starts[n] + FINE * FINE * height * width]
            _shifted(here.reshape((FINE, FINE, height, width)), moves[h, n, 0], moves[h, n, 1], grey)
            _census(grey, words[n], usable[n])
        _pair_costs(words, usable, pairs, share, steps, lowest, level)
        for r in range(rows):
            for c in range(columns):
                costs[r, c, h] = level[r, c]
        if h == heights // 2:
            for n in range(count):  # an assignment between arrays would take five seconds longer to compile
                for r in range(rows):
                    for c in range(columns):
                        seen[n, r, c] = usable[n, r, c]
