"""Calibrations: the levels of the cost curve that reach a coverage, and the settings that they belong to."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from sat_intervals.config.files import read_mapping
from sat_intervals.config.sections import ConfigError
from sat_intervals.config.weights import weights_file
from sat_intervals.products import IMPOSSIBLE_COST

if TYPE_CHECKING:
    from sat_intervals.config.settings import Config

# Coverages of a calibration; others are interpolated.
COVERAGES = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.975, 0.99)
_MAKE_ONE = "make one with sat-intervals calibrate and give it by --calibration"


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Levels(_Model):
    """The three numbers of one coverage.

    ``high`` and ``low`` are the levels of pixels of high and low confidence: excess ``S(d) - min S`` of the aggregated
    cost, real numbers in the unit of the kernels' integer costs. That is the sum over the 8 paths of SGM (one cost
    without SGM), times the `steps` of the matching cost: 1 for Census, 125 for MC-CNN. ``quantile`` is that of the
    regularisation of low-confidence segments; None leaves them as they are.
    """

    coverage: float
    high: float = Field(ge=0, le=IMPOSSIBLE_COST)
    low: float = Field(ge=0, le=IMPOSSIBLE_COST)
    quantile: float | None = Field(ge=0.5, le=1)


class Cuts(NamedTuple):
    """What a run takes from a calibration, in the units of `Levels`."""

    high: float
    low: float
    quantile: float | None


class Calibration(_Model):
    """Levels for each of COVERAGES, and what they belong to.

    Attributes
    ----------
    name
        For people.
    key
        All settings that the levels belong to, see `key_of`.
    levels
        One row for each coverage, in this order. Levels do not fall as the coverage rises, except ``low`` where the
        quantile changes.
    provenance
        Scenes, date, version, figures to expect: for people.
    """

    name: str
    key: dict[str, Any]
    levels: tuple[Levels, ...] = Field(strict=False)
    provenance: dict[str, Any] = {}

    @field_validator("levels")
    @classmethod
    def _check_order(cls, rows: tuple[Levels, ...]) -> tuple[Levels, ...]:
        found = tuple(row.coverage for row in rows)
        if found != COVERAGES:
            words = [", ".join(f"{coverage:g}" for coverage in order) for order in (found, COVERAGES)]
            raise ValueError(f"coverages are {words[0]}, needed in this order: {words[1]}")
        for one, next_one in pairwise(rows):
            # low-confidence pixels may need a lower level with a higher quantile
            for name in ("high", "low") if one.quantile == next_one.quantile else ("high",):
                before, after = getattr(one, name), getattr(next_one, name)
                if after < before:
                    raise ValueError(
                        f"{name} falls from {before:g} at coverage {one.coverage:g} to {after:g} at "
                        f"{next_one.coverage:g}: a level may not fall"
                    )
        return rows

    @property
    def sha256(self) -> str:
        """Return the digest of the content, without provenance."""
        content = self.model_dump(mode="json", exclude={"provenance"})
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def load_calibration(source: "str | os.PathLike[str] | Mapping[str, Any] | Calibration") -> Calibration:
    """Read and check a calibration: the name of a built-in one, a YAML file, or its content.

    Raises
    ------
    ConfigError
        Names the file and the first error, in one line.
    """
    if isinstance(source, Calibration):
        return source
    if isinstance(source, Mapping):
        return _checked(source, "calibration")
    if not isinstance(source, str | os.PathLike):
        raise ConfigError(f"calibration is {source!r}, allowed: a file, the name of a built-in one, or its content")
    file = dict(_built_in_files()).get(str(source), Path(source))
    try:
        values = read_mapping(file, f"keys {', '.join(Calibration.model_fields)}")
    except OSError as error:
        known = ", ".join(name for name, _ in _built_in_files()) or "none"
        raise ConfigError(f"calibration {file}: {error.strerror} (built in: {known}): {_MAKE_ONE}") from error
    return _checked(values, str(file))


def _checked(values: Mapping[str, Any], where: str) -> Calibration:
    try:
        return Calibration.model_validate(dict(values))
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        place = ".".join(map(str, problem["loc"]))
        why = str(problem["ctx"]["error"]) if problem["type"] == "value_error" else problem["msg"].lower()
        raise ConfigError(f"{where}: {place}: {why}") from error


def _built_in_files() -> Iterator[tuple[str, Path]]:
    folder = resources.files("sat_intervals.configs") / "calibrations"
    if folder.is_dir():
        for file in sorted(folder.iterdir(), key=lambda file: file.name):
            if file.name.endswith(".yaml"):
                yield file.name.removesuffix(".yaml"), Path(str(file))


def key_of(config: "Config") -> dict[str, Any]:
    """Return all settings that decide which coverage a level reaches, as a calibration holds them.

    Neither the search range nor alpha nor the quantile of the regularisation is among them.
    """
    cost = config.cost.model_dump(mode="json")
    if "weights" in cost:
        with weights_file(cost["weights"]).open("rb") as weights:
            cost["weights"] = hashlib.file_digest(weights, "sha256").hexdigest()
    ambiguity, low = config.ambiguity, config.regularization

    def content(section: Any) -> Any:
        return section and section.model_dump(mode="json")

    return {
        "cost": cost,
        "sgm": content(config.sgm),
        "span": config.cost_span,
        "ambiguity": ambiguity and ambiguity.model_dump(mode="json", include={"eta_max", "eta_step", "normalization"}),
        "refinement": content(config.refinement),
        "cross_check": content(config.cross_check),
        "median": content(config.median),
        "confidence": low and low.model_dump(mode="json", include={"threshold", "kernel", "depth"}),
    }


def calibration_of(config: "Config") -> Calibration:
    """Return the calibration of the settings: the one that they give, else the built-in one with their key.

    Raises
    ------
    ConfigError
        The one given belongs to other settings, or no built-in one to these.
    """
    assert config.interval is not None
    given, key = config.interval.calibration, key_of(config)
    if isinstance(given, Calibration):
        if given.key != key:
            raise ConfigError(
                f"calibration {given.name} belongs to other settings, {_difference(given.key, key)}: {_MAKE_ONE}"
            )
        return given
    built_in = [load_calibration(file) for _, file in _built_in_files()]
    for calibration in built_in:
        if calibration.key == key:
            return calibration
    known = ", ".join(calibration.name for calibration in built_in) or "none"
    raise ConfigError(f"no built-in calibration (known: {known}) belongs to these settings: {_MAKE_ONE}")


def _difference(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """Return the first difference of two keys in words."""
    one, other = _flat(there), _flat(here)
    for name in {**other, **one}:
        if one.get(name) != other.get(name):
            words = ["null" if key.get(name) is None else key[name] for key in (one, other)]
            return f"{name} is {words[0]} there and {words[1]} here"
    name = min(one.keys() ^ other.keys())  # a null that the other lacks
    return f"{name} is only {'there' if name in one else 'here'}"


def _flat(key: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in key.items():
        is_section = isinstance(value, Mapping) and value
        flat |= _flat(value, f"{prefix}{name}.") if is_section else {f"{prefix}{name}": value}
    return flat


def resolved(config: "Config") -> "Config":
    """Return the settings with the content of their calibration, which decides the bytes of a run.

    Raises
    ------
    ConfigError
        See `calibration_of`.
    """
    if config.interval is None or config.interval.coverage is None:
        return config
    interval = config.interval.model_copy(update={"calibration": calibration_of(config)})
    return config.model_copy(update={"interval": interval})


def at(calibration: Calibration, coverage: float) -> Cuts:
    """Return the levels and the quantile of a coverage, linear between those of COVERAGES.

    Where only one neighbour has a quantile, low-confidence pixels take level and quantile of the larger coverage.
    """
    if not COVERAGES[0] <= coverage <= COVERAGES[-1]:
        raise ConfigError(f"coverage is {coverage:g}, allowed: {COVERAGES[0]} to {COVERAGES[-1]}")
    one, other = next(rows for rows in pairwise(calibration.levels) if coverage <= rows[1].coverage)
    share = (coverage - one.coverage) / (other.coverage - one.coverage)

    def between(below: float, above: float) -> float:
        return below + share * (above - below) if share < 1 else above

    if share == 0:
        return Cuts(one.high, one.low, one.quantile)
    high = between(one.high, other.high)
    if one.quantile is None or other.quantile is None:
        low = between(one.low, other.low) if one.quantile == other.quantile else other.low
        return Cuts(high, low, other.quantile)
    return Cuts(high, between(one.low, other.low), between(one.quantile, other.quantile))
