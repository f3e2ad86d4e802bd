"""Matching cost sweep: many images resampled to the ground at each height, compared there (METHOD.md, section 20)."""

from collections.abc import Sequence

import numpy as np

from sat_intervals.config import Config, ConfigError
from sat_intervals.kernels.cost import Costs, padded_to_lanes
from sat_intervals.match.ground import BLOCK, FEWEST
from sat_intervals.match.matching_cost import Area, AreaCosts, Given, MatchingCost
from sat_intervals.products import NO_DATA
from sat_intervals.tiling import Views, Window, hull

_FEW = "cost.method is sweep, which compares many images: use surface with three or more, or another preset"


class SweepCost(MatchingCost):
    """Distances of Census words of many images at the heights of ground cells."""

    def __init__(self, config: Config, given: Given) -> None:
        """Raise without what a run knows of its images."""
        if given.ground is None:
            raise ConfigError(_FEW)
        super().__init__(config, given)
        self._ground, self._ranges = given.ground, given.ranges

    @staticmethod
    def check(config: Config) -> None:
        """Raise: it is no cost of a pair."""
        raise ConfigError(_FEW)

    def windows(self, areas: Sequence[Area]) -> tuple[Window, ...]:
        """Return the window of each image that the costs of areas need."""
        base = hull([area.base for area in areas])
        last = max(area.minimum + area.disparities - 1 for area in areas)
        return self._ground.windows(base, min(area.minimum for area in areas), last)

    def of_areas(
        self, views: Views, areas: Sequence[Area], made: Sequence[np.ndarray] | None = None
    ) -> list[AreaCosts]:
        """Compute the costs of areas of reduced images, in blocks; candidates outside a block's range get the largest.

        ``made`` are the volume of an earlier call and its ``seen``. There is one area: many images have no right view.
        """
        (area,) = areas
        costs, count = made or self._of_area(views, area)
        state = np.where(count >= FEWEST, 0, NO_DATA).astype(np.uint8)
        there = np.zeros((area.base.height, area.base.width + area.disparities - 1), np.uint8)
        return [AreaCosts(Costs(costs, None, state, there), None, state, None, count)]

    def _of_area(self, views: Views, area: Area) -> tuple[np.ndarray, np.ndarray]:
        """Return the volume of an area, and how many images see its cells."""
        shape = area.base.height, area.base.width
        costs = np.full((*shape, padded_to_lanes(area.disparities)), self._config.numbers.largest, np.uint8)
        count = np.zeros(shape, np.uint8)
        for block, part in self._ground.blocks(area.base):
            first, last = self._range(block)
            here = Window(block[0] * BLOCK + part.row, block[1] * BLOCK + part.column, part.height, part.width)
            place = here.relative_to(area.base).slices
            disparities = np.arange(first, last + 1, dtype=float)
            found, seen = self._ground.costs(views, block, part, disparities, self._config)
            costs[(*place, slice(first - area.minimum, last + 1 - area.minimum))] = found
            count[place] = self._ground.count(seen)
        return costs, count

    def _range(self, block: tuple[int, int]) -> tuple[int, int]:
        if self._ranges is None:
            return self._config.disparity.minimum, self._config.disparity.maximum
        assert (self._ranges.height, self._ranges.width) == (BLOCK, BLOCK)
        return int(self._ranges.minimum[block]), int(self._ranges.maximum[block])
