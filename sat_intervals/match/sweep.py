"""Matching cost sweep: many images resampled to the ground at each height, compared there (METHOD.md, section 20)."""

from collections.abc import Sequence

import numpy as np

from sat_intervals.config import Config, ConfigError
from sat_intervals.kernels.cost import Costs, padded_to_lanes
from sat_intervals.match.ground import BLOCK
from sat_intervals.match.matching_cost import Area, AreaCosts, Given, MatchingCost
from sat_intervals.products import NO_DATA
from sat_intervals.tiling import View, Views, Window, hull

# Images that must see a cell.
FEWEST = 2
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
        """Compute the costs of areas, in blocks; candidates outside a block's range get the largest."""
        return self.of_reduced(self._ground.usable(views), areas, made)

    def of_reduced(
        self, images: Sequence[View], areas: Sequence[Area], made: Sequence[np.ndarray] | None = None
    ) -> list[AreaCosts]:
        """Compute the costs of areas from reduced images, see `GroundViews.usable`."""
        return [self._of_area(images, area, made[i] if made else None) for i, area in enumerate(areas)]

    def _of_area(self, images: Sequence[View], area: Area, made: np.ndarray | None) -> AreaCosts:
        shape, largest = (area.base.height, area.base.width), self._config.numbers.largest
        costs = made
        if costs is None:
            costs = np.full((*shape, padded_to_lanes(area.disparities)), largest, np.uint8)
        count = np.empty(shape, np.uint8)
        for block, part in self._ground.blocks(area.base):
            first, last = self._range(block)
            disparities = np.arange(first, last + 1, dtype=float)
            here = Window(block[0] * BLOCK + part.row, block[1] * BLOCK + part.column, part.height, part.width)
            place = here.relative_to(area.base).slices
            if made is not None:
                middle = disparities[disparities.size // 2 :][:1]
                _, seen = self._ground.costs(images, block, part, middle, self._config)
            else:
                found, seen = self._ground.costs(images, block, part, disparities, self._config)
                costs[(*place, slice(first - area.minimum, last + 1 - area.minimum))] = found
            count[place] = self._ground.count(seen)
        state = np.where(count >= FEWEST, 0, NO_DATA).astype(np.uint8)
        there = np.zeros((area.base.height, area.base.width + area.disparities - 1), np.uint8)
        return AreaCosts(Costs(costs, None, state, there), None, state, None, count)

    def _range(self, block: tuple[int, int]) -> tuple[int, int]:
        if self._ranges is None:
            return self._config.disparity.minimum, self._config.disparity.maximum
        assert (self._ranges.height, self._ranges.width) == (BLOCK, BLOCK)
        return int(self._ranges.minimum[block]), int(self._ranges.maximum[block])
