"""Features of a network of MC-CNN's form, by its ONNX file (Zbontar and LeCun 2016). The only home of onnxruntime.

Such a network takes one band, normalised, ``(rows, columns)``, and gives a unit vector for every pixel whose window of
11 x 11 lies inside: ``(features, rows - 10, columns - 10)``, convolved without padding.
"""

from functools import lru_cache
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import SatIntervalsError, check_regular

# Pixels around one that its feature sees.
RADIUS = 5
# The distribution of the official weights, and the file that the reference implementation takes.
_DISTRIBUTION, _OFFICIAL = "MCCNN", "mc_cnn_fast_int8_excl_01.onnx"
_INSTALL = "pip install sat-intervals[mccnn]"
# Bytes of a file of weights; the official one has 0.4 MB.
_LARGEST = 256 * 10**6
# How far from 1 a feature may be long.
_UNIT = 1e-3


def weights_file(weights: str | None) -> Path:
    """The file of a network: the one that is named, or the official one, found without importing its package.

    Raises
    ------
    SatIntervalsError
        There is none.
    """
    if weights is not None:
        check_regular(weights)
        if not Path(weights).is_file():
            raise SatIntervalsError(f"cost.weights {weights}: no such file: name an ONNX network, or null")
        size = Path(weights).stat().st_size
        if size > _LARGEST:
            raise SatIntervalsError(
                f"cost.weights {weights} has {size / 1e6:.0f} MB, a network like MC-CNN has less than "
                f"{_LARGEST / 1e6:.0f} MB: name an ONNX network, or null"
            )
        return Path(weights).resolve()
    try:
        found = [file for file in files(_DISTRIBUTION) or [] if file.name == _OFFICIAL]
    except PackageNotFoundError as error:
        raise SatIntervalsError(f"cost mccnn needs the weights in {_DISTRIBUTION}: {_INSTALL}") from error
    if not found:
        raise SatIntervalsError(f"the installed {_DISTRIBUTION} has no {_OFFICIAL}: {_INSTALL}, or set cost.weights")
    return Path(str(found[0].locate())).resolve()


class Network:
    """A network that was tried: it has the form above. Any number of threads may call it at once."""

    def __init__(self, file: Path) -> None:
        """Load and try a network.

        Raises
        ------
        SatIntervalsError
            onnxruntime is not there, or the file is no such network.
        """
        self._session = _session(file)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        form = f"{[i.shape for i in inputs]} to {[o.shape for o in outputs]}"
        if len(inputs) != 1 or len(inputs[0].shape) != 2 or inputs[0].type != "tensor(float)" or len(outputs) != 1:
            raise _wrong(file, f"takes and gives {form}")
        self._input = inputs[0].name
        sizes = (2 * RADIUS + 1, 2 * RADIUS + 14), (2 * RADIUS + 9, 2 * RADIUS + 6)
        random = np.random.default_rng(0)
        for rows, columns in sizes:
            try:
                features = self(random.standard_normal((rows, columns), np.float32))
            except Exception as error:  # of onnxruntime, which has none in common
                raise _wrong(file, f"takes no image of {rows} x {columns}: {' '.join(str(error).split())}") from error
            if features.ndim != 3 or features.shape[1:] != (rows - 2 * RADIUS, columns - 2 * RADIUS):
                raise _wrong(file, f"makes {features.shape} of an image of {rows} x {columns}")
            lengths = np.linalg.norm(features, axis=0)
            if not (np.abs(lengths - 1) <= _UNIT).all():
                raise _wrong(file, f"makes vectors of length {lengths.min():.3g} to {lengths.max():.3g}, not 1")
        self.count = int(features.shape[0])

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """Features ``(count, rows - 10, columns - 10)`` of normalised pixels ``(rows, columns)``, float32.

        Zeros, whose cosine with any feature is 0, where a network makes no unit vector, as one without biases of a
        window without texture: NaN, of a division by the length 0.
        """
        features = np.asarray(self._session.run(None, {self._input: pixels})[0])
        lost = np.isnan(features[:1]).all(axis=0)
        if lost.any():
            features[:, lost] = 0
        return features


def _session(file: Path) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise SatIntervalsError(f"cost mccnn needs onnxruntime: {_INSTALL}") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # tiles are the only parallelism
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(file.read_bytes(), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise SatIntervalsError(f"{file} is no ONNX network: {' '.join(str(error).split())}") from error


def _wrong(file: Path, what: str) -> SatIntervalsError:
    return SatIntervalsError(
        f"{file} {what}: needed is a network of MC-CNN fast's form, (rows, columns) float32 to unit vectors "
        "(features, rows - 10, columns - 10)"
    )


def load_network(file: Path) -> Network:
    """The network of a file, loaded once a process and again when the file is another."""
    status = file.stat()
    return _loaded(file, (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns))


@lru_cache(maxsize=4)
def _loaded(file: Path, stamp: tuple[int, ...]) -> Network:
    return Network(file)
