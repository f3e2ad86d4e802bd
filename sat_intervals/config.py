"""What a user may set: its default, its range, its one-line meaning, and the thresholds that follow."""

import difflib
import json
import os
import reprlib
from collections.abc import Iterable, Mapping
from decimal import Decimal
from fractions import Fraction
from importlib import resources
from math import ceil, floor
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
import numpy.typing as npt
import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import COSINE_STEPS, IMPOSSIBLE_COST

SGM_PATHS = 8


class ConfigError(SatIntervalsError):
    """Settings that cannot be used: the message names the file, the key, its value and what is allowed."""


def _check_odd(value: int) -> int:
    if value % 2 == 0:
        raise PydanticCustomError("odd", "must be odd")
    return value


def _as_written(value: Any) -> Any:
    # The shortest decimal of a float is what was typed: 0.9, where the float is 0.90000000000000002.
    return Decimal(repr(value)) if type(value) in (int, float) else value


Odd = Annotated[int, AfterValidator(_check_odd)]
# A number whose thresholds must be exact; a plain number in JSON, so that a run's settings can be read back.
Exact = Annotated[Decimal, BeforeValidator(_as_written), PlainSerializer(float, when_used="json")]
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


class _Penalties(Section):
    """Semi-global matching over 8 paths (Hirschmuller 2008)."""

    penalty: str
    p1: Any
    p2: Any

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.p1 > self.p2:
            raise ValueError(f"p1 {self.p1} is above p2 {self.p2}, the penalty of a larger step")
        return self


class Sgm(_Penalties):
    """Constant penalties."""

    penalty: Literal["constant"] = Field("constant", description="the same everywhere; or negative or inverse")
    p1: int = Field(8, ge=1, description="penalty of a disparity step of one pixel")
    p2: int = Field(32, ge=1, description="penalty of a larger step, at least p1")

    @property
    def largest_p2(self) -> Fraction:
        """What a larger step costs at most."""
        return Fraction(self.p2)


class NegativeSgm(_Penalties):
    """The penalty of a larger step falls with the gradient of the left image, in a line (Banz et al. 2012)."""

    penalty: Literal["negative"] = Field("negative", description="p2 is gamma - alpha * gradient")
    p1: int = Field(8, ge=1, description="penalty of a disparity step of one pixel")
    p2: int = Field(32, ge=1, description="least penalty of a larger step, at least p1")
    alpha: float = Field(ge=0, description="fall of the penalty by a grey value of gradient")
    gamma: float = Field(gt=0, description="penalty of a larger step without gradient")

    @property
    def largest_p2(self) -> Fraction:
        """What a larger step costs at most."""
        return max(Fraction(self.p2), Fraction(self.gamma))


class InverseSgm(_Penalties):
    """The penalty of a larger step falls with the inverse of the left image's gradient (Banz et al. 2012)."""

    penalty: Literal["inverse"] = Field("inverse", description="p2 is gamma + alpha / (gradient + beta)")
    p1: int = Field(8, ge=1, description="penalty of a disparity step of one pixel")
    p2: int = Field(32, ge=1, description="least penalty of a larger step, at least p1")
    alpha: float = Field(ge=0, description="share of the penalty that gradients bring down, times beta")
    beta: float = Field(gt=0, description="gradient, in grey values, that halves this share")
    gamma: float = Field(ge=0, description="penalty of a larger step at an endless gradient")

    @property
    def largest_p2(self) -> Fraction:
        """What a larger step costs at most."""
        return max(Fraction(self.p2), Fraction(self.gamma) + Fraction(self.alpha) / Fraction(self.beta))


