"""A matching cost: what it reads, and the costs of areas; `config.costs` has its numbers, files and memory."""

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.config import Config
from sat_intervals.kernels.cost import Cells, Costs
from sat_intervals.kernels.penalties import Gradients, Rule
from sat_intervals.match.ground import GroundViews
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.match.normalization import PairStatistics
from sat_intervals.tiling import View, Views, Window, facing, hull

VolumeOf = Callable[[np.ma.MaskedArray, np.ma.MaskedArray, int], np.ndarray]
"""Makes the volume of a tile from both images around it and its first disparity, see `match_pair`."""


class Area(NamedTuple):
    """Pixels of one view to match, and the pixels of the other view that face them.

    base, facing: windows of the two images, in the same rows.
    minimum: disparity at which the first pixel of ``base`` faces the first of ``facing``.
    mirrored: whether ``base`` is in the right image.
    """

    base: Window
    facing: Window
    minimum: int
    mirrored: bool = False

    @classmethod
    def of(cls, base: Window, config: Config, mirrored: bool = False) -> "Area":
        """Make the area of left (right) pixels and the right (left) pixels that face them."""
        search = config.disparity
        ends = (-search.maximum, -search.minimum) if mirrored else (search.minimum, search.maximum)
        return cls(base, facing(base, *ends), ends[0], mirrored)

    @property
    def disparities(self) -> int:
        """Number of disparities."""
        return self.facing.width - self.base.width + 1

    @property
    def left(self) -> Window:
        """Window in the left image."""
        return self.facing if self.mirrored else self.base

    @property
    def right(self) -> Window:
        """Window in the right image."""
        return self.base if self.mirrored else self.facing


class AreaCosts(NamedTuple):
    """Costs and gradients of an area for the kernels.

    gradients: that the penalties follow; None for constant penalties.
    state: ``(rows, columns)`` uint8: states of the base's pixels.
    views: images whose windows say which pixels have no texture; None if the cost does not know.
    seen: ``(rows, columns)`` uint8: how many images that see the base's pixels; None of two images.
    """

    costs: Costs
    gradients: Gradients | None
    state: np.ndarray
    views: Views | None
    seen: np.ndarray | None = None


class Given(NamedTuple):
    """What a run knows beside its settings.

    statistics: of the whole images; None if the matching cost needs none.
    inputs: what identified the files of the cost at the start; None: nothing is compared.
    volume_of: makes the volumes of another matcher.
    ground, ranges: where many images show the cells of the ground, and their local ranges.
    """

    statistics: PairStatistics | None = None
    inputs: Mapping[str, Any] | None = None
    volume_of: VolumeOf | None = None
    ground: GroundViews | None = None
    ranges: LocalRanges | None = None


class MatchingCost:
    """A matching cost with all that it needs."""

    def __init__(self, config: Config, given: Given) -> None:
        self._config, self._given = config, given

    @staticmethod
    def check(config: Config) -> None:
        """Raise if the costs of these settings cannot be computed on this machine."""

    def windows(self, areas: Sequence[Area]) -> tuple[Window, ...]:
        """Return the window of each image that the costs of areas need; the areas are in the same rows."""
        return view_windows(areas, self._config)

    def of_areas(
        self, views: Views, areas: Sequence[Area], made: Sequence[np.ndarray] | None = None
    ) -> list[AreaCosts]:
        """Compute the costs of areas; ``made`` are precomputed ones of an earlier call, see `precomputed`."""
        raise NotImplementedError

    def _with_views(self, costs: Costs, area: Area, views: Views) -> AreaCosts:
        """Return costs of an area with what the kernels need of the pixels."""
        base = views[area.mirrored]
        gradients = _gradients(area, views, self._config, self._given.statistics)
        return AreaCosts(costs, gradients, base.inner(base.state, area.base), views)


def view_windows(areas: Sequence[Area], config: Config) -> tuple[Window, Window]:
    """Windows of two views that costs of areas in the same rows need."""
    radius = config.cost.window // 2
    left, right = (hull(windows) for windows in zip(*((area.left, area.right) for area in areas), strict=True))
    return left.grown(radius, radius), right.grown(radius, radius)


def of_area(area: Area, views: Views, arrays: Sequence[np.ndarray], radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Crop arrays of both views, ``(..., columns)`` without a margin ``radius``, to the base and facing of an area."""

    def crop(side: bool, wanted: Window) -> np.ndarray:
        first = wanted.column - views[side].window.column - radius
        return np.ascontiguousarray(arrays[side][..., first : first + wanted.width])

    return crop(area.mirrored, area.base), crop(not area.mirrored, area.facing)


def _varies(view: View, radius: int) -> np.ndarray:
    """Pixels whose window varies along any of its rows: bool, without a margin of ``radius``."""
    height, width = view.window.height - 2 * radius, view.window.width - 2 * radius
    differs = view.pixels[:, 1:] != view.pixels[:, :-1]
    in_column = reduce(np.logical_or, (differs[row : row + height] for row in range(2 * radius + 1)))
    varies: np.ndarray = reduce(np.logical_or, (in_column[:, column : column + width] for column in range(2 * radius)))
    return varies


def textureless(cost: AreaCosts, area: Area, config: Config, cells: Cells | None = None) -> np.ndarray:
    """Pixels of the base whose window, and all usable windows that face it, do not vary along any row."""
    # All their candidates cost the same. SGM would still choose among them, by costs carried in from the image borders.
    costs = cost.costs
    views = cost.views
    radius = config.cost.window // 2
    if views is None:
        return np.zeros(costs.left_state.shape, np.bool_)
    base_varies, there_varies = of_area(area, views, [_varies(view, radius) for view in views], radius)
    flat: np.ndarray = ~base_varies & (costs.left_state == 0)
    rows = flat.any(axis=1)  # usually few: skip the others
    textured = there_varies[rows] & (costs.right_state[rows] == 0)
    cumulative = np.pad(np.cumsum(textured, axis=1, dtype=np.int32), [(0, 0), (1, 0)])
    columns = flat.shape[1]
    if cells is None:
        flat[rows] &= cumulative[:, -columns:] == cumulative[:, :columns]
        return flat
    row, column = (np.flatnonzero(rows) + cells.row) // cells.height, (np.arange(columns) + cells.column) // cells.width
    first, last = (bound[row[:, np.newaxis], column] + np.arange(columns) for bound in (cells.first, cells.last))
    flat[rows] &= np.take_along_axis(cumulative, last + 1, 1) == np.take_along_axis(cumulative, first, 1)
    return flat


def _gradients(area: Area, views: Views, config: Config, statistics: PairStatistics | None) -> Gradients | None:
    """Gradients that the penalties of an area follow; None for constant penalties."""
    at_edges = config.sgm.at_edges() if config.sgm else None
    if at_edges is None:
        return None
    assert statistics is not None  # costs that go with such penalties need them
    *tables, gradient = at_edges
    p1, p2 = (np.array([[config.in_steps(one) for one in row] for row in table], np.uint16) for table in tables)
    edges = (gradient * statistics[side].deviation for side in (area.mirrored, not area.mirrored))
    base, there = views[area.mirrored], views[not area.mirrored]
    here, facing_it = base.inner(base.pixels, area.base), there.inner(there.pixels, area.facing)
    return Gradients(
        here.astype(np.float32, copy=False), facing_it.astype(np.float32, copy=False), Rule(p1, p2, *edges)
    )
