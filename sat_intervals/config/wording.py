"""Messages about invalid settings, built from the types and bounds of the settings."""

import difflib
import json
import reprlib
from collections.abc import Iterable
from decimal import Decimal
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from pydantic import AfterValidator
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from sat_intervals.config.sections import Section, check_odd
from sat_intervals.config.settings import Config


def allowed(field: FieldInfo) -> str:
    """Describe the allowed values of a setting from its type and bounds, such as ``integer >= 1, odd``."""
    nouns = {int: "integer", float: "number", Decimal: "number", bool: "true or false", str: "text"}
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<", "multiple_of": "multiple of"}
    kinds = get_args(field.annotation) or (field.annotation,)
    constraints = [*field.metadata, *(of_kind for kind in kinds for info in _bounds(kind) for of_kind in info.metadata)]
    kinds = tuple(get_args(kind)[0] if hasattr(kind, "__metadata__") else kind for kind in kinds)
    words = [str(word) for kind in kinds[1:] if get_origin(kind) is Literal for word in get_args(kind)]
    sections = _sections(field.annotation)
    kind = (
        f"section of {', '.join(sections[0].model_fields)}" if sections else nouns.get(kinds[0]) or " or ".join(kinds)
    )
    bounds = [
        f"{sign} {getattr(constraint, name)}"
        for constraint in constraints
        for name, sign in signs.items()
        if hasattr(constraint, name)
    ]
    if any(constraint == AfterValidator(check_odd) for constraint in field.metadata):
        bounds.append("odd")
    others = [f"or {word}" for word in (*words, *(["null"] if NoneType in kinds else []))]
    return " ".join(filter(None, [kind, ", ".join(bounds), *others]))


def _bounds(kind: Any) -> tuple[FieldInfo, ...]:
    """Return the bounds of one of several kinds, such as those of an integer that may also be a word."""
    return tuple(info for info in getattr(kind, "__metadata__", ()) if isinstance(info, FieldInfo))


def _sections(annotation: Any) -> list[type[Section]]:
    """Return the kinds of section that a field may hold."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [kind for part in get_args(annotation) for kind in _sections(part)]


def _name(kind: type[Section]) -> tuple[str, str]:
    """Return the discriminator of a kind of section, its first key, and the key's value."""
    key, field = next(iter(kind.model_fields.items()))
    return key, str(field.default)


def explained(problem: ErrorDetails) -> str:
    """Describe one problem of settings: the key, its value and the allowed values."""
    path = [str(key) for key in problem["loc"]]
    if path[:1] in (["tiles"], ["disparity"]):
        del path[2:]  # pydantic adds the kind
    while len(path) > 1 and path[-1].isdecimal():
        path.pop()  # an index into a list
    owner: type[Section] = Config
    if path and path[0] in Config.model_fields:
        field = Config.model_fields[path[0]]
        kinds = _sections(field.annotation)
        if problem["type"] == "union_tag_invalid":
            methods = " or ".join(dict.fromkeys(_name(kind)[1] for kind in kinds))
            return f"{path[0]}.{_name(kinds[0])[0]} is {shown(problem['ctx']['tag'])}, allowed: {methods}"
        if len(kinds) > 1 and len(path) > 1:
            tag = path.pop(1)  # pydantic adds the kind
            kinds = [kind for kind in kinds if tag == _name(kind)[1]]
        owner = kinds[0] if len(path) > 1 else Config
    where = ".".join(path)
    if problem["type"] == "value_error":
        return ": ".join(filter(None, [where, str(problem["ctx"]["error"])]))
    if problem["type"] in ("extra_forbidden", "invalid_key"):
        return f"unknown key {where!r}{known(path[-1], owner.model_fields)}"
    state = "missing" if problem["type"] == "missing" else shown(problem["input"])
    return f"{where} is {state}, allowed: {allowed(owner.model_fields[path[-1]])}"


def known(name: str, names: Iterable[str]) -> str:
    """Suggest the name that is closest, and list all names."""
    names = list(names)
    guess = "".join(f", did you mean {close}?" for close in difflib.get_close_matches(name, names, n=1))
    return f"{guess} (known: {', '.join(names)})"


def shown(value: Any) -> str:
    """Format a value as in YAML, shortened if it is long."""
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    return str(value) if isinstance(value, Decimal) else reprlib.repr(value)
