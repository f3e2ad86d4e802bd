"""SGM penalties that follow image gradients along each path.

MC-CNN (Mei et al. 2011; Zbontar and LeCun 2016): P1 and P2 of a candidate decrease where the left image, the right
image, or both have an edge between the path's two pixels. Banz et al. 2012: P2 of a pixel decreases as the gradient of
the left image increases.

Letters: r row, c column, k disparity index, x = c + k, i path of a sweep: 0 along the row, 1 along the falling
diagonal, 2 along the rising one, 3 along the column.
"""

from typing import NamedTuple

import numpy as np

from sat_intervals.kernels.compiled import inlined, part
from sat_intervals.kernels.vector import load, mix, splat

EDGES, NEGATIVE, INVERSE = range(3)


class Rule(NamedTuple):
    """How penalties follow gradients; penalties are integers in units of the matching cost.

    kind: EDGES, NEGATIVE or INVERSE.
    p1, p2: ``(4, 3)`` uint16, by path and by the number of images with an edge. NEGATIVE and INVERSE use only the first
        column, p2 as the minimum of P2.
    left_edge, right_edge: EDGES: gradients above these are edges, in grey values.
    facing: EDGES: whether the right gradient is taken at the facing pixel, or at the left pixel's own column.
    own_column: ``x - c`` of the right pixel in the left pixel's own column.
    alpha, beta, gamma: P2 is ``gamma - alpha * gradient``, or ``gamma + alpha / (gradient + beta)``, and at least p2.
    """

    kind: int
    p1: np.ndarray
    p2: np.ndarray
    left_edge: float = 0.0
    right_edge: float = 0.0
    facing: bool = True
    own_column: int = 0
    alpha: float = 0.0
    beta: float = 1.0
    gamma: float = 0.0


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
    if gradients is None:
        return Penalties(p1, p2, None)
    first, second = np.zeros((2, 4, columns), np.uint16), np.zeros((2, 4, columns), np.uint16)
    return Penalties(p1, p2, RowPenalties(first, second, np.zeros((4, columns + size), np.uint16)))


@part
def _step_back(i, down):
    """Offset to the previous pixel of a path: rows and columns to add."""
    row = 0 if i == 0 else 1
    column = (1, 1, -1, 0)[i]
    return (-row, -column) if down else (row, column)


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
def _fill_edges(gradients, r, down, row_penalties):
    """Fill the penalties of a row from the edges of both images."""
    (left, right, rule), (p1, p2, edges) = gradients, row_penalties
    left_gradient, right_gradient = np.empty(left.shape[1], np.float32), np.empty(right.shape[1], np.float32)
    for i in range(4):
        row, column = _step_back(i, down)
        _differences(left, r, row, column, left_gradient)
        _differences(right, r, row, column, right_gradient)
        if rule.facing:
            for x in range(right_gradient.size):
                edges[i, x] = 65535 if right_gradient[x] > rule.right_edge else 0
        for c in range(left_gradient.size):
            level = int(left_gradient[c] > rule.left_edge)
            if not rule.facing:
                level += int(right_gradient[c + rule.own_column] > rule.right_edge)
            other = level + rule.facing
            p1[0, i, c], p1[1, i, c] = rule.p1[i, level], rule.p1[i, other]
            p2[0, i, c], p2[1, i, c] = rule.p2[i, level], rule.p2[i, other]


@part
def _fill_banz(gradients, r, down, row_penalties):
    """Fill the penalties of a row from the gradient of the left image."""
    (left, _, rule), (p1, p2, _) = gradients, row_penalties
    gradient = np.empty(left.shape[1], np.float32)
    for i in range(4):
        row, column = _step_back(i, down)
        _differences(left, r, row, column, gradient)
        for c in range(gradient.size):
            if rule.kind == NEGATIVE:
                penalty = rule.gamma - rule.alpha * gradient[c]
            else:
                penalty = rule.gamma + rule.alpha / (gradient[c] + rule.beta)
            p1[:, i, c] = rule.p1[i, 0]
            p2[:, i, c] = max(np.int64(rule.p2[i, 0]), np.int64(np.floor(penalty + 0.5)))


@part
def fill_row(gradients, r, down, row):
    """Fill the penalties of a row for a sweep down or up; do nothing without gradients."""
    if gradients is not None:
        if gradients.rule.kind == EDGES:
            _fill_edges(gradients, r, down, row)
        else:
            _fill_banz(gradients, r, down, row)


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
