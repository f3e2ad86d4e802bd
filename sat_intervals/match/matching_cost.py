"""From the pixels of two views to the matching costs of areas, and to the penalties that their gradients make."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np

from sat_intervals.config import Config, InverseSgm, Mccnn, MccnnSgm, NegativeSgm
from sat_intervals.kernels.correlation import correlate
from sat_intervals.kernels.cost import Codes, Costs, between, census, padded_to_lanes, window_state
from sat_intervals.kernels.penalties import EDGES, INVERSE, NEGATIVE, Gradients, Rule
from sat_intervals.match.mccnn import Network, load_network, weights_file
from sat_intervals.match.normalization import ImageStatistics, PairStatistics
from sat_intervals.tiling import Window, facing

Reader = Callable[[Window], tuple[np.ndarray, np.ndarray]]
"""Pixels (float) and states (uint8) of any window of an image; outside the image the state is NO_DATA."""

# Rows that go through the network together: their features, and what it holds meanwhile, stay small.
STRIP = 64


class Area(NamedTuple):
    """Pixels of one view to match, and those of the other that face them.

    Attributes
    ----------
    base, facing
        Windows of the two images, of the same rows.
    minimum
        Disparity at which the first pixel of ``base`` faces the first of ``facing``.
    mirrored
        Whether the base is in the right image.
    """

    base: Window
    facing: Window
    minimum: int
    mirrored: bool = False

    @classmethod
    def of(cls, base: Window, config: Config) -> "Area":
        """A left area and what it faces over the search range."""
        search = config.disparity
        return cls(base, facing(base, search.minimum, search.maximum), search.minimum)

    @classmethod
    def mirror(cls, base: Window, config: Config) -> "Area":
        """A right area and what it faces in the left image."""
        search = config.disparity
        return cls(base, facing(base, -search.maximum, -search.minimum), -search.maximum, mirrored=True)

    @property
    def left(self) -> Window:
        """The part in the left image."""
        return self.facing if self.mirrored else self.base

    @property
    def right(self) -> Window:
        """The part in the right image."""
        return self.base if self.mirrored else self.facing


class MatchingCost(NamedTuple):
    """What the kernels match an area by, the states of its base's pixels, and which of them are `_textureless`."""

    costs: Costs
    gradients: Gradients | None
    state: np.ndarray
    textureless: np.ndarray


class _View(NamedTuple):
    """One image of a patch, read once: pixels and states of a window and ``radius`` more on all sides."""

    window: Window
    radius: int
    pixels: np.ndarray
    state: np.ndarray

    def inner(self, array: np.ndarray, window: Window) -> np.ndarray:
        """The part of pixels or states in a window."""
        row, column = window.row - self.window.row + self.radius, window.column - self.window.column + self.radius
        return np.ascontiguousarray(array[row : row + window.height, column : column + window.width])


def cost_areas(
    left: Reader, right: Reader, areas: Sequence[Area], config: Config, statistics: PairStatistics | None = None
) -> list[MatchingCost]:
    """Read two views once and make the costs and penalties of areas of theirs, which have the same rows.

    Parameters
    ----------
    left, right
        The images.
    areas
        What to match.
    config
        Settings.
    statistics
        Mean and standard deviation of the whole images, which MC-CNN needs.
    """
    views = _read(left, [area.left for area in areas], config), _read(right, [area.right for area in areas], config)
    if isinstance(config.cost, Mccnn):
        assert statistics is not None  # whoever matches by MC-CNN has measured the images
        costs = _correlations(*views, areas, statistics, load_network(weights_file(config.cost.weights)))
    else:
        costs = _hamming(*views, areas, config.cost.window)
    varying = [_varies(view) for view in views]
    return [
        MatchingCost(
            found,
            _gradients(area, *views, config, statistics),
            _of_base(area, *views),
            _textureless(area, found, *views, *varying),
        )
        for area, found in zip(areas, costs, strict=True)
    ]


def _read(read: Reader, windows: list[Window], config: Config) -> _View:
    column = min(window.column for window in windows)
    width = max(window.column_stop for window in windows) - column
    window, radius = Window(windows[0].row, column, windows[0].height, width), config.cost.window // 2
    return _View(window, radius, *read(window.grown(radius, radius)))


def _of_base(area: Area, left: _View, right: _View) -> np.ndarray:
    view = right if area.mirrored else left
    return view.inner(view.state, area.base)


# ---- Texture -----------------------------------------------------------------------------------------------
def _varies(view: _View) -> np.ndarray:
    """Where a pixel's window changes along any of its rows: bool of the view's window."""
    height, width, radius = view.window.height, view.window.width, view.radius
    differs = view.pixels[:, 1:] != view.pixels[:, :-1]
    in_column = reduce(np.logical_or, (differs[row : row + height] for row in range(2 * radius + 1)))
    varies: np.ndarray = reduce(np.logical_or, (in_column[:, column : column + width] for column in range(2 * radius)))
    return varies


def _textureless(
    area: Area, costs: Costs, left: _View, right: _View, left_varies: np.ndarray, right_varies: np.ndarray
) -> np.ndarray:
    """Pixels of the base whose window, and all usable windows that it faces, do not change along the row.

    All their candidates cost the same. SGM would still choose among them, by what it carries in from the images' ends.
    """
    base, there = (right, left) if area.mirrored else (left, right)
    base_varies, there_varies = (right_varies, left_varies) if area.mirrored else (left_varies, right_varies)
    flat: np.ndarray = ~base_varies[area.base.relative_to(base.window).slices] & (costs.left_state == 0)
    rows = flat.any(axis=1)  # few, as a rule: the rest costs nothing
    telling = there_varies[area.facing.relative_to(there.window).slices][rows] & (costs.right_state[rows] == 0)
    upto = np.pad(np.cumsum(telling, axis=1, dtype=np.int32), [(0, 0), (1, 0)])
    columns = area.base.width
    flat[rows] &= upto[:, -columns:] == upto[:, :columns]
    return flat


