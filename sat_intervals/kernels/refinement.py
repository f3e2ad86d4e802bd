"""Sub-pixel refinement by least squares on grey values, and local planes (METHOD.md, section 19).

Letters: i row of a window, j its column; b left value, v right value, g its derivative along the row,
x disparity, w weight; two letters are a product's sum over a window. A row is worked on in pieces of _PIECE columns,
line by line of their windows, so that the loops over columns vectorise.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached, inlined, part
from sat_intervals.kernels.row_offsets import cubic_weights

# Columns that the right image needs on either side of those that the search range faces.
MARGIN = 4
# Pixels from the middle of a window to its sides, of fits and of planes.
FIT, PLANE = 2, 4
# Deviation in pixels of a disparity before its fit, which holds an uncertain shift back.
_BEFORE = 0.25
# Deviation in pixels of a disparity without a fit, for planes; what is added to that of a fit.
_NONE, _LEAST = np.float32(1.0), np.float32(0.1)
# Largest difference of disparities on one surface, in pixels: for a fit, and for a plane.
_SURFACE, _FLAT_SURFACE = np.float32(1.0), np.float32(0.75)
# Fewest pixels of a fit, smallest gain that counts as likeness, largest move in pixels.
_FEWEST, _LIKENESS, _MOVE = 6, 0.1, 1.0
# Deviation in pixels that stands for a pixel without a fit; what is added to a deviation, to a side of the cut, and to
# relief; range of disparities around from which on there is an edge, in pixels.
_NO_FIT, _HALF, _EDGE = np.float32(1.0), np.float32(0.5), np.float32(2.0)
# Least share of the variance of slopes that is not that of values; what is added to the squares of a plane's slopes.
_TEXTURE, _FLAT = 1e-5, 1e-3
_PIECE = 256
# Of the pixels around a piece: lines, pixels of a line, pixels, and place of the first middle.
_LINES, _WIDE = 2 * FIT + 1, _PIECE + 2 * FIT
_LAYER, _MIDDLE = _LINES * _WIDE, FIT * _WIDE + FIT
_PLANE_LINES, _PLANE_WIDE = 2 * PLANE + 1, _PIECE + 2 * PLANE
_PLANE_LAYER, _PLANE_MIDDLE = _PLANE_LINES * _PLANE_WIDE, PLANE * _PLANE_WIDE + PLANE


@cached
def facing_values(right, disparity, minimum):
    """Values of the right image that disparities point at, and their derivatives along the row.

    Both are cubic between pixels. Derivatives of pixels are central differences of fourth order: the derivative of the
    cubic itself is too small at whole pixels, and too large between them.

    right: ``(rows, columns + count - 1 + 2 MARGIN)`` float32, NaN for no data; the pixel at ``c + k + MARGIN`` faces
        ``c`` at the disparity ``minimum + k``.
    disparity: ``(rows, columns)`` float32, NaN for none.
    Returns two such arrays, NaN where one of the 4 or 8 pixels that they are made of has no data.
    """
    rows, columns = disparity.shape
    value = np.full((rows, columns), np.float32(np.nan))
    slope, along = value.copy(), np.full(right.shape[1], np.nan)
    for r in range(rows):
        for x in range(2, along.size - 2):
            near, far = right[r, x + 1] - right[r, x - 1], right[r, x + 2] - right[r, x - 2]
            along[x] = (8 * near - far) / 12
        for c in range(columns):
            if np.isnan(disparity[r, c]):
                continue
            place = c + MARGIN + np.float64(disparity[r, c]) - minimum
            before = int(np.floor(place))
            weights, _ = cubic_weights(place - before)
            total = change = 0.0
            for n in range(4):
                total += weights[n] * right[r, before - 1 + n]
                change += weights[n] * along[before - 1 + n]
            value[r, c], slope[r, c] = total, change
    return value, slope


@inlined
def _load(layer, near, r, first, radius):
    """Copy the rows around row ``r``, from column ``first - radius`` on; NaN outside."""
    rows, columns = layer.shape
    wide = _PIECE + 2 * radius
    for i in range(2 * radius + 1):
        row = r + i - radius
        for c in range(wide):
            column = first + c - radius
            inside = 0 <= row < rows and 0 <= column < columns
            near[i * wide + c] = layer[row, column] if inside else np.float32(np.nan)


@part
def _fit_sums(near, sums):
    """Sums over the windows of a piece, from the middle's values: count, v, g, b, vv, gg, bb, vg, vb, gb."""
    zero, one = np.float32(0), np.float32(1)
    sums[:] = 0
    for i in range(_LINES):
        for c in range(_PIECE):
            n = tv = tg = tb = vv = gg = bb = vg = vb = gb = zero
            for j in range(_LINES):
                here = i * _WIDE + j + c
                b, v = near[here] - near[_MIDDLE + c], near[_LAYER + here] - near[_LAYER + _MIDDLE + c]
                g, x = near[2 * _LAYER + here], near[3 * _LAYER + here] - near[3 * _LAYER + _MIDDLE + c]
                told = abs(x) <= _SURFACE and abs(b) < np.inf and abs(v) < np.inf and abs(g) < np.inf
                b, v, g = b if told else zero, v if told else zero, g if told else zero
                n += one if told else zero
                tv, tg, tb = tv + v, tg + g, tb + b
                vv, gg, bb = vv + v * v, gg + g * g, bb + b * b
                vg, vb, gb = vg + v * g, vb + v * b, gb + g * b
            sums[c] += n
            sums[_PIECE + c] += tv
            sums[2 * _PIECE + c] += tg
            sums[3 * _PIECE + c] += tb
            sums[4 * _PIECE + c] += vv
            sums[5 * _PIECE + c] += gg
            sums[6 * _PIECE + c] += bb
            sums[7 * _PIECE + c] += vg
            sums[8 * _PIECE + c] += vb
            sums[9 * _PIECE + c] += gb


