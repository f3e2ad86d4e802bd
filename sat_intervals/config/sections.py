"""Sections of the settings: names, ranges and meanings."""

import json
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, model_validator
from pydantic_core import PydanticCustomError

from sat_intervals.errors import SatIntervalsError


class ConfigError(SatIntervalsError):
    """Invalid settings; the message names the file, the key, its value and the allowed values."""


def check_odd(value: int) -> int:
    """Raise if a number is even."""
    if value % 2 == 0:
        raise PydanticCustomError("odd", "must be odd")
    return value


def as_written(value: Any) -> Any:
    """Return the shortest decimal of a float, as the user typed it: 0.9 and not 0.90000000000000002."""
    return Decimal(repr(value)) if type(value) in (int, float) else value


def as_number(value: Decimal) -> int | float:
    """Return a decimal as JSON has it."""
    return int(value) if value % 1 == 0 else float(value)


def absolute(value: str) -> str:
    """Return a path that workers with another working directory find; ".." after a link leaves the link's target."""
    path = Path(value).absolute()
    return str(path.parent.resolve() / path.name if ".." in path.parts else path)


Odd = Annotated[int, AfterValidator(check_odd)]
AbsolutePath = Annotated[str, AfterValidator(absolute)]
# A number whose thresholds must be exact; a plain number in JSON, so that settings of a run can be read back.
Exact = Annotated[Decimal, BeforeValidator(as_written), PlainSerializer(as_number, when_used="json")]
# The engine and so mypy only see numbers: auto is replaced before a pair is matched, see `Disparity.is_auto`.
AUTO: Any = "auto"
# Largest disparity: bounds in steps and sentinels fit in 16 bits.
MOST_PIXELS = 16000
if TYPE_CHECKING:
    Pixels = int
else:
    Pixels = Annotated[int, Field(ge=-MOST_PIXELS, le=MOST_PIXELS)] | Literal["auto"]


class StrictModel(BaseModel):
    """Immutable content of a file; unknown keys, wrong types and NaN are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Section(StrictModel):
    """Base class of sections."""

    @model_validator(mode="before")
    @classmethod
    def _accept_numpy_scalars(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        return {key: value.item() if isinstance(value, np.generic) else value for key, value in values.items()}


class Disparity(Section):
    """Search range; both ends are searched."""

    minimum: Pixels = Field(AUTO, description="smallest disparity searched, in pixels; auto: found from the images")
    maximum: Pixels = Field(AUTO, description="largest disparity searched, in pixels; auto: found from the images")
    open_ends: bool = Field(
        False,
        description="confidence 0 and open intervals at the ends of the range, as where it is found or with a coverage",
    )
    local: bool = Field(False, description="search a separate range in each cell of the image, found from the images")
    grid: AbsolutePath | None = Field(
        None, description="raster of two bands, minimum and maximum, for local ranges; null: found from the images"
    )

    around: AbsolutePath | None = Field(
        None, description="raster of another matcher's disparities, band 1, to search around and to audit; or null"
    )
    margin: int = Field(8, ge=1, le=1000, description="pixels searched on both sides of what around has in a cell")

    @property
    def is_local(self) -> bool:
        """Return whether cells have ranges of their own."""
        return self.local or self.grid is not None or self.around is not None

    @property
    def is_auto(self) -> bool:
        """Return whether the range is to be found from the images."""
        return isinstance(self.minimum, str)

    @property
    def count(self) -> int:
        """Return the number of candidate disparities."""
        return self.maximum - self.minimum + 1

    def check_images(self, left: str, left_columns: int, right: str, right_columns: int) -> None:
        """Raise if no pixel of the left image has a candidate in the right one; names of both are for the message."""
        if left_columns - 1 + self.maximum < 0 or self.minimum > right_columns - 1:
            raise ConfigError(
                f"disparities {self.minimum} to {self.maximum} move every pixel of {left} ({left_columns} columns) "
                f"outside {right} ({right_columns} columns): check their sign, x_right = x_left + disparity"
            )

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.around is not None and (self.local or self.grid is not None):
            raise ValueError("around gives local ranges of its own: leave out local and grid")
        if isinstance(self.minimum, str) != isinstance(self.maximum, str):
            raise ValueError(f"minimum is {self.minimum}, maximum is {self.maximum}: give two numbers, or auto twice")
        if not self.is_auto and self.minimum > self.maximum:
            raise ValueError(f"minimum {self.minimum} is above maximum {self.maximum}, swap them")
        return self


class Ambiguity(Section):
    """Confidence from the ambiguity of a pixel's cost curve (Sarrazin et al. 2021)."""

    eta_max: Exact = Field(Decimal("0.7"), gt=0, le=1, description="upper limit of eta, a share of the cost span")
    # At most 1000 levels keep the ambiguity histograms of tiles small.
    eta_step: Exact = Field(
        Decimal("0.01"), ge=Decimal("0.001"), le=1, description="step of eta from 0, at most eta_max"
    )
    normalization: Literal["percentile", "range"] = Field(
        "percentile", description="by percentiles of the image, or by the largest possible ambiguity"
    )
    p1: float | None = Field(None, ge=0, description="fixed 1st percentile of the ambiguity, with p99")
    p99: float | None = Field(None, ge=0, description="fixed 99th percentile of the ambiguity, with p1")

    @model_validator(mode="after")
    def _check_together(self) -> Self:
        if self.eta_step > self.eta_max:
            raise ValueError(f"eta_step {self.eta_step} is above eta_max {self.eta_max}: give a smaller step")
        if self.p1 is None and self.p99 is None:
            return self
        if self.p1 is None or self.p99 is None:
            raise ValueError(f"p1 is {json.dumps(self.p1)}, p99 is {json.dumps(self.p99)}: give both or none")
        if self.p1 > self.p99:
            raise ValueError(f"p1 {self.p1} is above p99 {self.p99}, swap them")
        if self.normalization == "range":
            raise ValueError("p1 and p99 are percentiles: leave them out with normalization range")
        return self