# ---- Census ------------------------------------------------------------------------------------------------
def _hamming(left: _View, right: _View, areas: Sequence[Area], window: int) -> list[Costs]:
    codes = [census(view.pixels, view.state, window) for view in (left, right)]

    def cut(side: int, wanted: Window) -> Codes:
        columns = wanted.relative_to((left, right)[side].window).slices[1]
        words, state = codes[side]
        return Codes(np.ascontiguousarray(words[:, :, columns]), np.ascontiguousarray(state[:, columns]))

    return [between(cut(area.mirrored, area.base), cut(not area.mirrored, area.facing)) for area in areas]


# ---- MC-CNN ------------------------------------------------------------------------------------------------
def _correlations(
    left: _View, right: _View, areas: Sequence[Area], statistics: PairStatistics, network: Network
) -> list[Costs]:
    """Costs of all areas, strip by strip: features are never kept, and computed once however many areas there are."""
    views = left, right
    states = [window_state(view.state, view.radius) for view in views]
    made = []
    for area in areas:
        size = padded_to_lanes(area.facing.width - area.base.width + 1)
        made.append(np.empty((area.base.height, area.base.width, size), np.uint8))
    for row in range(0, left.window.height, STRIP):
        rows = slice(row, min(row + STRIP, left.window.height))
        strips = [
            _features(view, state, rows, of_image, network)
            for view, state, of_image in zip(views, states, statistics, strict=True)
        ]
        for area, costs in zip(areas, made, strict=True):
            base, there = strips[area.mirrored], strips[not area.mirrored]
            of_base = area.base.relative_to(views[area.mirrored].window).slices[1]
            of_there = area.facing.relative_to(views[not area.mirrored].window).slices[1]
            base, there = np.ascontiguousarray(base[:, :, of_base]), np.ascontiguousarray(there[:, :, of_there])
            correlate(base, there, costs[rows])

    def state_of(side: int, wanted: Window) -> np.ndarray:
        return np.ascontiguousarray(states[side][:, wanted.relative_to(views[side].window).slices[1]])

    return [
        Costs(costs, None, state_of(area.mirrored, area.base), state_of(not area.mirrored, area.facing))
        for area, costs in zip(areas, made, strict=True)
    ]


def _features(view: _View, state: np.ndarray, rows: slice, statistics: ImageStatistics, network: Network) -> np.ndarray:
    """Features of rows of a view, ``(features, rows, columns)``; zero beside the columns with a usable window."""
    height, width = rows.stop - rows.start, view.window.width
    usable = np.flatnonzero((state[rows] == 0).any(axis=0))
    if not usable.size:
        return np.zeros((network.count, height, width), np.float32)
    first, last = usable[0], usable[-1] + 1
    seen = np.s_[rows.start : rows.stop + 2 * view.radius, first : last + 2 * view.radius]
    pixels = (view.pixels[seen].astype(np.float64) - statistics.mean) / statistics.deviation
    pixels[view.state[seen] != 0] = 0
    inner = network(pixels.astype(np.float32))
    if inner.shape[2] == width:
        return inner
    features = np.zeros((network.count, height, width), np.float32)
    features[:, :, first:last] = inner
    return features


# ---- Penalties ---------------------------------------------------------------------------------------------
def _gradients(
    area: Area, left: _View, right: _View, config: Config, statistics: PairStatistics | None
) -> Gradients | None:
    """What the penalties of an area follow; None where they are constant."""
    if isinstance(config.sgm, MccnnSgm):
        edges = np.full(2, config.sgm.d)
        if config.sgm.gradients == "normalized":
            assert statistics is not None
            edges *= [statistics[area.mirrored].deviation, statistics[not area.mirrored].deviation]
        rule = _edge_rule(config, config.sgm, edges, area)
    elif isinstance(config.sgm, NegativeSgm | InverseSgm):
        rule = _banz_rule(config.sgm)
    else:
        return None
    base, there = (right, left) if area.mirrored else (left, right)
    here, facing_it = base.inner(base.pixels, area.base), there.inner(there.pixels, area.facing)
    return Gradients(here.astype(np.float32, copy=False), facing_it.astype(np.float32, copy=False), rule)


def _edge_rule(config: Config, sgm: MccnnSgm, edges: np.ndarray, area: Area) -> Rule:
    divisors = 1, sgm.q1, sgm.q1 * sgm.q2
    p1 = [config.in_steps(sgm.p1 / divisor) for divisor in divisors]
    vertical = [config.in_steps(sgm.p1 / divisor / sgm.v) for divisor in divisors]
    p2 = [config.in_steps(sgm.p2 / divisor) for divisor in divisors]
    tables = np.array([p1, p1, p1, vertical], np.uint16), np.array([p2] * 4, np.uint16)
    left, right = map(float, edges)
    return Rule(EDGES, *tables, left, right, sgm.gradients == "normalized", -area.minimum)


def _banz_rule(sgm: NegativeSgm | InverseSgm) -> Rule:
    tables = np.full((4, 3), sgm.p1, np.uint16), np.full((4, 3), sgm.p2, np.uint16)
    if isinstance(sgm, NegativeSgm):
        return Rule(NEGATIVE, *tables, alpha=sgm.alpha, gamma=sgm.gamma)
    return Rule(INVERSE, *tables, alpha=sgm.alpha, beta=sgm.beta, gamma=sgm.gamma)
