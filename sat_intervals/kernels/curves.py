"""Winners of right pixels from a whole volume, as cross-checking needs them of another matcher's volume.

Letters: r row, c column, k disparity index (disparity = minimum + k).
"""

import numpy as np

from sat_intervals.products import IMPOSSIBLE_COST, NO_DISPARITY


def read_right_winners(volume: np.ndarray, minimum: int) -> np.ndarray:
    """The right view's winners along the diagonals of the left volume; the largest disparity at ties.

    Returns ``(rows, columns + count - 1)`` int16 as `cross_check` takes it.
    """
    rows, columns, count = volume.shape
    width = columns + count - 1
    winner = np.full((rows, width), NO_DISPARITY, np.int16)
    for r in range(rows):
        # Each line is one longer than the right image: read as lines of its width, each begins one column later.
        sheared = np.full((count, width + 1), IMPOSSIBLE_COST, np.uint16)
        sheared[:, :columns] = volume[r].T
        facing = sheared.ravel()[: count * width].reshape(count, width)[::-1]
        found = (facing != IMPOSSIBLE_COST).any(axis=0)
        winner[r, found] = minimum + count - 1 - facing.argmin(axis=0)[found]
    return winner
