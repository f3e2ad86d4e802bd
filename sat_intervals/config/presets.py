"""Settings that come with the package under a name, and what is given beside them."""

from collections.abc import Mapping
from importlib import resources
from typing import Any

import yaml

# The default, whose settings are the defaults of all sections, first.
PRESETS = ("paper", "satellite", "satellite-mccnn", "urban", "mountain", "homogeneous", "mccnn")


def preset_text(name: str = PRESETS[0]) -> str:
    """Return the file of a preset: complete, commented YAML."""
    return (resources.files("sat_intervals.configs") / f"{name}.yaml").read_text(encoding="utf-8")


def with_preset(values: Mapping[str, Any]) -> dict[str, Any]:
    """Complete settings with those of the preset that they name; what is given beside it wins, key by key.

    The search range is never that of a preset. Where another matching cost is given, cost and penalties of the preset
    do not fit and are left out; where another kind of penalties is given, all but p1 and p2; where other penalties are
    given without their span, the span.
    """
    name = values.get("preset", PRESETS[0])
    if name == PRESETS[0] or name not in PRESETS:  # the defaults; or to be refused
        return dict(values)
    preset = _settings(name)
    sgm, own = values.get("sgm"), preset["sgm"]
    if isinstance(sgm, Mapping):
        if sgm.get("penalty", own["penalty"]) != own["penalty"]:
            preset["sgm"] = {key: own[key] for key in ("p1", "p2")}
        elif sgm.keys() - {"penalty", "span"} and "span" not in sgm:
            own.pop("span", None)
    return merged(without_other_cost(preset, values), values)


def _settings(name: Any) -> dict[str, Any]:
    """What a preset sets, without its search range; nothing for an unknown one."""
    values = yaml.safe_load(preset_text(name)) if name in PRESETS else {}
    return {key: value for key, value in values.items() if key != "disparity"}


def without_other_cost(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> Mapping[str, Any]:
    """The settings without cost and penalties where the overrides choose another method, whose keys are others."""

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


def merged(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Both, the second winning key by key."""
    both = dict(values)
    for key, value in overrides.items():
        below = both.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            value = merged(below, value)
        both[key] = value
    return both
