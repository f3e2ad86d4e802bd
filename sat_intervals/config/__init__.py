"""Settings: defaults, ranges, one-line descriptions and derived thresholds."""

from sat_intervals.config.calibration import Calibration, load_calibration
from sat_intervals.config.costs import Census, Mccnn, Sweep, Volume
from sat_intervals.config.height_calibration import HeightCalibration, HeightClass, load_height_calibration, surface_key
from sat_intervals.config.interval import Interval
from sat_intervals.config.penalties import MccnnSgm, Sgm
from sat_intervals.config.presets import PRESETS, preset_text
from sat_intervals.config.reading import calibration_of, load_config, named_files, read_yaml, resolved, unreached
from sat_intervals.config.sections import Ambiguity, Cluster, ConfigError, Disparity, Regularization
from sat_intervals.config.settings import Config, key_of
from sat_intervals.config.wording import allowed

__all__ = [
    "PRESETS", "Ambiguity", "Calibration", "Census", "Cluster", "Config", "ConfigError", "Disparity",
    "HeightCalibration", "HeightClass", "Interval", "Mccnn", "MccnnSgm", "Regularization", "Sgm", "Sweep", "Volume",
    "allowed", "calibration_of", "key_of", "load_calibration", "load_config", "load_height_calibration", "named_files",
    "preset_text", "read_yaml", "resolved", "surface_key", "unreached",
]  # fmt: skip
