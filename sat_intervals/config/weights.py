"""Find the file of weights of MC-CNN."""

from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

from sat_intervals.errors import SatIntervalsError

# The distribution of the official weights, and the file in it that Pandora uses.
_DISTRIBUTION, _OFFICIAL = "MCCNN", "mc_cnn_fast_int8_excl_01.onnx"
INSTALL_MCCNN = "pip install 'sat-intervals[mccnn]'"
# Largest file of weights in bytes; the official one has 0.4 MB.
_LARGEST = 256 * 10**6


def weights_file(weights: str | None) -> Path:
    """Find the file of a network: the given one, or the official one without an import of its package."""
    if weights is not None:
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
        raise SatIntervalsError(f"cost mccnn needs the package {_DISTRIBUTION}: {INSTALL_MCCNN}") from error
    if not found:
        raise SatIntervalsError(
            f"the installed {_DISTRIBUTION} has no {_OFFICIAL}: {INSTALL_MCCNN}, or set cost.weights"
        )
    return Path(str(found[0].locate())).resolve()
