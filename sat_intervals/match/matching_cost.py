"""Matching costs of areas from the pixels of two views, and gradients for their penalties."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config, Mccnn, MccnnSgm, Volume
from sat_intervals.config.weights import weights_file
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.correlation import correlate
from sat_intervals.kernels.cost import Cells, Codes, Costs, between, census, padded_to_lanes, window_state
from sat_intervals.kernels.penalties import Gradients, Rule
from sat_intervals.match.costs import MatchingCost, foreign_costs, integer_costs, unmasked
from sat_intervals.match.mccnn import RADIUS, Network, load_network
from sat_intervals.match.normalization import ImageStatistics, PairStatistics
from sat_intervals.tiling import View, Views, Window, facing, hull

VolumeOf = Callable[[np.ma.MaskedArray, np.ma.MaskedArray, int], np.ndarray]
"""Makes the volume of a tile from both images around it and its first disparity, see `match_pair`."""

# Rows that go through the network at once; few, which limits the memory for features.
STRIP = 64


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


def view_windows(areas: Sequence[Area], config: Config) -> tuple[Window, Window]:
    """Windows of both images that the costs of areas need; the areas are in the same rows."""
    radius = config.cost.window // 2
    left, right = (hull(windows) for windows in zip(*((area.left, area.right) for area in areas), strict=True))
    return left.grown(radius, radius), right.grown(radius, radius)


def cost_areas(
    views: Views,
    areas: Sequence[Area],
    config: Config,
    statistics: PairStatistics | None = None,
    network: Network | VolumeOf | None = None,
    made: Sequence[np.ndarray] | None = None,
) -> list[MatchingCost]:
    """Costs and gradients of areas of two views.

    views: both images in the `view_windows` of the areas.
    statistics: of the whole images; None if the matching cost needs none.
    network: of MC-CNN, by default that of the settings; or what makes the volumes of another matcher.
    made: precomputed costs of the areas from an earlier call, ``Costs.left``, so that they are not computed again.
    """
    if isinstance(config.cost, Volume):
        if made is None:
            if network is None:
                raise SatIntervalsError("cost.method is volume: use intervals_of, or match_pair with volume_of")
            assert not isinstance(network, Network)
            made = [_values(views, area, config, network) for area in areas]
        return [foreign_costs(of_area, area.disparities, config) for area, of_area in zip(areas, made, strict=True)]
    if isinstance(config.cost, Mccnn):
        assert statistics is not None  # MC-CNN always comes with statistics
        assert network is None or isinstance(network, Network)
        if made is None:
            network = network or load_network(weights_file(config.cost.weights))
            made = _correlations(views, areas, statistics, network)
        states = [window_state(view.state, RADIUS) for view in views]
        costs = [
            Costs(of_area, None, *_of_area(area, views, states, RADIUS))
            for area, of_area in zip(areas, made, strict=True)
        ]
    else:
        costs = _hamming(views, areas, config.cost.window // 2)
    return [
        MatchingCost(
            found,
            _gradients(area, views, config, statistics),
            views[area.mirrored].inner(views[area.mirrored].state, area.base),
        )
        for area, found in zip(areas, costs, strict=True)
    ]


def _values(views: Views, area: Area, config: Config, volume_of: VolumeOf) -> np.ndarray:
    """Return the integer costs of another matcher's volume of an area."""
    margin = config.cost.window // 2
    left, right = (
        np.ma.array(view.inner(view.pixels, there), mask=view.inner(view.state, there) != 0)
        for view, there in zip(views, (area.base.grown(margin, margin), area.facing.grown(margin, margin)), strict=True)
    )
    values = unmasked(volume_of(left, right, area.minimum))
    needed = (area.base.height, area.base.width, area.disparities)
    if values.shape != needed or values.dtype.kind not in "uif":
        raise SatIntervalsError(f"volume_of returned {values.shape} of {values.dtype}, needed are {needed} numbers")
    return integer_costs(values, config)


