"""Settings together with the calibration that belongs to them."""

from sat_intervals.config.calibration import MAKE_ONE, Calibration, built_in, differences
from sat_intervals.config.sections import ConfigError
from sat_intervals.config.settings import Config, key_of


def calibration_of(config: Config) -> Calibration:
    """Return the calibration of the settings: the one that they give, else the built-in one with their key."""
    assert config.interval is not None
    given, key = config.interval.calibration, key_of(config)
    if not isinstance(given, Calibration):
        return built_in(key, config.preset)
    if different := differences(given.key, key):
        raise ConfigError(f"calibration {given.name} belongs to other settings, {different[0]}: {MAKE_ONE}")
    return given


def resolved(config: Config) -> Config:
    """Return the settings with the content of their calibration, which decides the bytes of a run."""
    if config.interval is None or config.interval.coverage is None:
        return config
    interval = config.interval.model_copy(update={"calibration": calibration_of(config)})
    return config.model_copy(update={"interval": interval})


def unreached(config: Config) -> str:
    """Return a warning if the calibration does not reach the coverage asked for; else, and with alpha, ``""``."""
    levels = config.cuts
    if levels is None or levels.reached:
        return ""
    return (
        f"the pairs of calibration {calibration_of(config).name} do not reach coverage {levels.coverage:g} at any "
        "level: expect less, or ask for less"
    )
