"""Find the file of weights of MC-CNN."""

from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

from sat_intervals.errors import SatIntervalsError

# The distribution of the official weights, and its files: the one that Pandora uses, and one of depthwise convolutions.
_DISTRIBUTION = "MCCNN"
NETWORKS = {"full": "mc_cnn_fast_int8_excl_01.onnx", "depthwise": "mc_cnn_fast_dw.onnx"}
INSTALL_MCCNN = "pip install 'sat-intervals[mccnn]'"
_NAMES = " or ".join(NETWORKS)


def weights_file(weights: str) -> Path:
    """Find the file of a network: a given one, or an official one without an import of its package."""
    if weights not in NETWORKS:
        if not Path(weights).is_file():
            raise SatIntervalsError(f"cost.weights {weights}: no such file: name an ONNX network, or {_NAMES}")
        return Path(weights).resolve()
    try:
        found = [file for file in files(_DISTRIBUTION) or [] if file.name == NETWORKS[weights]]
    except PackageNotFoundError as error:
        raise SatIntervalsError(f"cost mccnn needs the package {_DISTRIBUTION}: {INSTALL_MCCNN}") from error
    if not found:
        raise SatIntervalsError(
            f"the installed {_DISTRIBUTION} has no {NETWORKS[weights]}: {INSTALL_MCCNN}, or set cost.weights"
        )
    return Path(str(found[0].locate())).resolve()