@inlined
def _fit(sums, c):
    """Shift by a fit and the standard deviation of the fit, in pixels; NaN for none, or a large shift."""
    nothing = np.nan, np.nan
    n, v, g, b = (
        np.float64(sums[c]), np.float64(sums[_PIECE + c]), np.float64(sums[2 * _PIECE + c]),
        np.float64(sums[3 * _PIECE + c]),
    )  # fmt: skip
    if n < _FEWEST:
        return nothing
    vv, gg, bb = (
        sums[4 * _PIECE + c] - v * v / n, sums[5 * _PIECE + c] - g * g / n, sums[6 * _PIECE + c] - b * b / n
    )  # fmt: skip
    vg, vb, gb = (
        sums[7 * _PIECE + c] - v * g / n, sums[8 * _PIECE + c] - v * b / n, sums[9 * _PIECE + c] - g * b / n
    )  # fmt: skip
    determinant = vv * gg - vg * vg
    if not (vv > 0 and determinant > _TEXTURE * vv * gg):
        return nothing
    gain, moved = (vb * gg - gb * vg) / determinant, (gb * vv - vb * vg) / determinant
    if gain <= _LIKENESS or abs(moved) > _MOVE * gain:
        return nothing
    variance = max(bb - gain * vb - moved * gb, 0.0) / (n - 3) * vv / determinant / gain**2
    return moved / gain * (_BEFORE**2 / (_BEFORE**2 + variance)), np.sqrt(variance)


@cached
def least_squares(left, value, slope, disparity):
    """Shifts of disparities that make right values most like left ones in a window, and their standard deviations.

    ``left = gain (value + slope shift) + constant`` on the pixels of the middle's surface, each at its own disparity:
    one Gauss-Newton step of least-squares matching (Gruen 1985). The shift is that times the share of _BEFORE^2 in
    _BEFORE^2 + deviation^2.

    left, value, slope, disparity: ``(rows, columns)`` float32, NaN for none, see `facing_values`.
    Returns ``(shift, deviation)``, float32 pixels of the same shape, NaN for none.
    """
    rows, columns = left.shape
    shift = np.full((rows, columns), np.float32(np.nan))
    deviation = shift.copy()
    near, sums = np.empty(4 * _LAYER, np.float32), np.empty(10 * _PIECE, np.float32)
    for r in range(rows):
        for first in range(0, columns, _PIECE):
            _load(left, near, r, first, FIT)
            _load(value, near[_LAYER:], r, first, FIT)
            _load(slope, near[2 * _LAYER :], r, first, FIT)
            _load(disparity, near[3 * _LAYER :], r, first, FIT)
            _fit_sums(near, sums)
            for c in range(min(_PIECE, columns - first)):
                shift[r, first + c], deviation[r, first + c] = _fit(sums, c)
    return shift, deviation


