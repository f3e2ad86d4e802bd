"""Connected components of a disparity map, whose sizes distinguish surfaces from stray matches.

Letters: i, j row and column of the pixel that a component grows from; y, x those of its neighbour.
"""

import numpy as np

from sat_intervals.kernels.compiled import cached


@cached
def component_sizes(disparity, known):
    """Size of the component of each pixel: neighbours along rows and columns that differ by at most one pixel.

    disparity, known: ``(rows, columns)`` float32, and bool: pixels with a disparity.
    Returns ``(rows, columns)`` int32, 0 where nothing is known.
    """
    rows, columns = disparity.shape
    sizes = np.zeros((rows, columns), np.int32)
    members = np.empty(rows * columns, np.int64)  # of the current component; those before `grown` have been looked at
    for r in range(rows):
        for c in range(columns):
            if not known[r, c] or sizes[r, c]:
                continue
            sizes[r, c] = 1
            members[0], count, grown = r * columns + c, 1, 0
            while grown < count:
                i, j = members[grown] // columns, members[grown] % columns
                grown += 1
                for n in range(4):
                    y, x = i + (n == 0) - (n == 1), j + (n == 2) - (n == 3)
                    if not (0 <= y < rows and 0 <= x < columns) or not known[y, x] or sizes[y, x]:
                        continue
                    if abs(disparity[y, x] - disparity[i, j]) <= 1:
                        sizes[y, x] = 1
                        members[count] = y * columns + x
                        count += 1
            for n in range(count):
                sizes[members[n] // columns, members[n] % columns] = count
    return sizes
