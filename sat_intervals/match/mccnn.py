"""Matching cost of MC-CNN fast, a network in an ONNX file (Zbontar and LeCun 2016). The only home of onnxruntime.

The network maps one normalised band, ``(rows, columns)``, to a unit vector for every pixel whose 11 x 11 window is
inside: ``(features, rows - 10, columns - 10)``, a convolution without padding.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.config import Config
from sat_intervals.config.costs import INSTALL_MCCNN
from sat_intervals.errors import ChangedInputError, SatIntervalsError
from sat_intervals.kernels.correlation import correlate
from sat_intervals.kernels.cost import Costs, padded_to_lanes, window_state
from sat_intervals.match.matching_cost import Area, AreaCosts, Given, MatchingCost, of_area
from sat_intervals.match.normalization import ImageStatistics
from sat_intervals.tiling import View, Views

# Radius of the window of a feature, in pixels.
RADIUS = 5
# Rows that go through the network at once; few, which limits the memory for features.
STRIP = 64
# How an ONNX file says that weights are in another file: the key "location" and the tag of its value.
_ELSEWHERE = b"\n\x08location\x12"
# Largest deviation of a feature's length from 1.
_UNIT = 1e-3


class Network:
    """A network that was checked to have the form above. Any number of threads may call it at once."""

    def __init__(self, file: Path, content: bytes) -> None:
        self._session = _session(file, content)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        form = f"{[i.shape for i in inputs]} to {[o.shape for o in outputs]}"
        if len(inputs) != 1 or len(inputs[0].shape) != 2 or inputs[0].type != "tensor(float)" or len(outputs) != 1:
            raise _wrong(file, f"maps {form}")
        self._input = inputs[0].name
        sizes = (2 * RADIUS + 1, 2 * RADIUS + 14), (2 * RADIUS + 9, 2 * RADIUS + 6)
        random = np.random.default_rng(0)
        for rows, columns in sizes:
            try:
                features = self(random.standard_normal((rows, columns), np.float32))
            except Exception as error:  # the exceptions of onnxruntime have no common base class
                raise _wrong(file, f"rejects an image of {rows} x {columns}: {' '.join(str(error).split())}") from error
            if features.ndim != 3 or features.shape[1:] != (rows - 2 * RADIUS, columns - 2 * RADIUS):
                raise _wrong(file, f"maps an image of {rows} x {columns} to {features.shape}")
            lengths = np.linalg.norm(features, axis=0)
            if not (np.abs(lengths - 1) <= _UNIT).all():
                raise _wrong(file, f"gives vectors of length {lengths.min():.3g} to {lengths.max():.3g}, not 1")
        self.count = int(features.shape[0])

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """Features ``(count, rows - 10, columns - 10)`` of normalised pixels ``(rows, columns)``, float32."""
        # A feature of NaN, that of a window without texture, becomes zeros, whose cosine with any feature is 0.
        features = np.asarray(self._session.run(None, {self._input: pixels})[0])
        undefined = np.isnan(features[:1]).all(axis=0)
        if undefined.any():
            features[:, undefined] = 0
        return features


def _session(file: Path, content: bytes) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise SatIntervalsError(f"cost mccnn needs onnxruntime: {INSTALL_MCCNN}") from error
    if _ELSEWHERE in content:
        raise SatIntervalsError(
            f"{file} has weights in another file, whose changes would not be noticed: save the network as one file"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # tiles are the only parallelism
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise SatIntervalsError(f"{file} is not a valid ONNX network: {' '.join(str(error).split())}") from error


def _wrong(file: Path, what: str) -> SatIntervalsError:
    return SatIntervalsError(
        f"{file} {what}: give a network with the form of MC-CNN fast, (rows, columns) float32 to unit vectors "
        "(features, rows - 10, columns - 10)"
    )


def load_network(file: Path) -> Network:
    """Load the network of a file."""
    return _loaded(_Weights.of(file))


@dataclass(frozen=True)
class _Weights:
    """A file of weights and its content, known by its SHA-256."""

    file: Path
    sha256: str
    content: bytes = field(compare=False)

    @classmethod
    def of(cls, file: Path) -> "_Weights":
        try:
            content = file.read_bytes()
        except OSError as error:
            raise SatIntervalsError(f"{file} cannot be read: {error.strerror}: name an ONNX network") from error
        return cls(file, hashlib.sha256(content).hexdigest(), content)


@lru_cache(maxsize=4)
def _loaded(weights: _Weights) -> Network:
    """Make a network, once per process for the same content."""
    return Network(weights.file, weights.content)


class MccnnCost(MatchingCost):
    """1 - cosine of the features of both views."""

    def __init__(self, config: Config, given: Given) -> None:
        super().__init__(config, given)
        weights = _Weights.of(config.cost.files()["weights"])
        if given.inputs is not None and weights.sha256 != given.inputs.get("weights", {}).get("sha256"):
            raise ChangedInputError(
                f"{weights.file} has other weights than the run: restore it, and give all workers the same weights"
            )
        self._network = _loaded(weights)

    @staticmethod
    def check(config: Config) -> None:
        """Raise if the network cannot be loaded."""
        load_network(config.cost.files()["weights"])

    def of_areas(
        self, views: Views, areas: Sequence[Area], made: Sequence[np.ndarray] | None = None
    ) -> list[AreaCosts]:
        """Correlate the features of both views."""
        states = [window_state(view.state, RADIUS) for view in views]
        made = self._correlations(views, states, areas) if made is None else made
        return [
            self._with_views(Costs(costs, None, *of_area(area, views, states, RADIUS)), area, views)
            for area, costs in zip(areas, made, strict=True)
        ]

    def _correlations(self, views: Views, states: Sequence[np.ndarray], areas: Sequence[Area]) -> list[np.ndarray]:
        """Costs of all areas, strip by strip: all areas share the features of a strip, which are then discarded."""
        statistics, height = self._given.statistics, areas[0].base.height
        assert statistics is not None  # MC-CNN always comes with them
        made = [np.empty((height, area.base.width, padded_to_lanes(area.disparities)), np.uint8) for area in areas]
        for row in range(0, height, STRIP):
            rows = slice(row, min(row + STRIP, height))
            strips = [
                _features(view, state, rows, of_image, self._network)
                for view, state, of_image in zip(views, states, statistics, strict=True)
            ]
            for area, costs in zip(areas, made, strict=True):
                correlate(*of_area(area, views, strips, RADIUS), costs[rows])
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