class MccnnSgm(_Penalties):
    """Penalties of MC-CNN, in units of the cosine: they fall where an image has an edge along the path."""

    penalty: Literal["mc_cnn_fast"] = Field("mc_cnn_fast", description="they fall where the images have edges")
    p1: Exact = Field(Decimal("0.5"), gt=0, description="penalty of a disparity step of one pixel")
    p2: Exact = Field(Decimal("0.75"), gt=0, description="penalty of a larger step, at least p1")
    q1: Exact = Field(Decimal(3), ge=1, description="divides both where one of the images has an edge")
    q2: Exact = Field(Decimal(6), ge=1, description="divides them again where both have")
    v: Exact = Field(Decimal("1.5"), ge=1, description="divides p1 on the vertical paths")
    d: float = Field(0.08, ge=0, description="gradient above which there is an edge")
    gradients: Literal["normalized", "raw"] = Field(
        "normalized", description="in standard deviations, right where a candidate faces it; or as the reference"
    )
    span: Exact = Field(Decimal(16), gt=0, description="cost that etas and alpha are shares of, after SGM")

    @model_validator(mode="before")
    @classmethod
    def _check_span(cls, values: Any) -> Any:
        """The default span was chosen for the default penalties: bounds by another pair of them are not those meant."""
        if isinstance(values, Mapping) and "span" not in values:
            fields = {key: cls.model_fields[key].default for key in values if key in cls.model_fields}
            changed = [key for key, default in fields.items() if default not in (values[key], _as_written(values[key]))]
            if changed:
                raise ValueError(
                    f"span is missing: the default, {cls.model_fields['span'].default}, was chosen for the default "
                    f"penalties, not for another {' and '.join(changed)}: give one (config --preset mccnn shows some)"
                )
        return values

    @property
    def largest_p2(self) -> Fraction:
        """What a larger step costs at most."""
        return Fraction(self.p2)


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
            raise ValueError(f"p1 is {_shown(self.p1)}, p99 is {_shown(self.p99)}: give both or none")
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


class Config(Section):
    """All settings of a run; a section that is None switches its step off."""

    disparity: Disparity
    cost: Census | Mccnn = Field(Census(), discriminator="method")
    sgm: Sgm | NegativeSgm | InverseSgm | MccnnSgm | None = Field(Sgm(), discriminator="penalty")
    ambiguity: Ambiguity | None = Ambiguity()
    interval: Interval | None = Interval()
    refinement: Refinement | None = Refinement()
    cross_check: CrossCheck | None = CrossCheck()
    median: Median | None = Median()
    regularization: Regularization | None = Regularization()
    tiles: Tiles = Tiles()
    products: Products = Products()
    cluster: Cluster = Cluster()

    @model_validator(mode="before")
    @classmethod
    def _choose_methods(cls, values: Any) -> Any:
        """Where a section does not say its kind: census, and the penalties of the cost."""
        if not isinstance(values, Mapping):
            return values
        values = dict(values)
        cost = values.setdefault("cost", {})
        if isinstance(cost, Mapping):
            cost = values["cost"] = {"method": "census", **cost}
        method = cost.get("method") if isinstance(cost, Mapping) else getattr(cost, "method", None)
        sgm = values.setdefault("sgm", {})
        if isinstance(sgm, Mapping):
            values["sgm"] = {"penalty": "mc_cnn_fast" if method == "mccnn" else "constant", **sgm}
        return values

    @model_validator(mode="after")
    def _check_sections(self) -> Self:
        if self.sgm is not None:
            self._check_sgm(self.sgm)
        off = [name for name in ("ambiguity", "interval") if getattr(self, name) is None]
        if self.regularization is not None and off:
            raise ValueError(
                f"regularization needs {' and '.join(off)}, which null switches off: "
                f"give {' and '.join(off)} or set regularization to null"
            )
        # Neighbouring tiles are compared on a ring of one pixel around the core: windows must be whole there.
        smallest = self.cost.window // 2 + 1
        if self.tiles.overlap < smallest:
            raise ValueError(
                f"tiles.overlap is {self.tiles.overlap}, allowed: >= {smallest} with {self._cost_in_words}"
            )
        return self

    def _check_sgm(self, sgm: Sgm | NegativeSgm | InverseSgm | MccnnSgm) -> None:
        if isinstance(sgm, MccnnSgm) != isinstance(self.cost, Mccnn):
            known = "mc_cnn_fast" if isinstance(self.cost, Mccnn) else "constant, negative or inverse"
            raise ValueError(f"sgm.penalty is {sgm.penalty}, allowed: {known} with cost.method {self.cost.method}")
        # The largest uint16 is kept free: it marks the summed cost of an impossible candidate.
        largest = (IMPOSSIBLE_COST - 1) // SGM_PATHS - self.cost.largest
        if self.largest_p2 > largest:
            key = "p2" if sgm.penalty in ("constant", "mc_cnn_fast") else "gamma, the penalty without gradient,"
            raise ValueError(
                f"sgm.{key} is {float(sgm.largest_p2):g}, allowed: <= {largest // self.cost.steps} with "
                f"{self._cost_in_words}, so that costs summed over {SGM_PATHS} paths fit in 16 bits"
            )
        if isinstance(sgm, MccnnSgm):
            if self.cost_span > self.largest_sum:
                raise ValueError(
                    f"sgm.span is {sgm.span}, allowed: <= {self.largest_sum / self.cost.steps:g} with p2 {sgm.p2}"
                )
            if sgm.gradients == "raw" and not self.disparity.minimum <= 0 <= self.disparity.maximum:
                raise ValueError("sgm.gradients raw looks at the right image at disparity 0, which is not searched")

    @property
    def _cost_in_words(self) -> str:
        return f"cost.window {self.cost.window}" if isinstance(self.cost, Census) else f"cost.method {self.cost.method}"

    def in_steps(self, value: Decimal | float | Fraction) -> int:
        """The nearest integer cost to a value in units of the settings."""
        return floor(Fraction(value) * self.cost.steps + Fraction(1, 2))

    @property
    def largest_p2(self) -> int:
        """The largest penalty, as an integer cost; 0 without SGM."""
        return 0 if self.sgm is None else self.in_steps(self.sgm.largest_p2)

    @property
    def impossible_cost(self) -> int:
        """What an impossible candidate costs inside SGM."""
        return self.cost.ceiling + self.largest_p2 + self.cost.steps

    @property
    def largest_sum(self) -> int:
        """The largest possible cost, after SGM where it is on; the smallest is 0."""
        return self.cost.largest if self.sgm is None else SGM_PATHS * (self.cost.largest + self.largest_p2)

    @property
    def cost_span(self) -> int:
        """What etas and alpha are shares of: largest minus smallest possible cost, or what the settings declare.

        The paper's ``max C_V - min C_V``, declared and not measured: a span measured on a tile would make the result
        depend on the tiling. With Census real scenes attain both bounds. With MC-CNN they come nowhere near, and
        differ: see ``span`` in its settings.
        """
        return self.in_steps(self.sgm.span) if isinstance(self.sgm, MccnnSgm) else self.largest_sum

    @property
    def cut_level(self) -> int | None:
        """Largest ``S(d) - min S`` of the alpha-cut: ``floor((1 - alpha) * cost_span)``; None if off."""
        if self.interval is None:
            return None
        return floor((1 - Fraction(self.interval.alpha)) * self.cost_span)

    @property
    def ambiguity_levels(self) -> tuple[int, ...] | None:
        """Largest ambiguous ``S(d) - min S`` at each eta: ``floor(eta * cost_span)``; None if off."""
        if self.ambiguity is None:
            return None
        step = Fraction(self.ambiguity.eta_step)
        count = ceil(Fraction(self.ambiguity.eta_max) / step)
        return tuple(floor(i * step * self.cost_span) for i in range(count))

    @property
    def largest_ambiguity(self) -> int:
        """Ambiguity of a pixel all of whose disparities are ambiguous at every eta; 0 without ambiguity."""
        return len(self.ambiguity_levels or ()) * self.disparity.count

    @property
    def ambiguity_weights(self) -> npt.NDArray[np.uint16] | None:
        """Table ``(largest_sum + 1,)`` of what a candidate adds to the ambiguity, by its ``S(d) - min S``.

        The number of levels at or above it; ``weights[0]``, all of them, is also what an impossible candidate
        adds. None if off.
        """
        levels = self.ambiguity_levels
        if levels is None:
            return None
        below = np.searchsorted(levels, np.arange(self.largest_sum + 1), side="left")
        return (len(levels) - below).astype(np.uint16)


