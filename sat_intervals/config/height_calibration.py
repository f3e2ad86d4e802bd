"""Calibrations of heights: metres that widen or narrow the intervals of a surface model, and what they belong to."""

import os
from collections.abc import Mapping
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from sat_intervals.config.calibration import SETTINGS, CalibrationFile, checked, differences
from sat_intervals.config.files import read_mapping
from sat_intervals.config.sections import ConfigError, StrictModel

_MAKE_ONE = "make one with sat-intervals calibrate --dsm"
# Tags of a surface that its intervals depend on.
_OF_INTERVALS = (
    "COVERAGE", "ALPHA", "DISPARITY_CALIBRATION", "INTERVAL", "IMAGES",
    "ALIGNED", "RADIUS", "OUTLIERS", "OPEN_POINTS", "MIN_CONFIDENCE",
)  # fmt: skip
_LARGEST = 10_000.0  # metres


class HeightClass(StrictModel):
    """Cells whose heights differ around them, and whose half widths are, by less than limits (metres, None: others).

    Their bounds move outwards by ``margin`` metres, which was found from so many ``cells``.
    """

    relief_below: float | None = Field(gt=0)
    half_width_below: float | None = Field(gt=0)
    margin: float = Field(ge=-_LARGEST, le=_LARGEST)
    cells: int = Field(ge=1)


class HeightCalibration(CalibrationFile):
    """Margins of the intervals of a surface model, by class of relief, and in each of half width, rising.

    Half widths are multiplied by ``factor`` first.

    ``coverage`` is the share of true heights inside. If the reference was ``registered`` to the surface, the margins do
    not include a constant shift. ``surface`` says what surfaces they belong to, see `surface_key`.
    """

    version: Literal[2] = 2
    name: str
    coverage: float = Field(gt=0, lt=1)
    registered: bool
    surface: dict[str, str]
    factor: float = Field(default=1.0, ge=0)
    classes: tuple[HeightClass, ...] = Field(strict=False, min_length=1)
    provenance: dict[str, Any] = Field(default_factory=dict)

    @field_validator("classes")
    @classmethod
    def _check_order(cls, classes: tuple[HeightClass, ...]) -> tuple[HeightClass, ...]:
        _check_rising("relief_below", [relief for relief, _ in _by_relief(classes)])
        for _, kinds in _by_relief(classes):
            _check_rising("half_width_below", [kind.half_width_below for kind in kinds])
        return classes

    def table(self) -> tuple[np.ndarray, tuple[np.ndarray, ...], tuple[np.ndarray, ...], float]:
        """Return limits of relief, of each class of relief limits of half width and margins, and the factor."""
        groups = _by_relief(self.classes)
        relief = np.array([limit for limit, _ in groups if limit is not None])
        half_widths = (
            np.array([kind.half_width_below for kind in kinds[:-1]], dtype=np.float64) for _, kinds in groups
        )
        margins = (np.array([kind.margin for kind in kinds]) for _, kinds in groups)
        return relief, tuple(half_widths), tuple(margins), self.factor

    def check_surface(self, key: Mapping[str, str]) -> None:
        """Raise if the calibration belongs to other surfaces than one with this key."""
        if different := differences(self.surface, key, "the surface"):
            raise ConfigError(f"calibration {self.name} belongs to other surfaces, {different[0]}: {_MAKE_ONE}")

    def tagged(self, tags: Mapping[str, str], cell: float) -> dict[str, str]:
        """Return the tags of a surface with its margins, from those without; raise if it belongs to other surfaces."""
        self.check_surface(surface_key(tags, cell))
        kept = {name: tag for name, tag in tags.items() if name != "ALPHA"}
        own = {"COVERAGE": f"{self.coverage:g}", "CALIBRATION": f"{self.name} {self.sha256}"}
        return kept | own | {"REGISTERED": "yes" if self.registered else "no"}


def _by_relief(classes: tuple[HeightClass, ...]) -> list[tuple[float | None, list[HeightClass]]]:
    """Return the limits of relief, each with its classes."""
    return [(limit, list(kinds)) for limit, kinds in groupby(classes, lambda kind: kind.relief_below)]


def _check_rising(name: str, limits: list[float | None]) -> None:
    """Raise if limits do not rise to the last one, which is None."""
    *others, last = limits
    if last is not None or None in others:
        raise ValueError(f"{name} is to be null in the last class, and a number of metres in the others")
    for one, other in pairwise(limit for limit in others if limit is not None):
        if other <= one:
            raise ValueError(f"{name} falls from {one:g} to {other:g}: it is to rise from class to class")


def surface_key(tags: Mapping[str, str], cell: float) -> dict[str, str]:
    """Return what decides the intervals of a surface, from its tags and the side of a cell in metres."""
    found = {name: tags[name] for name in _OF_INTERVALS if name in tags}
    return {"CELL": f"{cell:g} m", "PAIRS": str(len(tags.get("RUNS", "").split())), **found}


def load_height_calibration(path: str | os.PathLike[str]) -> HeightCalibration:
    """Read and check a calibration of heights, a YAML file of ``calibrate --dsm``, for `SurfaceChoices`.

    Raises `SatIntervalsError` if the file cannot be read or is another one.
    """
    file = Path(path)
    try:
        values = read_mapping(file, f"keys {', '.join(HeightCalibration.model_fields)}")
    except OSError as error:
        raise ConfigError(f"calibration {file}: {error.strerror}: {_MAKE_ONE}") from error
    if "levels" in values:
        raise ConfigError(f"{file} is a calibration of disparities: give it to match; for heights {_MAKE_ONE}")
    if "classes" not in values and values.keys() & SETTINGS:
        raise ConfigError(f"{file} has settings, not a calibration: {_MAKE_ONE}")
    if "classes" in values and "version" not in values:
        raise ConfigError(f"{file} is of an earlier version, with margins by width alone: {_MAKE_ONE}")
    return checked(HeightCalibration, values, str(file))
