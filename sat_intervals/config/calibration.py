"""Calibrations: the levels of the cost curve that reach a coverage, and the settings that they belong to."""

import hashlib
import json
import os
from bisect import bisect_left
from collections.abc import Mapping
from functools import cache
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from pydantic import Field, ValidationError, field_validator

from sat_intervals.config.files import read_mapping
from sat_intervals.config.sections import ConfigError, StrictModel
from sat_intervals.products import IMPOSSIBLE_COST

# Coverages of a calibration; others are interpolated.
COVERAGES = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.975, 0.99)
MAKE_ONE = (
    "make one with sat-intervals calibrate (--calibration), of volumes with calibrate_volumes, or give "
    "interval.alpha 0.9 (--alpha 0.9)"
)
# Keys of settings that no calibration has.
SETTINGS = {"preset", "disparity", "cost", "sgm", "interval"}

_Model = TypeVar("_Model", bound=StrictModel)


class CalibrationFile(StrictModel):
    """A calibration of disparities or of heights."""

    @property
    def sha256(self) -> str:
        """Return the digest of the content, without provenance."""
        content = self.model_dump(mode="json", exclude={"provenance"})
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


class Levels(StrictModel):
    """Levels that intervals are cut at, and the quantile of their regularisation.

    ``high`` and ``low``, of pixels of high and low confidence, are the excess ``S(d) - min S`` of the aggregated cost,
    in the unit of the kernels' integer costs: the sum over the 8 paths of SGM (one cost without SGM), times the `steps`
    of the matching cost (1 for Census, 125 for MC-CNN). With least squares ``high`` and ``edge``, of high confidence
    on smooth ground and at edges, are factors instead, see `refinement.bounds_of_both`; else ``edge`` is None.
    ``quantile`` None leaves low-confidence segments as they are.
    ``reached`` is False if the pairs of the calibration did not reach the coverage at any level.
    """

    coverage: float | None
    high: float = Field(ge=0, le=IMPOSSIBLE_COST)
    edge: float | None = Field(None, ge=0, le=IMPOSSIBLE_COST)
    low: float = Field(ge=0, le=IMPOSSIBLE_COST)
    quantile: float | None = Field(ge=0.5, le=1)
    reached: bool = True


class Calibration(CalibrationFile):
    """Levels for each of COVERAGES, in this order, and the settings that they belong to, see `settings.key_of`.

    Levels do not fall as the coverage rises, except ``low`` where the quantile changes. Name and provenance are shown.
    """

    name: str
    key: dict[str, Any]
    levels: tuple[Levels, ...] = Field(strict=False)
    provenance: dict[str, Any] = Field(default_factory=dict)

    @field_validator("levels")
    @classmethod
    def _check_order(cls, rows: tuple[Levels, ...]) -> tuple[Levels, ...]:
        found = tuple(row.coverage for row in rows)
        if found != COVERAGES:
            words = [", ".join(map(str, order)) for order in (found, COVERAGES)]
            raise ValueError(f"coverages are {words[0]}, needed in this order: {words[1]}")
        for one, next_one in pairwise(rows):
            # low-confidence pixels may need a lower level with a higher quantile
            for name in ("high", "edge", "low") if one.quantile == next_one.quantile else ("high", "edge"):
                before, after = getattr(one, name), getattr(next_one, name)
                if before is not None and after is not None and after < before:
                    raise ValueError(
                        f"{name} falls from {before:g} at coverage {one.coverage:g} to {after:g} at "
                        f"{next_one.coverage:g}: a level may not fall"
                    )
        return rows


