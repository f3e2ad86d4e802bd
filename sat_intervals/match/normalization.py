"""Mean and standard deviation of a whole image, merged from blocks (Chan, Golub and LeVeque 1983).

The input of a network must not depend on the tile: statistics of a tile, no data included, change 1 to 21 % of the
winners of Pandora.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.tiling import Grid, Window

# Side of the blocks of an image in pixels. It fixes the order of sums, and so the last bit.
BLOCK = 2048


class Moments(NamedTuple):
    """Number of pixels, their mean, and the sum of squared differences from it."""

    number: int
    mean: float
    squares: float


class ImageStatistics(NamedTuple):
    """Mean and standard deviation of an image's usable pixels; 0 and 1 if there are none."""

    mean: float
    deviation: float


class PairStatistics(NamedTuple):
    """Statistics of both images."""

    left: ImageStatistics
    right: ImageStatistics

    @classmethod
    def of_report(cls, report: dict[str, Any]) -> "PairStatistics":
        """Read the mapping that `report` makes."""
        return cls(ImageStatistics(**report["left"]), ImageStatistics(**report["right"]))

    def report(self) -> dict[str, Any]:
        """Make the mapping that manifests and run.json hold."""
        return {side: getattr(self, side)._asdict() for side in self._fields}


def moments(pixels: np.ndarray, state: np.ndarray) -> Moments:
    """Moments of the usable pixels of a block: those with state 0."""
    values = pixels[state == 0].astype(np.float64)
    if not values.size:
        return Moments(0, 0.0, 0.0)
    mean = float(values.mean())
    return Moments(values.size, mean, float(np.square(values - mean).sum()))


def blocks(height: int, width: int) -> list[Window]:
    """Blocks of an image, in order."""
    return [tile.core for tile in Grid(Window(0, 0, height, width), BLOCK)]


def statistics_of(blocks: Iterable[Moments]) -> ImageStatistics:
    """Statistics of an image from the moments of its blocks, in order."""
    number, mean, squares = 0, 0.0, 0.0
    for block in blocks:
        total = number + block.number
        if block.number:
            difference = block.mean - mean
            squares += block.squares + difference**2 * number * block.number / total
            mean += difference * block.number / total
        number = total
    deviation = math.sqrt(squares / number) if number else 0.0
    return ImageStatistics(mean, deviation or 1.0)
