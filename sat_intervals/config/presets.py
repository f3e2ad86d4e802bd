"""Presets, and how they combine with the user's settings."""

from collections.abc import Mapping
from importlib import resources
from typing import Any

import yaml

# The first is the default: its settings are the defaults of all sections.
PRESETS = ("paper", "satellite", "satellite-mccnn", "urban", "mountain", "homogeneous", "mccnn")


def preset_text(name: str = PRESETS[0]) -> str:
    """Return the YAML of a preset, complete and commented."""
    return (resources.files("sat_intervals.configs") / f"{name}.yaml").read_text(encoding="utf-8")


def with_preset(values: Mapping[str, Any]) -> dict[str, Any]:
    """Complete settings with those of the preset that they name; explicit settings win, key by key.

    The preset's search range is never used. If the settings choose another matching cost, the preset's cost and
    penalties are dropped; with another kind of penalties, all but p1 and p2; with other penalties and no span, the
    span.
    """
    name = values.get("preset", PRESETS[0])
    if name == PRESETS[0] or name not in PRESETS:  # the defaults, or refused later
        return dict(values)
    preset = _settings(name)
    sgm, own = values.get("sgm"), preset["sgm"]
    if isinstance(sgm, Mapping):
        if sgm.get("penalty", own["penalty"]) != own["penalty"]:
            preset["sgm"] = {key: own[key] for key in ("p1", "p2")}
        elif sgm.keys() - {"penalty", "span"} and "span" not in sgm:
            own.pop("span", None)
    return merged(without_other_interval(without_other_cost(preset, values), values), values)


def _settings(name: Any) -> dict[str, Any]:
    """Return the settings of a preset without its search range; empty if the preset is unknown."""
    values = yaml.safe_load(preset_text(name)) if name in PRESETS else {}
    return {key: value for key, value in values.items() if key != "disparity"}


def without_other_cost(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the settings without cost and penalties if the overrides choose another matching cost."""

    def method(settings: Mapping[str, Any]) -> Any:
        cost = settings.get("cost")
        return cost.get("method") if isinstance(cost, Mapping) else getattr(cost, "method", None)

    chosen = method(overrides)
    if chosen is None:
        return values
    preset = overrides.get("preset") or values.get("preset")
    if chosen == (method(values) or method(_settings(preset)) or "census"):
        return values
    return {key: value for key, value in values.items() if key != "cost" and (key != "sgm" or value is None)}


def without_other_interval(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the settings without the level of their intervals if the overrides give one: alpha or coverage."""
    given, interval = overrides.get("interval"), values.get("interval")
    levels = ("alpha", "coverage")
    if not isinstance(interval, Mapping) or not isinstance(given, Mapping):
        return values
    if all(given.get(level) is None for level in levels):
        return values
    dropped = levels if given.get("coverage") is not None else (*levels, "calibration")
    return {**values, "interval": {key: value for key, value in interval.items() if key not in (*dropped, "bounds")}}


def merged(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return both mappings merged; the second wins, key by key."""
    both = dict(values)
    for key, value in overrides.items():
        below = both.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            value = merged(below, value)
        both[key] = value
    return both
