"""Reading of small YAML files: settings, lists of pairs, calibrations."""

import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from sat_intervals.config.sections import ConfigError
from sat_intervals.errors import SatIntervalsError

# Largest size in bytes of a file of settings or pairs, and of a CSV file of pairs; YAML nodes of a file of settings,
# aliases expanded.
_LARGEST_FILE, LARGEST_TABLE, _NODES = 10**6, 10**7, 10_000


class _Loader(yaml.SafeLoader):
    """Safe YAML loader that refuses duplicate keys and more than a given number of nodes.

    Plain YAML silently keeps the last of two keys, and a few lines of nested aliases or merge keys can fill the memory.
    """

    def __init__(self, text: str | bytes, most: int) -> None:
        super().__init__(text)
        self._most, self._nodes = most, 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        before, event = self._nodes, self.peek_event()  # type: ignore[no-untyped-call]
        node = super().compose_node(parent, index)
        self._nodes += self._sizes.get(id(node), 1) if isinstance(event, yaml.AliasEvent) else 1
        if self._nodes > self._most:
            problem = f"more than {self._most} values, aliases expanded: give fewer"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
        self._sizes.setdefault(id(node), self._nodes - before)
        return node

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


def load_yaml(text: str | bytes, most: int = _NODES) -> Any:
    """Parse YAML; duplicate keys and more than ``most`` nodes are errors."""
    loader = _Loader(text, most)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


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


def read_small(file: Path, most: int = _LARGEST_FILE) -> bytes:
    """Read a file of settings or pairs of at most ``most`` bytes."""
    with file.open("rb") as stream:
        content = stream.read(most + 1)
    if len(content) > most:
        raise SatIntervalsError(f"{file} has more than {most // 10**6} MB: is it the right file?")
    return content


def read_mapping(file: Path, holds: str) -> Mapping[str, Any]:
    """Read a YAML file that holds a mapping, ``holds`` in words; an empty file is an empty one."""
    try:
        values = load_yaml(read_small(file))
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ConfigError(f"{file}: {line}{error.problem}") from error
    except (OSError, SatIntervalsError):
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: {' '.join(str(error).split())}") from error
    if not isinstance(values, Mapping | None):
        raise ConfigError(f"{file}: holds {reprlib.repr(values)}, allowed: {holds}")
    return values or {}
