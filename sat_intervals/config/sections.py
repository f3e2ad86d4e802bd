"""Sections of the settings that stand for themselves: what may be set, from where to where, and what it means."""

import json
import os
from collections.abc import Mapping
from decimal import Decimal
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import COSINE_STEPS


class ConfigError(SatIntervalsError):
    """Settings that cannot be used: the message names the file, the key, its value and what is allowed."""


def check_odd(value: int) -> int:
    """Refuse even numbers."""
    if value % 2 == 0:
        raise PydanticCustomError("odd", "must be odd")
    return value


def as_written(value: Any) -> Any:
    """The shortest decimal of a float is what was typed: 0.9, where the float is 0.90000000000000002."""
    return Decimal(repr(value)) if type(value) in (int, float) else value


Odd = Annotated[int, AfterValidator(check_odd)]
# A number whose thresholds must be exact; a plain number in JSON, so that a run's settings can be read back.
Exact = Annotated[Decimal, BeforeValidator(as_written), PlainSerializer(float, when_used="json")]
# Disparities are stored as int16; within this limit the difference of any two of them fits as well.
Pixels = Annotated[int, Field(ge=-16000, le=16000)]


class Section(BaseModel):
    """Settings that belong together: immutable; unknown keys, other types and NaN are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _accept_numpy_scalars(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        return {key: value.item() if isinstance(value, np.generic) else value for key, value in values.items()}


class Disparity(Section):
    """Search range; both ends are searched."""

    minimum: Pixels = Field(description="smallest disparity searched, in pixels")
    maximum: Pixels = Field(description="largest disparity searched, in pixels")

    @property
    def count(self) -> int:
        """Number of candidates of a pixel."""
        return self.maximum - self.minimum + 1

    def check_images(self, left: str, left_columns: int, right: str, right_columns: int) -> None:
        """Hold that images, ``left`` and ``right`` in messages, can be searched over this range.

        Raises
        ------
        ConfigError
            No pixel of the left has a candidate in the right.
        """
        if left_columns - 1 + self.maximum < 0 or self.minimum > right_columns - 1:
            raise ConfigError(
                f"disparities {self.minimum} to {self.maximum} lead every pixel of {left}, {left_columns} columns, out "
                f"of {right}, {right_columns}: check their sign, x_right = x_left + disparity"
            )

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.minimum > self.maximum:
            raise ValueError(f"minimum {self.minimum} is above maximum {self.maximum}, swap them")
        return self


class Census(Section):
    """Matching cost: Hamming distance of Census codes."""

    method: Literal["census"] = Field("census", description="matching cost, census or mccnn")
    window: Odd = Field(5, ge=3, le=11, description="side of the square window, in pixels")

    @property
    def steps(self) -> int:
        """Integer costs to a unit of the settings: a bit."""
        return 1

    @property
    def largest(self) -> int:
        """The largest integer cost."""
        return self.window**2 - 1

    @property
    def ceiling(self) -> int:
        """From which the cost of impossible candidates is counted, as libSGM does."""
        return self.window**2


class Mccnn(Section):
    """Matching cost: 1 - cosine of the features of a network, MC-CNN fast (Zbontar and LeCun 2016)."""

    method: Literal["mccnn"] = Field("mccnn", description="matching cost, census or mccnn")
    weights: str | None = Field(None, description="ONNX file of the network; null: the one of the extra [mccnn]")

    @field_validator("weights")
    @classmethod
    def _name_wholly(cls, value: str | None) -> str | None:
        return None if value is None else os.path.abspath(value)  # wherever a worker stands

    @property
    def window(self) -> int:
        """Side of what a feature sees, in pixels."""
        return 11

    @property
    def steps(self) -> int:
        """Integer costs to a unit of the settings: of the cosine."""
        return COSINE_STEPS

    @property
    def largest(self) -> int:
        """The largest integer cost."""
        return 2 * COSINE_STEPS

    @property
    def ceiling(self) -> int:
        """From which the cost of impossible candidates is counted."""
        return self.largest


class Ambiguity(Section):
    """Confidence from the ambiguity of a pixel's costs (Sarrazin et al. 2021)."""

    eta_max: Exact = Field(Decimal("0.7"), gt=0, le=1, description="eta, a share of the cost span, stays below this")
    # At most 1000 levels, so that the ambiguity histograms of tiles stay small.
    eta_step: Exact = Field(
        Decimal("0.01"), ge=Decimal("0.001"), le=1, description="step of eta from 0, at most eta_max"
    )
    normalization: Literal["percentile", "range"] = Field(
        "percentile", description="by the image's percentiles, or by the largest possible"
    )
    p1: float | None = Field(None, ge=0, description="ambiguity to use as the 1st percentile, with p99")
    p99: float | None = Field(None, ge=0, description="ambiguity to use as the 99th percentile, with p1")

    @model_validator(mode="after")
    def _check_together(self) -> Self:
        if self.eta_step > self.eta_max:
            raise ValueError(f"eta_step {self.eta_step} is above eta_max {self.eta_max}")
        if self.p1 is None and self.p99 is None:
            return self
        if self.p1 is None or self.p99 is None:
            raise ValueError(f"p1 is {json.dumps(self.p1)}, p99 is {json.dumps(self.p99)}: give both or none")
        if self.p1 > self.p99:
            raise ValueError(f"p1 {self.p1} is above p99 {self.p99}, swap them")
        if self.normalization == "range":
            raise ValueError("p1 and p99 stand for percentiles: leave them out with normalization range")
        return self


