"""Dense stereo matching of satellite images with confidence intervals on the disparity.

Public names are imported on first use, so ``import sat_intervals`` and ``sat-intervals --help`` load neither numba nor
dask.
"""

import importlib.metadata
import logging
import typing

if typing.TYPE_CHECKING:
    from sat_intervals.config import Config, load_config, load_height_calibration
    from sat_intervals.errors import RunError, SatIntervalsError
    from sat_intervals.evaluate.disparity import evaluate_run
    from sat_intervals.evaluate.surface_accuracy import evaluate_surface
    from sat_intervals.evaluate.surface_calibration import calibrate_surface
    from sat_intervals.heights.choices import SurfaceChoices
    from sat_intervals.heights.geometry import set_geometry
    from sat_intervals.heights.triangulate import triangulate
    from sat_intervals.interop.dataset import decode_flags, open, open_surface
    from sat_intervals.match.calibrate_volumes import calibrate_volumes
    from sat_intervals.match.volumes import intervals_of
    from sat_intervals.prepare.in_memory import intervals_around, match_arrays
    from sat_intervals.raster import open_image
    from sat_intervals.run.pair import match_pair
    from sat_intervals.tiling import Window
    from sat_intervals.workflows.calibrate import calibrate
    from sat_intervals.workflows.change import change
    from sat_intervals.workflows.dsm import make_surface
    from sat_intervals.workflows.rectify import rectify
    from sat_intervals.workflows.surface import surface

    __version__: str

__all__ = [
    "Config", "RunError", "SatIntervalsError", "SurfaceChoices", "Window", "__version__", "calibrate",
    "calibrate_surface", "calibrate_volumes", "change", "decode_flags", "evaluate_run", "evaluate_surface",
    "intervals_around", "intervals_of", "load_config", "load_height_calibration", "make_surface", "match_arrays",
    "match_pair", "open", "open_image", "open_surface", "rectify", "set_geometry", "surface", "triangulate",
]  # fmt: skip

logging.getLogger(__name__).addHandler(logging.NullHandler())  # the application configures logging

_HOMES = {
    "Config": "config",
    "RunError": "errors",
    "SatIntervalsError": "errors",
    "SurfaceChoices": "heights.choices",
    "Window": "tiling",
    "calibrate": "workflows.calibrate",
    "calibrate_surface": "evaluate.surface_calibration",
    "calibrate_volumes": "match.calibrate_volumes",
    "change": "workflows.change",
    "decode_flags": "interop.dataset",
    "evaluate_run": "evaluate.disparity",
    "evaluate_surface": "evaluate.surface_accuracy",
    "intervals_around": "prepare.in_memory",
    "intervals_of": "match.volumes",
    "load_config": "config",
    "load_height_calibration": "config",
    "make_surface": "workflows.dsm",
    "match_arrays": "prepare.in_memory",
    "match_pair": "run.pair",
    "open": "interop.dataset",
    "open_image": "raster",
    "open_surface": "interop.dataset",
    "rectify": "workflows.rectify",
    "set_geometry": "heights.geometry",
    "surface": "workflows.surface",
    "triangulate": "heights.triangulate",
}


def __getattr__(name: str) -> typing.Any:
    if name == "__version__":
        return importlib.metadata.version("sat-intervals")
    if name in _HOMES:
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
