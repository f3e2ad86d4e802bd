"""Settings of the disparity interval: a level of possibility, or a coverage with its calibration."""

from collections.abc import Mapping
from decimal import Decimal
from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from sat_intervals.config.calibration import COVERAGES, Calibration, load_calibration
from sat_intervals.config.sections import Exact, Section


class Interval(Section):
    """Disparity interval: cut of the cost curve at a level of possibility (paper, eq. 5 to 8) or a calibrated one."""

    alpha: Exact | None = Field(
        Decimal("0.9"), gt=0, le=1, description="level of possibility, not a calibrated probability; null with coverage"
    )
    bounds: Literal["whole", "subpixel"] = Field(
        "whole", description="whole pixels, or where the cost curve crosses alpha"
    )
    coverage: Exact | None = Field(
        None,
        ge=Decimal(str(COVERAGES[0])),
        le=Decimal(str(COVERAGES[-1])),
        description="share of true disparities to be inside, instead of alpha; subpixel bounds",
    )
    # Content of the calibration, so that a run does not depend on its file.
    calibration: str | Calibration | None = Field(
        None, description="file or name of a calibration, with coverage; null: the built-in one of the settings"
    )

    @field_validator("calibration", mode="before")
    @classmethod
    def _load(cls, value: Any) -> Any:
        return value if value is None else load_calibration(value)

    @model_validator(mode="before")
    @classmethod
    def _choose_level(cls, values: Any) -> Any:
        if not isinstance(values, Mapping) or values.get("coverage") is None:
            return values
        if values.get("alpha") is not None:
            raise ValueError(
                f"alpha is {values['alpha']} and coverage {values['coverage']}: leave one out or set it to null"
            )
        return {**values, "alpha": None, "bounds": values.get("bounds", "subpixel")}

    @model_validator(mode="after")
    def _check_level(self) -> Self:
        if self.alpha is None and self.coverage is None:
            raise ValueError("alpha and coverage are null: give one of them, or set interval to null")
        if self.coverage is not None and self.bounds == "whole":
            raise ValueError("bounds whole go with alpha only: leave bounds out, or give subpixel, with coverage")
        if self.coverage is None and self.calibration is not None:
            raise ValueError("calibration goes with coverage only: give coverage too, or leave both out")
        return self
