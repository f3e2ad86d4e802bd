"""Read settings from YAML files, mappings and the command line; find the calibration that belongs to them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sat_intervals.config.calibration import MAKE_ONE, Calibration, built_in, differences
from sat_intervals.config.costs import NETWORKS
from sat_intervals.config.files import read_mapping
from sat_intervals.config.presets import PRESETS, merged, preset_settings
from sat_intervals.config.sections import ConfigError
from sat_intervals.config.settings import Config, key_of
from sat_intervals.config.wording import explained, shown

# Settings that name a file.
_FILES = ("cost", "weights"), ("interval", "calibration"), ("disparity", "grid"), ("disparity", "around")


def load_config(
    source: str | Path | Mapping[str, Any] | Config | None = None,
    overrides: Mapping[str, Any] | None = None,
    *,
    preset_wins: bool = False,
    file: Path | None = None,
    images: int = 2,
) -> Config:
    """Check settings and complete them with the defaults.

    Parameters
    ----------
    source
        A YAML file, a mapping of sections, or a checked Config; None for the defaults. ``preset`` names the settings
        that fill in missing keys.
    overrides
        Sections and keys that win over ``source``, such as those of the command line.
    preset_wins
        Whether the overrides' ``preset`` wins too; otherwise two different presets are refused.
    file
        Named by errors, of a mapping that was read from it.
    images
        Their number: of three and more the preset is ``many``, if none is given.

    Raises
    ------
    ConfigError
        Lists all errors in one line.
    """
    if isinstance(source, Config) and not overrides:
        return source
    overrides = overrides or {}
    place = f"{source}: " if isinstance(source, str | Path) else f"{file}: " if file else ""
    values = _values(source)
    names = [settings["preset"] for settings in (values, overrides) if settings.get("preset") is not None]
    if isinstance(source, Config) and len(set(names)) > 1:
        raise ConfigError(
            f"preset {shown(overrides['preset'])} has no effect on a Config, which is complete: give it with the "
            "settings that the Config is made from"
        )
    if len(set(map(str, names))) > 1 and not preset_wins:
        raise ConfigError(f"{place}preset is {shown(names[0])}, and {shown(names[1])} is asked for: leave one out")
    preset = names[-1] if names else "many" if images > 2 else PRESETS[0]
    # Before the overrides: those of another cost drop what the source has for the cost of its preset.
    values = merged(preset_settings(preset) if preset in PRESETS else {}, values)
    try:
        return Config.model_validate(merged(values, overrides))
    except ValidationError as error:
        problems = error.errors(include_url=False)
        if all(_given(overrides, problem["loc"]) for problem in problems):
            place = ""  # the errors are in the overrides
        raise ConfigError(place + "; ".join(dict.fromkeys(map(explained, problems)))) from error


def _values(source: Any) -> Mapping[str, Any]:
    """Return the sections of a source of settings."""
    match source:
        case None:
            return {}
        case str() | Path():
            return read_yaml(Path(source))
        case Config():
            return source.model_dump()
        case Mapping():
            return source
    raise ConfigError(f"settings are {shown(source)}, allowed: a YAML file, a mapping or a Config")


def named_files(settings: Mapping[str, Any] | Config | None) -> list[str]:
    """Return the files that sections name, which are read with them or later; a built-in name has no file."""
    sections = settings.model_dump() if isinstance(settings, Config) else settings or {}
    named = [sections[name].get(key) for name, key in _FILES if isinstance(sections.get(name), Mapping)]
    return [file for file in named if isinstance(file, str) and file not in NETWORKS]


def _given(overrides: Any, path: tuple[int | str, ...]) -> bool:
    for key in path:
        if not isinstance(overrides, Mapping) or key not in overrides:
            return False
        overrides = overrides[key]
    return bool(path)  # an error without a path concerns several sections


def read_yaml(file: Path) -> Mapping[str, Any]:
    """Read the sections of a file of settings, which `load_config` checks."""
    try:
        values = read_mapping(file, f"sections {', '.join(Config.model_fields)}")
    except OSError as error:
        preset = isinstance(error, FileNotFoundError) and file.suffix == ".yaml" and file.stem in PRESETS
        hint = f" (give --preset {file.stem} for the preset of the package)" if preset else ""
        raise ConfigError(f"{file}: {error.strerror}{hint}") from error
    if not values:
        raise ConfigError(f"{file} has no settings, or was cut off: restore it, or leave it out for the defaults")
    if {"key", "levels"} <= values.keys():
        raise ConfigError(f"{file} is a calibration: give it by --calibration, with --coverage")
    return values


def calibration_of(config: Config) -> Calibration:
    """Return the calibration of the settings: the one that they give, else the built-in one with their key."""
    assert config.interval is not None
    given, key = config.interval.calibration, key_of(config)
    if not isinstance(given, Calibration):
        return built_in(key, config.preset)
    if different := differences(given.key, key):
        raise ConfigError(f"calibration {given.name} belongs to other settings, {different[0]}: {MAKE_ONE}")
    if config.fits and None in (levels.edge for levels in given.levels):
        raise ConfigError(f"calibration {given.name} has no factors for edges, an older version made it: {MAKE_ONE}")
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
