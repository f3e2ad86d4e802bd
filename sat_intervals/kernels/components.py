"""Connected components: surfaces and stray matches of a disparity map, areas of change of a surface.

Letters: i, j row and column of the pixel that a component grows from; y, x those of its neighbour.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached


@cached
def components(values, known):
    """Number the components: neighbours along rows and columns whose values differ by at most one.

    values, known: ``(rows, columns)`` signed numbers, and bool: pixels with a value.
    Returns ``(rows, columns)`` int32, from 1 in the order of their first pixels, 0 where nothing is known.
    """
    rows, columns = known.shape
    labels, count = np.zeros((rows, columns), np.int32), 0
    waiting = np.empty(rows * columns, np.int64)  # pixels of the current component whose neighbours were not looked at
    for r in range(rows):
        for c in range(columns):
            if not known[r, c] or labels[r, c]:
                continue
            count += 1
            labels[r, c], waiting[0], left = count, r * columns + c, 1
            while left:
                left -= 1
                i, j = waiting[left] // columns, waiting[left] % columns
                for n in range(4):
                    y, x = i + (n == 0) - (n == 1), j + (n == 2) - (n == 3)
                    if not (0 <= y < rows and 0 <= x < columns) or not known[y, x] or labels[y, x]:
                        continue
                    if abs(values[y, x] - values[i, j]) <= 1:
                        labels[y, x], waiting[left] = count, y * columns + x
                        left += 1
    return labels


def component_sizes(disparity: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the size of the component of each pixel of a disparity map, 0 where nothing is known."""
    labels = components(disparity, known)
    sizes = np.bincount(labels.ravel()).astype(np.int32)
    sizes[0] = 0
    return np.asarray(sizes[labels])
