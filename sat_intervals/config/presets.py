"""Presets, and how settings are merged."""

from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

import yaml

from sat_intervals.config.sections import Section

# The first is the default: its settings are the defaults of all sections.
PRESETS = ("satellite", "satellite-mccnn", "paper", "mccnn", "many")


def preset_text(name: str = PRESETS[0]) -> str:
    """Return the YAML of a preset, complete and commented."""
    return (resources.files("sat_intervals.configs") / f"{name}.yaml").read_text(encoding="utf-8")


@cache
def preset_settings(name: str) -> Mapping[str, Any]:
    """Return the settings of a preset, without its search range."""
    values = yaml.safe_load(preset_text(name))
    return {key: value for key, value in values.items() if key != "disparity"}


def merged(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with overrides, which win key by key; what belongs to other costs or levels is left out."""
    kept = {name: dict(section) if isinstance(section, Mapping) else section for name, section in values.items()}
    overrides = {name: _given_keys(name, section) for name, section in overrides.items()}

    def given(settings: Mapping[str, Any], section: str) -> Mapping[str, Any]:
        found = settings.get(section)
        return found if isinstance(found, Mapping) else {}

    def is_other(section: str, kind: str) -> bool:
        one, other = (given(settings, section).get(kind) for settings in (kept, overrides))
        return None not in (one, other) and one != other

    if is_other("cost", "method"):
        kept = {name: section for name, section in kept.items() if name != "cost" and (name != "sgm" or not section)}
    penalties, interval = given(overrides, "sgm"), given(overrides, "interval")
    if is_other("sgm", "penalty"):
        del kept["sgm"]
    elif penalties.keys() - {"penalty"} and isinstance(kept.get("sgm"), dict):
        kept["sgm"].pop("span", None)  # it fits only the penalties that it was chosen with
    if isinstance(kept.get("interval"), dict):
        others = {"alpha": ("coverage", "calibration"), "coverage": ("alpha",)}
        for name in (name for level in others if interval.get(level) is not None for name in others[level]):
            kept["interval"].pop(name, None)
    for name, section in overrides.items():
        below = kept.get(name)
        kept[name] = below | dict(section) if isinstance(below, dict) and isinstance(section, Mapping) else section
    return kept


def _given_keys(name: str, section: Any) -> Any:
    """Return the keys that a section was made with, and its kind; other values as they are."""
    if not isinstance(section, Section):
        return section
    kind = {"cost": "method", "sgm": "penalty"}.get(name)
    return section.model_dump(exclude_unset=True) | ({kind: getattr(section, kind)} if kind else {})