def load_config(
    source: str | Path | Mapping[str, Any] | Config | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Config:
    """Check settings and complete them with the defaults.

    Parameters
    ----------
    source
        A YAML file, a mapping of sections, or settings checked before; None for the defaults.
    overrides
        Sections and keys that win over ``source``, as those of the command line do.

    Raises
    ------
    ConfigError
        All that is wrong, in one line.
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
        case Mapping():
            values = source
        case _:
            raise ConfigError(f"settings are {_shown(source)}, allowed: a YAML file, a mapping or a Config")
    try:
        return Config.model_validate(_merged(_without_other_cost(values, overrides), overrides))
    except ValidationError as error:
        problems = error.errors(include_url=False)
        if all(_given(overrides, problem["loc"]) for problem in problems):
            file = ""  # not to blame for what the overrides brought
        raise ConfigError(file + "; ".join(map(_explained, problems))) from error


def preset_names() -> tuple[str, ...]:
    """Return the names of the settings files that come with the package."""
    files = resources.files("sat_intervals.configs").iterdir()
    return tuple(sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml")))


def preset_text(name: str = "default") -> str:
    """Return the text of a settings file that comes with the package: complete, commented YAML."""
    if name not in preset_names():
        raise ConfigError(f"unknown preset {name!r}{_known(name, preset_names())}")
    return (resources.files("sat_intervals.configs") / f"{name}.yaml").read_text(encoding="utf-8")


def allowed(field: FieldInfo) -> str:
    """Return in words which values a setting takes, from its own type and bounds: ``integer >= 1, odd``."""
    nouns = {int: "integer", float: "number", Decimal: "number", bool: "true or false", str: "text"}
    signs = {"ge": ">=", "gt": ">", "le": "<=", "multiple_of": "multiple of"}
    kinds = get_args(field.annotation) or (field.annotation,)
    sections = _sections(field)
    kind = (
        f"section of {', '.join(sections[0].model_fields)}" if sections else nouns.get(kinds[0]) or " or ".join(kinds)
    )
    bounds = [
        f"{sign} {getattr(constraint, name)}"
        for constraint in field.metadata
        for name, sign in signs.items()
        if hasattr(constraint, name)
    ]
    if any(constraint == AfterValidator(_check_odd) for constraint in field.metadata):
        bounds.append("odd")
    return " ".join(filter(None, [kind, ", ".join(bounds), "or null" if NoneType in kinds else ""]))


def _sections(field: FieldInfo) -> list[type[Section]]:
    """The kinds of section that a field holds."""
    kinds = get_args(field.annotation) or (field.annotation,)
    return [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Section)]


def _explained(problem: ErrorDetails) -> str:
    path = [str(key) for key in problem["loc"]]
    owner: type[Section] = Config
    if path and path[0] in Config.model_fields:
        field = Config.model_fields[path[0]]
        kinds = _sections(field)
        if problem["type"] == "union_tag_invalid":
            known = " or ".join(str(kind.model_fields[str(field.discriminator)].default) for kind in kinds)
            return f"{path[0]}.{field.discriminator} is {_shown(problem['ctx']['tag'])}, allowed: {known}"
        if len(kinds) > 1 and len(path) > 1:
            tag = path.pop(1)  # pydantic names the kind as well
            kinds = [kind for kind in kinds if kind.model_fields[str(field.discriminator)].default == tag]
        owner = kinds[0] if len(path) > 1 else Config
    where = ".".join(path)
    if problem["type"] == "value_error":
        return ": ".join(filter(None, [where, str(problem["ctx"]["error"])]))
    if problem["type"] in ("extra_forbidden", "invalid_key"):
        return f"unknown key {where!r}{_known(path[-1], owner.model_fields)}"
    state = "missing" if problem["type"] == "missing" else _shown(problem["input"])
    return f"{where} is {state}, allowed: {allowed(owner.model_fields[path[-1]])}"


def _known(name: str, names: Iterable[str]) -> str:
    names = list(names)
    guess = "".join(f", did you mean {close}?" for close in difflib.get_close_matches(name, names, n=1))
    return f"{guess} (known: {', '.join(names)})"


def _shown(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    return str(value) if isinstance(value, Decimal) else reprlib.repr(value)


def _without_other_cost(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> Mapping[str, Any]:
    """The settings without cost and penalties where the overrides choose another method, whose keys are others."""

    def method(settings: Mapping[str, Any]) -> Any:
        cost = settings.get("cost")
        return cost.get("method") if isinstance(cost, Mapping) else None

    if method(overrides) in (None, method(values) or "census"):
        return values
    return {key: value for key, value in values.items() if key != "cost" and (key != "sgm" or value is None)}


def _merged(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(values)
    for key, value in overrides.items():
        below = merged.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            value = _merged(below, value)
        merged[key] = value
    return merged


def _given(overrides: Any, path: tuple[int | str, ...]) -> bool:
    for key in path:
        if not isinstance(overrides, Mapping) or key not in overrides:
            return False
        overrides = overrides[key]
    return bool(path)  # an error without a path is between sections


class _UniqueKeyLoader(yaml.SafeLoader):
    """YAML's safe subset, where a key given twice is an error: plain YAML keeps the last without a word."""

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


def _read_yaml(file: Path) -> Mapping[str, Any]:
    try:
        values = yaml.load(file.read_bytes(), _UniqueKeyLoader)  # a SafeLoader
    except OSError as error:
        preset = (
            isinstance(error, FileNotFoundError) and file.name == f"{file.stem}.yaml" and file.stem in preset_names()
        )
        hint = f" (sat-intervals config --preset {file.stem} > {file} writes one)" if preset else ""
        raise ConfigError(f"{file}: {error.strerror}{hint}") from error
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ConfigError(f"{file}: {line}{error.problem}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{file}: {' '.join(str(error).split())}") from error
    if values is None:
        return {}
    if not isinstance(values, Mapping):
        raise ConfigError(f"{file}: holds {_shown(values)}, allowed: sections {', '.join(Config.model_fields)}")
    return values