@part
def _plane_sums(near, sums):
    """Sums over the windows of a piece, x from the middle's: w, wi, wj, wii, wij, wjj, wx, wxi, wxj."""
    zero = np.float32(0)
    sums[:] = 0
    for i in range(_PLANE_LINES):
        down = np.float32(i - PLANE)
        for c in range(_PIECE):
            tw = wj = wjj = wx = wxj = zero
            for j in range(_PLANE_LINES):
                here, across = i * _PLANE_WIDE + j + c, np.float32(j - PLANE)
                x = near[here] - near[_PLANE_MIDDLE + c]
                told = abs(x) <= _FLAT_SURFACE
                w, x = near[_PLANE_LAYER + here] if told else zero, x if told else zero
                tw, wj, wjj = tw + w, wj + w * across, wjj + w * across * across
                wx, wxj = wx + w * x, wxj + w * x * across
            sums[c] += tw
            sums[_PIECE + c] += tw * down
            sums[2 * _PIECE + c] += wj
            sums[3 * _PIECE + c] += tw * down * down
            sums[4 * _PIECE + c] += wj * down
            sums[5 * _PIECE + c] += wjj
            sums[6 * _PIECE + c] += wx
            sums[7 * _PIECE + c] += wx * down
            sums[8 * _PIECE + c] += wxj


@inlined
def _at_middle(sums, c):
    """Value of a plane at the middle of its window, from the middle's own."""
    w, wi, wj = np.float64(sums[c]), np.float64(sums[_PIECE + c]), np.float64(sums[2 * _PIECE + c])
    wii, wij = sums[3 * _PIECE + c] + _FLAT * w, np.float64(sums[4 * _PIECE + c])
    wjj = sums[5 * _PIECE + c] + _FLAT * w
    wx, wxi, wxj = sums[6 * _PIECE + c], sums[7 * _PIECE + c], sums[8 * _PIECE + c]
    of_w, of_i, of_j = wii * wjj - wij * wij, wi * wjj - wj * wij, wj * wii - wi * wij
    return (wx * of_w - wxi * of_i - wxj * of_j) / (w * of_w - wi * of_i - wj * of_j)


@cached
def on_planes(disparity, deviation):
    """Values at the middle of planes through the disparities of a window's surface, weights 1 / (deviation^2 + .1^2).

    disparity, deviation: ``(rows, columns)`` float32 pixels, NaN for none; without a deviation a disparity stays.
    Returns ``(rows, columns)`` float32.
    """
    rows, columns = disparity.shape
    weight = np.empty((rows, columns), np.float32)
    for r in range(rows):
        for c in range(columns):
            d = _NONE if np.isnan(deviation[r, c]) else deviation[r, c]
            weight[r, c] = np.float32(1) / (d * d + _LEAST * _LEAST)
    result = disparity.copy()
    near, sums = np.empty(2 * _PLANE_LAYER, np.float32), np.empty(9 * _PIECE, np.float32)
    for r in range(rows):
        for first in range(0, columns, _PIECE):
            _load(disparity, near, r, first, PLANE)
            _load(weight, near[_PLANE_LAYER:], r, first, PLANE)
            _plane_sums(near, sums)
            for c in range(min(_PIECE, columns - first)):
                if not np.isnan(deviation[r, first + c]):
                    result[r, first + c] += _at_middle(sums, c)
    return result


@cached
def sides_of_bounds(fits, cuts, around):
    """Distances from a disparity to its bounds of a factor of 1, in pixels, and whether it is at an edge.

    Each is ``(.5 + deviation) (.5 + cut) sqrt(.5 + relief)``, by the side's cut and relief.

    fits: disparity and deviation, NaN for none; cuts: lower and upper bounds; around: see `surroundings`. All
    ``(rows, columns)``, float32 pixels, but the last, bool.
    Returns two such arrays of float32, and one of bool.
    """
    (disparity, deviation), (lower, upper), (lowest, highest, whole) = fits, cuts, around
    below, above = np.empty(disparity.shape, np.float32), np.empty(disparity.shape, np.float32)
    edge, zero = np.empty(disparity.shape, np.bool_), np.float32(0)
    for r in range(disparity.shape[0]):
        for c in range(disparity.shape[1]):
            d, s = disparity[r, c], deviation[r, c]
            scale = _HALF + (_NO_FIT if np.isnan(s) else s)
            cut, relief = d - lower[r, c], d - lowest[r, c]
            cut, relief = zero if cut < zero else cut, zero if relief < zero else relief
            below[r, c] = scale * (_HALF + cut) * np.sqrt(_HALF + relief)
            cut, relief = upper[r, c] - d, highest[r, c] - d
            cut, relief = zero if cut < zero else cut, zero if relief < zero else relief
            above[r, c] = scale * (_HALF + cut) * np.sqrt(_HALF + relief)
            edge[r, c] = not whole[r, c] or highest[r, c] - lowest[r, c] > _EDGE
    return below, above, edge