def load_calibration(source: "str | os.PathLike[str] | Mapping[str, Any] | Calibration") -> Calibration:
    """Read and check a calibration: the name of a built-in one, a YAML file, or its content."""
    if isinstance(source, Calibration):
        return source
    if isinstance(source, Mapping):
        return checked(Calibration, source, "calibration")
    if not isinstance(source, str | os.PathLike):
        raise ConfigError(f"calibration is {source!r}, allowed: a file, the name of a built-in one, or its content")
    file = _built_in_files().get(str(source), Path(source))
    try:
        values = read_mapping(file, f"keys {', '.join(Calibration.model_fields)}")
    except OSError as error:
        known = ", ".join(_built_in_files())
        raise ConfigError(f"calibration {file}: {error.strerror} (built in: {known}): {MAKE_ONE}") from error
    if "classes" in values:
        raise ConfigError(f"{file} is a calibration of heights: give it to dsm --calibration")
    if "levels" not in values and values.keys() & SETTINGS:
        raise ConfigError(f"{file} has settings, not a calibration: give it by --config")
    return checked(Calibration, values, str(file))


def checked(model: type[_Model], values: Mapping[str, Any], where: str) -> _Model:
    """Return the content of a file; raise `ConfigError` in one line that names the file and the first error."""
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        place = ".".join(map(str, problem["loc"]))
        why = str(problem["ctx"]["error"]) if problem["type"] == "value_error" else problem["msg"].lower()
        raise ConfigError(f"{where}: {place}: {why}") from error


def _built_in_files() -> dict[str, Path]:
    files = sorted(Path(str(file)) for file in (resources.files("sat_intervals.configs") / "calibrations").iterdir())
    return {file.stem: file for file in files if file.suffix == ".yaml"}


def built_in(key: Mapping[str, Any], preset: str) -> Calibration:
    """Return the built-in calibration of settings with this key; if there is none, the error names the nearest."""
    names = list(_built_in_files())
    for name in sorted(names, key=lambda name: name != preset):  # that of the preset first: reading takes 20 ms
        if (calibration := _built_in(name)).key == key:
            return calibration
    different_of = {name: differences(_built_in(name).key, key) for name in names}
    nearest = min(names, key=lambda name: len(different_of[name]))
    raise ConfigError(
        f"no built-in calibration belongs to these settings (that of {nearest} is the nearest: "
        f"{', '.join(different_of[nearest][:3])}): {MAKE_ONE}"
    )


@cache
def _built_in(name: str) -> Calibration:
    return load_calibration(name)


def differences(there: Mapping[str, Any], here: Mapping[str, Any], whose: str = "the settings") -> list[str]:
    """Return the differences of the key of a calibration and the key ``here``, which is that of ``whose``, in words."""
    one, other = _flat(there), _flat(here)
    found = []
    for name in {**other, **one}:
        if one.get(name) != other.get(name):
            words = ["null" if key.get(name) is None else key[name] for key in (one, other)]
            found.append(f"{name} is {words[0]} in the calibration and {words[1]} in {whose}")
    # a null or an empty section that the other lacks counts only if nothing else differs
    return found or [
        f"{name} is only in {'the calibration' if name in one else whose}" for name in one.keys() ^ other.keys()
    ]


def _flat(key: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in key.items():
        is_section = isinstance(value, Mapping) and value
        flat |= _flat(value, f"{prefix}{name}.") if is_section else {f"{prefix}{name}": value}
    return flat


def at(calibration: Calibration, coverage: float) -> Levels:
    """Return the levels of a coverage, linear between those of COVERAGES."""
    # Where the quantiles of both neighbours differ, low-confidence pixels take level and quantile of the larger one.
    if not COVERAGES[0] <= coverage <= COVERAGES[-1]:
        raise ConfigError(f"coverage is {coverage:g}, allowed: {COVERAGES[0]} to {COVERAGES[-1]}")
    above = bisect_left(COVERAGES, coverage)
    other = calibration.levels[above]
    if coverage == COVERAGES[above]:
        return other
    one = calibration.levels[above - 1]
    share = (coverage - COVERAGES[above - 1]) / (COVERAGES[above] - COVERAGES[above - 1])
    high, low = one.high + share * (other.high - one.high), one.low + share * (other.low - one.low)
    edge = None if one.edge is None or other.edge is None else one.edge + share * (other.edge - one.edge)
    low = low if one.quantile == other.quantile else other.low
    return other.model_copy(update={"coverage": coverage, "high": high, "edge": edge, "low": low})
