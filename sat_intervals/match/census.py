"""Matching cost Census: codes of both views, which SGM compares."""

from collections.abc import Sequence

import numpy as np

from sat_intervals.kernels.cost import Codes, between, census
from sat_intervals.match.matching_cost import Area, AreaCosts, MatchingCost, of_area
from sat_intervals.tiling import Views


class CensusCost(MatchingCost):
    """Hamming distances of Census codes."""

    def of_areas(
        self, views: Views, areas: Sequence[Area], made: Sequence[np.ndarray] | None = None
    ) -> list[AreaCosts]:
        """Compute the codes of both views, and crop them to areas; nothing of a cost is kept."""
        assert made is None
        window = self._config.cost.window
        codes = [census(view.pixels, view.state, window) for view in views]
        words, states = ([getattr(code, name) for code in codes] for name in Codes._fields)
        return [
            self._with_views(
                between(*map(Codes, *(of_area(area, views, arrays, window // 2) for arrays in (words, states)))),
                area,
                views,
            )
            for area in areas
        ]
