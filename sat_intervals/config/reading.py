"""Read settings from YAML files, mappings and the command line."""

import logging
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from sat_intervals.config.presets import PRESETS, merged, without_other_cost
from sat_intervals.config.sections import ConfigError
from sat_intervals.config.settings import Config
from sat_intervals.config.wording import explained, shown
from sat_intervals.errors import SatIntervalsError, check_regular

# Largest size in bytes of a file of settings or pairs, and of a CSV file of pairs; YAML nodes of a file of settings,
# aliases expanded.
_LARGEST_FILE, LARGEST_TABLE, _NODES = 10**6, 10**7, 10_000

_LOG = logging.getLogger(__name__)


def load_config(
    source: str | Path | Mapping[str, Any] | Config | None = None,
    overrides: Mapping[str, Any] | None = None,
    *,
    preset_wins: bool = False,
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

    Raises
    ------
    ConfigError
        Lists all errors in one line.
    """
    overrides = overrides or {}
    values: Mapping[str, Any] = {}
    file = ""
    match source:
        case None:
            pass
        case str() | Path():
            values, file = _read_yaml(Path(source)), f"{source}: "
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
        raise ConfigError(f"{file}preset is {shown(names[0])}, and {shown(names[1])} is asked for: leave one out")
    settings = merged(without_other_cost(values, overrides), overrides)
    try:
        config = Config.model_validate(settings)
    except ValidationError as error:
        problems = error.errors(include_url=False)
        if all(_given(overrides, problem["loc"]) for problem in problems):
            file = ""  # the errors are in the overrides
        raise ConfigError(file + "; ".join(dict.fromkeys(map(explained, problems)))) from error
    if "sgm" not in settings and (better := f"{config.preset}-{config.cost.method}") in PRESETS:
        _warn(
            f"preset {config.preset} has no penalties for cost.method {config.cost.method}, so defaults are used: "
            f"--preset {better} has penalties for such images"
        )
    return config


@lru_cache  # once per batch
def _warn(line: str) -> None:
    _LOG.warning(line)


def _given(overrides: Any, path: tuple[int | str, ...]) -> bool:
    for key in path:
        if not isinstance(overrides, Mapping) or key not in overrides:
            return False
        overrides = overrides[key]
    return bool(path)  # an error without a path concerns several sections


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
    """Parse YAML; duplicate keys and more than ``most`` nodes are errors.

    Raises
    ------
    yaml.YAMLError, ValueError, RecursionError
        The text is not valid YAML.
    """
    loader = _Loader(text, most)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def read_small(file: Path, most: int = _LARGEST_FILE) -> bytes:
    """Read a file of settings or pairs of at most ``most`` bytes.

    Raises
    ------
    OSError
        The file cannot be read.
    SatIntervalsError
        The file is larger, or not a regular file.
    """
    check_regular(file)
    with file.open("rb") as stream:
        content = stream.read(most + 1)
    if len(content) > most:
        raise SatIntervalsError(f"{file} has more than {most // 10**6} MB: is it the right file?")
    return content


def _read_yaml(file: Path) -> Mapping[str, Any]:
    try:
        values = load_yaml(read_small(file))
    except OSError as error:
        preset = isinstance(error, FileNotFoundError) and file.suffix == ".yaml" and file.stem in PRESETS
        hint = f" (give --preset {file.stem} for the preset of the package)" if preset else ""
        raise ConfigError(f"{file}: {error.strerror}{hint}") from error
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ConfigError(f"{file}: {line}{error.problem}") from error
    except SatIntervalsError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: {' '.join(str(error).split())}") from error
    if values is None:
        return {}
    if not isinstance(values, Mapping):
        raise ConfigError(f"{file}: holds {shown(values)}, allowed: sections {', '.join(Config.model_fields)}")
    return values
