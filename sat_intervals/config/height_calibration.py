"""Calibrations of heights: metres that widen or narrow the intervals of a surface model, and what they belong to."""

import os
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from sat_intervals.config.calibration import SETTINGS, CalibrationFile, checked, differences
from sat_intervals.config.files import read_mapping
from sat_intervals.config.sections import ConfigError, StrictModel

_MAKE_ONE = "make one with sat-intervals calibrate --dsm"
# Tags of a surface that its intervals depend on.
_OF_INTERVALS = (
    "COVERAGE", "ALPHA", "DISPARITY_CALIBRATION", "INTERVAL", "RADIUS", "OUTLIERS", "OPEN_POINTS", "MIN_CONFIDENCE"
)  # fmt: skip
_LARGEST = 10_000.0  # metres


class WidthClass(StrictModel):
    """Intervals narrower than ``below`` (metres, None: all others), whose bounds move outwards by ``margin`` metres.

    ``cells`` is the number of cells that it was found from.
    """

    below: float | None = Field(gt=0)
    margin: float = Field(ge=-_LARGEST, le=_LARGEST)
    cells: int = Field(ge=1)


class HeightCalibration(CalibrationFile):
    """Margins of the intervals of a surface model, by class of width from narrow to wide.

    ``coverage`` is the share of true heights inside. If the reference was ``registered`` to the surface, the margins do
    not include a constant shift. ``surface`` says what surfaces they belong to, see `surface_key`.
    """

    name: str
    coverage: float = Field(gt=0, lt=1)
    registered: bool
    surface: dict[str, str]
    classes: tuple[WidthClass, ...] = Field(strict=False, min_length=1)
    provenance: dict[str, Any] = Field(default_factory=dict)

    @field_validator("classes")
    @classmethod
    def _check_order(cls, classes: tuple[WidthClass, ...]) -> tuple[WidthClass, ...]:
        *limits, last = (kind.below for kind in classes)
        if last is not None or None in limits:
            raise ValueError("below is to be null in the last class, and a number of metres in the others")
        for one, other in pairwise(limit for limit in limits if limit is not None):
            if other <= one:
                raise ValueError(f"below falls from {one:g} to {other:g}: it is to rise from class to class")
        return classes

    @property
    def limits(self) -> list[float]:
        """Return the widths between the classes in metres."""
        return [kind.below for kind in self.classes if kind.below is not None]

    @property
    def margins(self) -> list[float]:
        """Return the margin of each class in metres."""
        return [kind.margin for kind in self.classes]

    def check_surface(self, key: Mapping[str, str]) -> None:
        """Raise if the calibration belongs to other surfaces than one with this key."""
        if different := differences(self.surface, key, "the surface"):
            raise ConfigError(f"calibration {self.name} belongs to other surfaces, {different[0]}: {_MAKE_ONE}")


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
    return checked(HeightCalibration, values, str(file))
