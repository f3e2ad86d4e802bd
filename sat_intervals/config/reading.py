"""Read settings from YAML files, mappings and the command line."""

import logging
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sat_intervals.config.files import read_mapping
from sat_intervals.config.presets import PRESETS, merged, without_other_cost, without_other_interval
from sat_intervals.config.sections import ConfigError
from sat_intervals.config.settings import Config
from sat_intervals.config.wording import explained, shown

_LOG = logging.getLogger(__name__)
# Settings that name a file.
_FILES = ("cost", "weights"), ("interval", "calibration"), ("disparity", "grid")


def load_config(
    source: str | Path | Mapping[str, Any] | Config | None = None,
    overrides: Mapping[str, Any] | None = None,
    *,
    preset_wins: bool = False,
    file: Path | None = None,
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

    Raises
    ------
    ConfigError
        Lists all errors in one line.
    """
    overrides = overrides or {}
    values: Mapping[str, Any] = {}
    place = f"{file}: " if file else ""
    match source:
        case None:
            pass
        case str() | Path():
            values, place = read_yaml(Path(source)), f"{source}: "
        case Config():
            values = source.model_dump()
            if overrides.get("preset") not in (None, source.preset):
                raise ConfigError(
                    f"preset {shown(overrides['preset'])} has no effect on a Config, which is complete: give it with "
                    "the settings that the Config is made from"
                )
        case Mapping():
            values = source
        case _:
            raise ConfigError(f"settings are {shown(source)}, allowed: a YAML file, a mapping or a Config")
    names = [settings["preset"] for settings in (values, overrides) if settings.get("preset") is not None]
    if len(set(map(str, names))) > 1 and not preset_wins:
        raise ConfigError(f"{place}preset is {shown(names[0])}, and {shown(names[1])} is asked for: leave one out")
    settings = merged(without_other_interval(without_other_cost(values, overrides), overrides), overrides)
    try:
        config = Config.model_validate(settings)
    except ValidationError as error:
        problems = error.errors(include_url=False)
        if all(_given(overrides, problem["loc"]) for problem in problems):
            place = ""  # the errors are in the overrides
        raise ConfigError(place + "; ".join(dict.fromkeys(map(explained, problems)))) from error
    if "sgm" not in settings and (better := f"{config.preset}-{config.cost.method}") in PRESETS:
        _warn(
            f"preset {config.preset} has no penalties for cost.method {config.cost.method}, so defaults are used: "
            f"--preset {better} has penalties for such images"
        )
    return config


def named_files(settings: Mapping[str, Any] | Config | None) -> list[str]:
    """Return the files that sections name, which are read with them or later; a built-in name has no file."""
    sections = settings.model_dump() if isinstance(settings, Config) else settings or {}
    named = [sections[name].get(key) for name, key in _FILES if isinstance(sections.get(name), Mapping)]
    return [file for file in named if isinstance(file, str)]


@lru_cache  # once per batch
def _warn(line: str) -> None:
    _LOG.warning(line)


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
