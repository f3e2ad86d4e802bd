"""Dense stereo matching of epipolar satellite images with confidence intervals on the disparity.

The public names are loaded on first use, so that ``import sat_intervals`` and ``sat-intervals --help`` wait
for neither numba nor dask.
"""

import logging
from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sat_intervals.config import Config, load_config
    from sat_intervals.errors import RunError, SatIntervalsError
    from sat_intervals.match.in_memory import match_arrays
    from sat_intervals.raster import open_image
    from sat_intervals.run.pair import match_pair
    from sat_intervals.tiling import Window

    __version__: str

__all__ = [
    "Config",
    "RunError",
    "SatIntervalsError",
    "Window",
    "__version__",
    "load_config",
    "match_arrays",
    "match_pair",
    "open_image",
]

logging.getLogger(__name__).addHandler(logging.NullHandler())  # who uses the library says where its words go

_HOMES = {
    "Config": "config",
    "RunError": "errors",
    "SatIntervalsError": "errors",
    "Window": "tiling",
    "load_config": "config",
    "match_arrays": "match.in_memory",
    "match_pair": "run.pair",
    "open_image": "raster",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return version("sat-intervals")
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
