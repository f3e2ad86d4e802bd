"""SGM penalties that follow image gradients along each path (MC-CNN: Mei et al. 2011; Zbontar and LeCun 2016).

P1 and P2 of a candidate decrease where the left image, the right image, or both have an edge between the path's two
pixels.

Letters: x = c + k, i path of a sweep: 0 along the row, 1 along the falling diagonal, 2 along the rising one, 3 along
the column.
"""

from typing import NamedTuple

import numpy as np

from sat_intervals.kernels.compiled import inlined, part
from sat_intervals.kernels.vector import load, mix, splat


class Rule(NamedTuple):
    """Penalties at edges, integers in units of the matching cost.

    p1, p2: ``(4, 3)`` uint16, by path and by the number of images with an edge.
    left_edge, right_edge: gradients above these are edges, in grey values.
    """

    p1: np.ndarray
    p2: np.ndarray
    left_edge: float
    right_edge: float


class Gradients(NamedTuple):
    """A rule and the images of a patch that it applies to.

    left: ``(rows, columns)`` float32 grey values.
    right: ``(rows, columns + count - 1)`` float32: ``right[r, c + k]`` faces ``left[r, c]``.
    """

    left: np.ndarray
    right: np.ndarray
    rule: Rule


class RowPenalties(NamedTuple):
    """Gradient-dependent penalties of a row of pixels.

    p1, p2: ``(2, 4, columns)`` uint16, by path: without and with an edge in the right image.
    edges: ``(4, columns + size)`` uint16, by path: 65535 where the right pixel ``x`` has an edge.
    """

    p1: np.ndarray
    p2: np.ndarray
    edges: np.ndarray


class Penalties(NamedTuple):
    """P1 and P2: those of ``row``, or constants where it is None. Kernels are compiled for either form."""

    p1: int
    p2: int
    row: RowPenalties | None


def make_penalties(gradients: Gradients | None, p1: int, p2: int, columns: int, size: int) -> Penalties:
    """Allocate penalties: constants without gradients, else buffers of a row for `fill_row`."""
    tables = (np.zeros(shape, np.uint16) for shape in ((2, 4, columns), (2, 4, columns), (4, columns + size)))
    return Penalties(p1, p2, None if gradients is None else RowPenalties(*tables))


@part
def _differences(image, r, row, column, differences):
    """Absolute differences of a row to the pixels at an offset; 0 where these are outside: paths start there."""
    columns = image.shape[1]
    differences[:] = 0
    if 0 <= r + row < image.shape[0]:
        here, there = image[r], image[r + row]
        for c in range(max(0, -column), columns - max(0, column)):
            differences[c] = abs(here[c] - there[c + column])


@part
def fill_row(gradients, r, down, row):
    """Fill the penalties of a row for a sweep down or up; do nothing without gradients."""
    if gradients is None:
        return
    (left, right, rule), (p1, p2, edges) = gradients, row
    left_gradient, right_gradient = np.empty(left.shape[1], np.float32), np.empty(right.shape[1], np.float32)
    for i in range(4):
        row_step, column_step = (0, 1, 1, 1)[i], (1, 1, -1, 0)[i]  # to the previous pixel of the path
        if down:
            row_step, column_step = -row_step, -column_step
        _differences(left, r, row_step, column_step, left_gradient)
        _differences(right, r, row_step, column_step, right_gradient)
        for x in range(right_gradient.size):
            edges[i, x] = 65535 if right_gradient[x] > rule.right_edge else 0
        for c in range(left_gradient.size):
            level = int(left_gradient[c] > rule.left_edge)
            p1[0, i, c], p1[1, i, c] = rule.p1[i, level], rule.p1[i, level + 1]
            p2[0, i, c], p2[1, i, c] = rule.p2[i, level], rule.p2[i, level + 1]


@inlined
def penalties_of(p1, p2, row, i, c, k):
    """P1 and P2 of the candidates ``k .. k + 31`` of a pixel on a path."""
    if row is None:
        return splat(np.uint16(p1)), splat(np.uint16(p2))
    edge = load(row.edges, i * row.edges.shape[1] + c + k)
    return (
        mix(edge, splat(row.p1[0, i, c]), splat(row.p1[1, i, c])),
        mix(edge, splat(row.p2[0, i, c]), splat(row.p2[1, i, c])),
    )
