"""What a user may set: its default, its range, its one-line meaning, and the thresholds that follow."""

from sat_intervals.config.penalties import CosineSgm, InverseSgm, MccnnSgm, NegativeSgm, Sgm
from sat_intervals.config.presets import PRESETS, preset_text
from sat_intervals.config.reading import LARGEST_TABLE, load_config, load_yaml, read_small
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
    "LARGEST_TABLE",
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
    "load_yaml",
    "preset_text",
    "read_small",
]
