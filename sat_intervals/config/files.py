"""Reading of small YAML files: settings, lists of pairs, calibrations."""

import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from sat_intervals.config.sections import ConfigError


class _Loader(yaml.SafeLoader):
    """Safe YAML loader that refuses duplicate keys, of which plain YAML silently keeps the last."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                raise yaml.MarkedYAMLError(problem=f"key {key.value!r} appears twice", problem_mark=key.start_mark)
            seen.add(key.value)
        return node


def load_yaml(text: str | bytes) -> Any:
    """Parse YAML; duplicate keys are errors."""
    return yaml.load(text, _Loader)


def set_by_name(settings: dict[str, Any], key: str, value: Any) -> None:
    """Set a setting by its dotted name, such as ``tiles.size``."""
    *sections, last = key.split(".")
    for section in sections:
        settings = settings.setdefault(section, {})
        if not isinstance(settings, dict):
            raise ValueError(f"{section} is also given as a whole")
    if last in settings:
        raise ValueError(f"parts of {last} are also given" if isinstance(settings[last], dict) else "given twice")
    settings[last] = value


def read_mapping(file: Path, holds: str) -> Mapping[str, Any]:
    """Read a YAML file that holds a mapping, ``holds`` in words; an empty file is an empty one."""
    try:
        values = load_yaml(file.read_bytes())
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ConfigError(f"{file}: {line}{error.problem}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: {' '.join(str(error).split())}") from error
    if not isinstance(values, Mapping | None):
        raise ConfigError(f"{file}: holds {reprlib.repr(values)}, allowed: {holds}")
    return values or {}
