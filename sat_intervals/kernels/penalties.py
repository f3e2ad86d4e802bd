"""Penalties of SGM that follow the gradients of the images along each path.

MC-CNN (Mei et al. 2011, Zbontar and LeCun 2016): P1 and P2 of a candidate fall where the left image, the right image at
the pixel it faces, or both have an edge between the path's two pixels. Banz et al. 2012: P2 of a pixel falls with the
gradient of the left image.

Letters: r row, c column, k disparity index, x = c + k, i path of a sweep: 0 along the row, 1 along the falling
diagonal, 2 along the rising one, 3 along the column.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, types
from numba.extending import overload

from sat_intervals.kernels.vector import load, mix, splat

EDGES, NEGATIVE, INVERSE = range(3)


class Rule(NamedTuple):
    """How penalties follow gradients; integers in units of the cost.

    Attributes
    ----------
    kind
        EDGES, NEGATIVE or INVERSE.
    p1, p2
        ``(4, 3)`` uint16, by path and by how many of the two images have an edge; the first columns are all that
        NEGATIVE and INVERSE know, p2 as the least.
    left_edge, right_edge
        EDGES: gradients above are edges, in the images' grey values.
    facing
        EDGES: whether the right image is looked at where a candidate faces it, or at the left pixel's own column.
    own_column
        Index x of the right pixel in the left pixel's own column, less c.
    alpha, beta, gamma
        P2 is ``gamma - alpha * gradient``, or ``gamma + alpha / (gradient + beta)``, and at least p2.
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
    """A rule and the images of a patch that it looks at.

    Attributes
    ----------
    left
        ``(rows, columns)`` float32 grey values.
    right
        ``(rows, columns + count - 1)`` float32: ``right[r, c + k]`` faces ``left[r, c]``.
    rule
        What penalties they make.
    """

    left: np.ndarray
    right: np.ndarray
    rule: Rule


@njit(nogil=True)
def _step_back(i, down):
    """Where the previous pixel of a path lies: rows and columns to add."""
    row = 0 if i == 0 else 1
    column = (1, 1, -1, 0)[i]
    return (-row, -column) if down else (row, column)


@njit(nogil=True)
def _differences(image, r, row, column, differences):
    """Gradients of a row of pixels towards others beside them, 0 where those lie outside: there paths start."""
    columns = image.shape[1]
    differences[:] = 0
    if 0 <= r + row < image.shape[0]:
        here, there = image[r], image[r + row]
        for c in range(max(0, -column), columns - max(0, column)):
            differences[c] = abs(here[c] - there[c + column])


@njit(nogil=True)
def _fill_edges(gradients, r, down, p1, p2, edges):
    """Penalties of a row by the edges of both images."""
    left, right, rule = gradients
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


@njit(nogil=True)
def _fill_banz(gradients, r, down, p1, p2):
    """Penalties of a row by the gradient of the left image."""
    left, _, rule = gradients
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


@njit(nogil=True)
def _fill(gradients, r, down, p1, p2, edges):
    if gradients.rule.kind == EDGES:
        _fill_edges(gradients, r, down, p1, p2, edges)
    else:
        _fill_banz(gradients, r, down, p1, p2)


def row_penalties(gradients, p1, p2, columns, size):
    """Make what `fill_row` fills: p1, p2 and the edges of the right image; p1 and p2 themselves without gradients."""
    raise NotImplementedError


@overload(row_penalties, jit_options={"nogil": True})
def _row_penalties(gradients, p1, p2, columns, size):
    def constant(gradients, p1, p2, columns, size):
        return p1, p2, 0

    def varying(gradients, p1, p2, columns, size):
        first, second = np.zeros((2, 4, columns), np.uint16), np.zeros((2, 4, columns), np.uint16)
        return first, second, np.zeros((4, columns + size), np.uint16)

    return constant if gradients is types.none else varying


def fill_row(gradients, r, down, p1, p2, edges):
    """Set the penalties of a row, for a sweep down or up: ``(2, 4, columns)`` without and with an edge on the right."""
    raise NotImplementedError


@overload(fill_row, jit_options={"nogil": True})
def _fill_row(gradients, r, down, p1, p2, edges):
    def constant(gradients, r, down, p1, p2, edges):
        pass

    def varying(gradients, r, down, p1, p2, edges):
        _fill(gradients, r, down, p1, p2, edges)

    return constant if gradients is types.none else varying


def penalty(values, edges, i, c, k):
    """Penalties of the candidates ``k .. k + 31`` of a pixel on a path."""
    raise NotImplementedError


@overload(penalty, jit_options={"nogil": True, "forceinline": True})
def _penalty(values, edges, i, c, k):
    def constant(values, edges, i, c, k):
        return splat(np.uint16(values))

    def varying(values, edges, i, c, k):
        edge = load(edges, i * edges.shape[1] + c + k)
        return mix(edge, splat(values[0, i, c]), splat(values[1, i, c]))

    return constant if isinstance(values, types.Integer) else varying