class Refinement(Section):
    """Sub-pixel refinement of the disparity."""

    method: Literal["least_squares", "vfit", "planes"] = Field(
        "least_squares", description="grey values around the winner, a V through three costs, or planes through those"
    )


class CrossCheck(Section):
    """Rejection of pixels whose left and right disparities disagree."""

    method: Literal["fast", "accurate"] = Field(
        "fast", description="right disparities from the left costs, or matched on their own at up to twice the work"
    )
    tolerance: int = Field(1, ge=0, description="largest difference of the two disparities, in pixels")


class Median(Section):
    """Median filter of disparity and bounds over valid pixels (paper, eq. 10 and 11)."""

    size: Odd = Field(3, ge=3, le=11, description="side of the square window, in pixels")


class Regularization(Section):
    """Intervals of low-confidence pixels from quantiles of neighbouring bounds."""

    threshold: float = Field(0.6, ge=0, le=1, description="confidence at or below this is low")
    kernel: Odd = Field(5, ge=1, le=101, description="length in pixels of the minimum filter on confidence, along rows")
    depth: int = Field(2, ge=0, le=16, description="rows above and below that connected segments may reach")
    quantile: float = Field(0.9, ge=0.5, le=1, description="quantile of upper bounds; 1 - quantile of lower bounds")


class Tiles(Section):
    """Division of the image into tiles."""

    # Multiples of 64 align cores with the blocks of the input and output files.
    size: int = Field(
        1024, ge=64, le=16384, multiple_of=64, description="side of a tile's core, in pixels; determines the memory"
    )
    overlap: Annotated[int, Field(ge=1, le=4096)] | Literal["exact"] = Field(
        "exact",
        description="exact: tiles hand SGM's path states on; or pixels read around each tile and dropped",
    )

    @property
    def margin(self) -> int:
        """Pixels that a tile reads around its core for SGM."""
        return 1 if self.overlap == "exact" else self.overlap

    @property
    def support(self) -> int:
        """Pixels around what is matched alone, such as a region or a tile of another tool, that support it in SGM."""
        return 128 if self.overlap == "exact" else self.overlap


class Cluster(Section):
    """Where the work is done; no effect on the results."""

    kind: Literal["threads", "processes", "address", "slurm", "pbs", "lsf", "sge"] = Field(
        "threads", description="of this machine, an existing scheduler, or jobs of a batch system"
    )
    workers: int | None = Field(None, ge=1, description="tiles at once on this machine; null: one per core")
    address: str | None = Field(None, description="address of the dask scheduler, such as tcp://host:8786")
    jobs: int = Field(1, ge=1, description="jobs of the batch system; the least number if maximum_jobs is set")
    maximum_jobs: int | None = Field(None, ge=1, description="largest number of jobs; follows the tiles that remain")
    cores: int = Field(1, ge=1, description="cores of a job, and tiles at once in it")
    memory: str | None = Field(None, description="memory of a job, such as 4GB; tiles are made smaller until they fit")
    walltime: str | None = Field(None, description="time limit of a job, such as 01:00:00")
    queue: str | None = Field(None, description="queue of the batch system")
    account: str | None = Field(None, description="account that jobs are charged to")
    directives: list[str] = Field([], description="further directives of the job script, a list such as --exclusive")
    store: str | None = Field(
        None, description="folder or fsspec URL for tiles during the run; null: in the folder of the run"
    )
    retries: int = Field(2, ge=0, le=100, description="how often a failed tile is tried again")

    @model_validator(mode="after")
    def _check_fit(self) -> Self:
        if (self.kind == "address") != (self.address is not None):
            raise ValueError("address goes with kind address only: give both or neither")
        if self.maximum_jobs is not None and self.maximum_jobs < self.jobs:
            raise ValueError(f"maximum_jobs {self.maximum_jobs} is below jobs {self.jobs}, swap them")
        return self


class Products(Section):
    """Content of the output bands."""

    keep_rejected: bool = Field(False, description="write values of pixels rejected by cross-checking")
    sigma: bool = Field(False, description="write the standard deviations of least squares as a fifth band")
    compression: Literal["deflate", "zstd"] = Field("deflate", description="of the files")