def _of_area(area: Area, views: Views, arrays: Sequence[np.ndarray], radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Crop the arrays of both views to an area: columns of its base, and of the pixels that face it.

    ``arrays``, ``(..., columns)``, belong to the left and the right view without a margin of ``radius``.
    """

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


def textureless(views: Views, area: Area, costs: Costs, config: Config, cells: Cells | None = None) -> np.ndarray:
    """Pixels of the base whose window, and all usable windows that face it, do not vary along any row.

    All their candidates cost the same. SGM would still choose among them, by costs carried in from the image borders.
    ``cells`` are the local search ranges of the area; by default all pixels search all of it.
    """
    radius = config.cost.window // 2
    base_varies, there_varies = _of_area(area, views, [_varies(view, radius) for view in views], radius)
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


def _hamming(views: Views, areas: Sequence[Area], radius: int) -> list[Costs]:
    codes = [census(view.pixels, view.state, 2 * radius + 1) for view in views]
    words, states = ([getattr(code, name) for code in codes] for name in Codes._fields)
    return [
        between(*map(Codes, _of_area(area, views, words, radius), _of_area(area, views, states, radius)))
        for area in areas
    ]


def _correlations(
    views: Views, areas: Sequence[Area], statistics: PairStatistics, network: Network
) -> list[np.ndarray]:
    """Costs of all areas, strip by strip: all areas share the features of a strip, which are then discarded."""
    states = [window_state(view.state, RADIUS) for view in views]
    made = [
        np.empty((area.base.height, area.base.width, padded_to_lanes(area.disparities)), np.uint8) for area in areas
    ]
    height = areas[0].base.height
    for row in range(0, height, STRIP):
        rows = slice(row, min(row + STRIP, height))
        strips = [
            _features(view, state, rows, of_image, network)
            for view, state, of_image in zip(views, states, statistics, strict=True)
        ]
        for area, costs in zip(areas, made, strict=True):
            correlate(*_of_area(area, views, strips, RADIUS), costs[rows])
    return made


def _features(view: View, state: np.ndarray, rows: slice, statistics: ImageStatistics, network: Network) -> np.ndarray:
    """Features of rows of a view, ``(features, rows, columns)``; zero before and after the usable columns."""
    height, width = rows.stop - rows.start, state.shape[1]
    usable = np.flatnonzero((state[rows] == 0).any(axis=0))
    if not usable.size:
        return np.zeros((network.count, height, width), np.float32)
    first, last = usable[0], usable[-1] + 1
    part = np.s_[rows.start : rows.stop + 2 * RADIUS, first : last + 2 * RADIUS]
    pixels = (view.pixels[part].astype(np.float64) - statistics.mean) / statistics.deviation
    pixels[view.state[part] != 0] = 0
    inner = network(pixels.astype(np.float32))
    if inner.shape[2] == width:
        return inner
    features = np.zeros((network.count, height, width), np.float32)
    features[:, :, first:last] = inner
    return features


def _gradients(area: Area, views: Views, config: Config, statistics: PairStatistics | None) -> Gradients | None:
    """Gradients that the penalties of an area follow; None for constant penalties."""
    sgm = config.sgm
    if not isinstance(sgm, MccnnSgm):
        return None
    assert statistics is not None  # as above
    divisors = 1, sgm.q1, sgm.q1 * sgm.q2
    p1 = [config.in_steps(sgm.p1 / divisor) for divisor in divisors]
    vertical = [config.in_steps(sgm.p1 / divisor / sgm.v) for divisor in divisors]
    p2 = [config.in_steps(sgm.p2 / divisor) for divisor in divisors]
    edges = (sgm.d * statistics[side].deviation for side in (area.mirrored, not area.mirrored))
    rule = Rule(np.array([p1, p1, p1, vertical], np.uint16), np.array([p2] * 4, np.uint16), *edges)
    base, there = views[area.mirrored], views[not area.mirrored]
    here, facing_it = base.inner(base.pixels, area.base), there.inner(there.pixels, area.facing)
    return Gradients(here.astype(np.float32, copy=False), facing_it.astype(np.float32, copy=False), rule)
