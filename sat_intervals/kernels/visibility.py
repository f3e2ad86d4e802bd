"""Intersect lines of sight with a surface of heights. Of several intersections, the one that the sensor sees is taken.

Letters: r row, c column of the image; i, j lattice node along rows and columns, k along disparities; y, x position in
cells of the surface, z height; t place between two nodes k and k + 1.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached, inlined

BLOCK = 16
"""Cells of a side of the blocks of `tops`."""
# Cells between samples of a line of sight: no cell of the surface is stepped over, except at a corner.
_STEP = 0.5
# Metres, and halvings of an interval, at which the search of a crossing ends.
_NEAR, _MOST = 1e-5, 40


@inlined
def _height(surface, x, y):
    """Interpolate bilinearly; NaN outside, and if one of the four heights is unknown."""
    rows, columns = surface.shape
    if not (0 <= x <= columns - 1 and 0 <= y <= rows - 1):
        return np.nan
    i, j = min(int(y), rows - 2), min(int(x), columns - 2)
    y -= i
    x -= j
    upper = (1 - x) * surface[i, j] + x * surface[i, j + 1]
    lower = (1 - x) * surface[i + 1, j] + x * surface[i + 1, j + 1]
    return (1 - y) * upper + y * lower


@inlined
def _is_in_wall(surface, x, y, z, steepest):
    """Return whether a position is below the highest of the four heights around, and these differ by too much."""
    rows, columns = surface.shape
    if not (0 <= x <= columns - 1 and 0 <= y <= rows - 1):
        return False
    i, j = min(int(y), rows - 2), min(int(x), columns - 2)
    a, b, c, d = surface[i, j], surface[i, j + 1], surface[i + 1, j], surface[i + 1, j + 1]
    highest = max(a, b, c, d)
    return z < highest and highest - min(a, b, c, d) > steepest


@cached
def tops(surface):
    """Return the largest height of each block of `BLOCK` x `BLOCK` cells and the eight around it, -inf for none."""
    rows, columns = surface.shape
    blocks = np.full(((rows - 1) // BLOCK + 3, (columns - 1) // BLOCK + 3), -np.inf, surface.dtype)
    for r in range(rows):
        for c in range(columns):
            i, j = r // BLOCK + 1, c // BLOCK + 1
            if surface[r, c] > blocks[i, j]:  # false for NaN
                blocks[i, j] = surface[r, c]
    result = np.full((blocks.shape[0] - 2, blocks.shape[1] - 2), -np.inf, surface.dtype)
    for i in range(result.shape[0]):
        for j in range(result.shape[1]):
            for n in range(9):  # the maximum of a slice would take a second longer to compile
                result[i, j] = max(result[i, j], blocks[i + n // 3, j + n % 3])
    return result


@cached
def seen_disparities(surface, top, lattice, spacing, first, shape, steepest):
    """Return the disparity at which the line of sight of each pixel meets a surface first, coming from the sensor.

    surface: ``(rows, columns)`` heights, at least 2 x 2, NaN where unknown; bilinear between cells.
    top: its `tops`.
    lattice: ``(rows, columns, disparities, 3)`` float64: x, y (cells; centres are integers) and height of the points of
        pixels at disparities, in order of falling height.
    spacing: pixels between nodes along rows and columns, and the signed step of the disparities.
    first: row and column of the first node, of the first pixel ``0, 0``, and the disparity of the first node.
    steepest: four neighbouring heights that differ by more than this are a wall, whose place is known to a cell only.
        Lines of sight that meet it, or pass between its heights, have no disparity.
    Returns ``shape`` float64, NaN where the line of sight meets nothing, a wall, or disappears under unknown heights.
    """
    rows, columns = shape
    nodes = lattice.shape[2]
    result = np.full((rows, columns), np.nan)
    line = np.empty((nodes, 3))
    highest = top.max()
    for r in range(rows):
        v = (r - first[0]) / spacing[0]
        i = min(max(int(np.floor(v)), 0), lattice.shape[0] - 2)
        v -= i
        for c in range(columns):
            u = (c - first[1]) / spacing[1]
            j = min(max(int(np.floor(u)), 0), lattice.shape[1] - 2)
            u -= j
            for k in range(nodes):
                for n in range(3):
                    near = (1 - u) * lattice[i, j, k, n] + u * lattice[i, j + 1, k, n]
                    far = (1 - u) * lattice[i + 1, j, k, n] + u * lattice[i + 1, j + 1, k, n]
                    line[k, n] = (1 - v) * near + v * far
            place = _first_crossing(surface, top, highest, line, steepest)
            result[r, c] = first[2] + place * spacing[2]
    return result


@inlined
def _first_crossing(surface, top, highest, line, steepest):
    """Return the place on a line, in nodes from its first, where it meets the surface; NaN if nowhere."""
    is_known_above = False
    gone = 0.0
    for k in range(line.shape[0] - 1):
        x, y, z = line[k, 0], line[k, 1], line[k, 2]
        dx, dy, dz = line[k + 1, 0] - x, line[k + 1, 1] - y, line[k + 1, 2] - z
        if not z + dz <= highest:  # nothing is as high; NaN: models have no point there
            is_known_above = False
            continue
        length = np.hypot(dx, dy)
        pieces = max(1, int(np.ceil(length / (BLOCK // 2))))
        for piece in range(pieces):
            begin, end = piece / pieces, (piece + 1) / pieces
            middle = 0.5 * (begin + end)
            i = min(max(int(np.floor(y + middle * dy)) // BLOCK, 0), top.shape[0] - 1)
            j = min(max(int(np.floor(x + middle * dx)) // BLOCK, 0), top.shape[1] - 1)
            if z + end * dz > top[i, j]:
                is_known_above = False
                continue
            steps = max(1, int(np.ceil(length / pieces / _STEP)))
            if not is_known_above:
                gone = begin
                is_known_above = z + begin * dz - _height(surface, x + begin * dx, y + begin * dy) >= 0
            for step in range(1, steps + 1):
                t = begin + (end - begin) * step / steps
                over = z + t * dz - _height(surface, x + t * dx, y + t * dy)
                if _is_in_wall(surface, x + t * dx, y + t * dy, z + t * dz, steepest):
                    return np.nan
                if over <= 0:
                    if not is_known_above:  # it went below where heights are unknown
                        return np.nan
                    t = _crossing(surface, line[k], line[k + 1], gone, t)
                    if _is_in_wall(surface, x + t * dx, y + t * dy, z + t * dz - _NEAR, steepest):
                        return np.nan
                    return k + t
                is_known_above = over > 0
                gone = t
        gone = 0.0
    return np.nan


@inlined
def _crossing(surface, first, last, above, below):
    """Return the place between two points, from 0 to 1, where their line crosses the surface.

    It is above the surface at place ``above``, and not at ``below``.
    """
    for _ in range(_MOST):
        t = 0.5 * (above + below)
        x, y, z = (1 - t) * first + t * last
        over = z - _height(surface, x, y)
        if over > 0:
            above = t
        else:
            below = t
        if abs(over) < _NEAR:
            break
    return t
