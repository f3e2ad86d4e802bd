"""Settings of the disparity interval: a coverage with its calibration, or a level of possibility."""

from collections.abc import Mapping
from decimal import Decimal
from typing import Any, Self

from pydantic import Field, field_validator, model_validator

from sat_intervals.config.calibration import COVERAGES, Calibration, load_calibration
from sat_intervals.config.sections import Exact, Section


class Interval(Section):
    """Disparity interval: cut of the cost curve at a calibrated level, or at a possibility (paper, eq. 5 to 8)."""

    coverage: Exact | None = Field(
        Decimal("0.9"),
        ge=Decimal(str(COVERAGES[0])),
        le=Decimal(str(COVERAGES[-1])),
        description="share of true disparities to be inside, with bounds in fractions of pixels; null with alpha",
    )
    # Content of the calibration, so that a run does not depend on its file.
    calibration: str | Calibration | None = Field(
        None, description="file or name of a calibration, with coverage; null: the built-in one of the settings"
    )
    alpha: Exact | None = Field(
        None,
        gt=0,
        le=1,
        description="level of possibility, no probability, instead of coverage; bounds in whole pixels",
    )

    @field_validator("calibration", mode="before")
    @classmethod
    def _load(cls, value: Any) -> Any:
        return value if value is None else load_calibration(value)

    @model_validator(mode="before")
    @classmethod
    def _choose_level(cls, values: Any) -> Any:
        if not isinstance(values, Mapping) or values.get("alpha") is None:
            return values
        return {"coverage": None, **values}

    @model_validator(mode="after")
    def _check_level(self) -> Self:
        if self.alpha is None and self.coverage is None:
            raise ValueError("alpha and coverage are null: give one of them, or set interval to null")
        if self.alpha is not None and self.coverage is not None:
            raise ValueError(f"alpha is {self.alpha} and coverage {self.coverage}: leave one out or set it to null")
        if self.coverage is None and self.calibration is not None:
            raise ValueError("calibration goes with coverage only: give coverage too, or leave both out")
        return self
