"""Settings: defaults, ranges, one-line descriptions and derived thresholds."""

from sat_intervals.config.penalties import CosineSgm, InverseSgm, MccnnSgm, NegativeSgm, Sgm
from sat_intervals.config.presets import PRESETS, preset_text
from sat_intervals.config.reading import load_config
from sat_intervals.config.sections import (
    Ambiguity,
    Census,
    Cluster,
    ConfigError,
    Disparity,
    Interval,
    Mccnn,
    Regularization,
)
from sat_intervals.config.settings import Config
from sat_intervals.config.wording import allowed

__all__ = [
    "PRESETS",
    "Ambiguity",
    "Census",
    "Cluster",
    "Config",
    "ConfigError",
    "CosineSgm",
    "Disparity",
    "Interval",
    "InverseSgm",
    "Mccnn",
    "MccnnSgm",
    "NegativeSgm",
    "Regularization",
    "Sgm",
    "allowed",
    "load_config",
    "preset_text",
]