class Interval(Section):
    """Disparity interval: alpha-cut of a possibility distribution (paper, eq. 5 to 8)."""

    alpha: Exact = Field(Decimal("0.9"), gt=0, le=1, description="level of possibility, not a calibrated probability")


class Refinement(Section):
    """Sub-pixel refinement of the disparity."""

    method: Literal["vfit"] = Field("vfit", description="symmetric V through the costs at and beside the winner")


class CrossCheck(Section):
    """Rejection of pixels on which the left and the right view disagree."""

    method: Literal["fast", "accurate"] = Field(
        "fast", description="right view read off the left costs, or matched itself at twice the work"
    )
    tolerance: int = Field(1, ge=0, description="largest difference of the two views, in pixels")


class Median(Section):
    """Median filter on disparity and bounds, over kept pixels (paper, eq. 10 and 11)."""

    size: Odd = Field(3, ge=3, le=11, description="side of the square window, in pixels")


class Regularization(Section):
    """Intervals of low-confidence pixels from quantiles of the bounds around them."""

    threshold: float = Field(0.6, ge=0, le=1, description="confidence up to this is low")
    kernel: Odd = Field(5, ge=1, le=101, description="pixels along the row whose least confidence counts")
    depth: int = Field(2, ge=0, le=16, description="rows reached up and down through touching segments")
    quantile: float = Field(0.9, ge=0.5, le=1, description="quantile of upper bounds, 1 - quantile of lower ones")


class Tiles(Section):
    """How the image is cut for the workers."""

    # Multiples of 64 keep cores aligned with the blocks of the images read and written.
    size: int = Field(
        1024, ge=64, le=16384, multiple_of=64, description="side of what a tile keeps, in pixels; memory follows it"
    )
    overlap: int = Field(100, ge=1, le=4096, description="pixels read around it and dropped; more leave fewer seams")


class Cluster(Section):
    """Where tiles are matched; nothing here changes the results."""

    kind: Literal["threads", "processes", "address", "slurm", "pbs", "lsf", "sge"] = Field(
        "threads", description="of this machine, an existing scheduler, or jobs of a batch system"
    )
    workers: int | None = Field(None, ge=1, description="tiles in work at once on this machine; null: one a core")
    address: str | None = Field(None, description="of the dask scheduler, such as tcp://host:8786")
    jobs: int = Field(1, ge=1, description="jobs of the batch system, the least number where maximum_jobs is set")
    maximum_jobs: int | None = Field(None, ge=1, description="most jobs, as many as the tiles left keep busy")
    cores: int = Field(1, ge=1, description="of a job, and tiles it has in work at once")
    memory: str | None = Field(None, description="of a job, such as 4GB; tiles get smaller until they fit")
    walltime: str | None = Field(None, description="of a job, such as 01:00:00")
    queue: str | None = Field(None, description="of the batch system")
    account: str | None = Field(None, description="that jobs are charged to")
    directives: list[str] = Field([], description="a list of further directives of the job script, such as --exclusive")
    store: str | None = Field(
        None, description="folder or fsspec URL for tiles until the run is finished; null: in the folder of the run"
    )
    retries: int = Field(2, ge=0, description="how often a tile that fails is tried again")

    @model_validator(mode="after")
    def _check_fit(self) -> Self:
        if (self.kind == "address") != (self.address is not None):
            raise ValueError("address belongs to kind address, and to no other")
        if self.maximum_jobs is not None and self.maximum_jobs < self.jobs:
            raise ValueError(f"maximum_jobs {self.maximum_jobs} is below jobs {self.jobs}, swap them")
        return self


class Products(Section):
    """What the written bands hold."""

    keep_rejected: bool = Field(False, description="write values of pixels rejected by cross-checking")
