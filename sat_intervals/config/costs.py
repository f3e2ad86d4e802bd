"""Settings of matching costs, and the numbers that the engine needs of each; `match.costs` has what computes them."""

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from decimal import Decimal
from fractions import Fraction
from importlib.metadata import PackageNotFoundError, files
from math import floor
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, get_args

from pydantic import AfterValidator, Field, model_validator

from sat_intervals.config.penalties import AnySgm
from sat_intervals.config.sections import Exact, Odd, Section, absolute
from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import COSINE_STEPS

# Integer costs of a external volume, at most: without SGM, and with it together with P2.
_LEVELS, _SGM_LEVELS = 50_000, 8_190
# The distribution of the official weights, and its files: the one that Pandora uses, and one of depthwise convolutions.
_DISTRIBUTION = "MCCNN"
NETWORKS = {"full": "mc_cnn_fast_int8_excl_01.onnx", "depthwise": "mc_cnn_fast_dw.onnx"}
INSTALL_MCCNN = "pip install 'sat-intervals[mccnn]'"
_NAMES = " or ".join(NETWORKS)


class Numbers(NamedTuple):
    """Integer costs: 0 to ``largest``, ``steps`` for each unit of the settings.

    gap: from ``largest`` + P2 to the cost of an impossible candidate inside SGM.
    """

    largest: int
    steps: Fraction
    gap: int


class _Cost(Section):
    """What the engine asks of a matching cost, beside ``window``: the side of the window that a cost depends on."""

    method: str

    penalties: ClassVar[tuple[str, ...]] = ("constant",)  # that it goes with, its default first
    precomputed: ClassVar[int] = 0  # bytes of a cost that is computed before SGM; 0: SGM compares codes
    converted: ClassVar[int] = 0  # bytes of the value that a precomputed cost is made from
    column_bytes: ClassVar[int] = 0  # of temporary arrays, for each column of a patch
    needs_statistics: ClassVar[bool] = False  # mean and standard deviation of the whole images
    has_right_view: ClassVar[bool] = True  # the right view has costs of its own, and cells have ranges of their own
    compares_two: ClassVar[bool] = True  # images: a left and a right one
    packages: ClassVar[tuple[str, ...]] = ()  # whose versions decide the costs
    named_by: ClassVar[str] = "method"  # key that decides the numbers, for messages

    @property
    def words(self) -> str:
        """Return what decides the numbers, in words."""
        return f"cost.{self.named_by} {getattr(self, self.named_by)}"

    @property
    def is_logarithmic(self) -> bool:
        """Return whether costs are logarithms of probabilities."""
        return False

    @property
    def rejected(self) -> float:
        """Return the share of the pixels, of lowest confidence, that are not kept."""
        return 0.0

    @classmethod
    def completed(cls, cost: Mapping[str, Any], sgm: Any) -> Any:
        """Return the section ``sgm`` as given, with what follows from the section ``cost``."""
        return {"penalty": cls.penalties[0], **sgm} if isinstance(sgm, Mapping) else sgm

    def check_penalties(self, sgm: AnySgm) -> None:
        """Raise if penalties do not fit."""
        if sgm.penalty not in self.penalties:
            fit = " or ".join(self.penalties)
            raise ValueError(f"sgm.penalty is {sgm.penalty}, allowed: {fit} with cost.method {self.method}")

    def files(self) -> dict[str, Path]:
        """Return the files that decide the costs, by what they hold."""
        return {}

    def key(self) -> dict[str, Any]:
        """Return what decides which coverage a level reaches, for calibrations."""
        return self.model_dump(mode="json")


class Census(_Cost):
    """Matching cost: Hamming distance of Census codes; a unit is a bit."""

    method: Literal["census"] = Field("census", description="matching cost, census or mccnn")
    window: Odd = Field(7, ge=3, le=11, description="side of the square window, in pixels")

    named_by = "window"

    def numbers(self, p2: Fraction | None) -> Numbers:
        """Return the integer costs; an impossible one as in libSGM."""
        return Numbers(self.window**2 - 1, Fraction(1), 2)

    def check_penalties(self, sgm: AnySgm) -> None:
        """Raise if penalties do not fit."""
        super().check_penalties(sgm)
        if sgm.span is not None:
            raise ValueError("sgm.span is given, but with cost.method census it follows from p2: leave it out")
        if fraction := [name for name in ("p1", "p2") if getattr(sgm, name) % 1]:
            raise ValueError(f"sgm.{fraction[0]} is {getattr(sgm, fraction[0])}, allowed: whole numbers with census")


def weights_file(weights: str) -> Path:
    """Find the file of a network: a given one, or an official one without an import of its package."""
    if weights not in NETWORKS:
        if not Path(weights).is_file():
            raise SatIntervalsError(f"cost.weights {weights}: no such file: name an ONNX network, or {_NAMES}")
        return Path(weights).resolve()
    try:
        found = [file for file in files(_DISTRIBUTION) or [] if file.name == NETWORKS[weights]]
    except PackageNotFoundError as error:
        raise SatIntervalsError(f"cost mccnn needs the package {_DISTRIBUTION}: {INSTALL_MCCNN}") from error
    if not found:
        raise SatIntervalsError(
            f"the installed {_DISTRIBUTION} has no {NETWORKS[weights]}: {INSTALL_MCCNN}, or set cost.weights"
        )
    return Path(str(found[0].locate())).resolve()


class Mccnn(_Cost):
    """Matching cost: 1 - cosine of features of the network MC-CNN fast (Zbontar and LeCun 2016)."""

    method: Literal["mccnn"] = Field("mccnn", description="matching cost, census or mccnn")
    weights: Annotated[str, AfterValidator(lambda value: value if value in NETWORKS else absolute(value))] = Field(
        "full", description="network of the extra [mccnn], full or depthwise, or an ONNX file"
    )

    window: ClassVar = 11  # of the receptive field of a feature
    penalties = "mc_cnn_fast", "constant"
    precomputed = 1
    column_bytes = 140_000  # layers of the network for a strip of rows, and the features of both images
    needs_statistics = True
    packages = ("onnxruntime",)

    def numbers(self, p2: Fraction | None) -> Numbers:
        """Return the integer costs."""
        return Numbers(2 * COSINE_STEPS, Fraction(COSINE_STEPS), COSINE_STEPS)

    def check_penalties(self, sgm: AnySgm) -> None:
        """Raise if penalties do not fit."""
        super().check_penalties(sgm)
        if sgm.span is None:
            raise ValueError(
                "sgm.span is missing: it has no default with cost.method mccnn (see config --preset mccnn)"
            )

    def files(self) -> dict[str, Path]:
        """Return the file of the network."""
        return {"weights": weights_file(self.weights)}

    def key(self) -> dict[str, Any]:
        """Return the digest of the network, wherever it is."""
        with weights_file(self.weights).open("rb") as weights:
            return super().key() | {"weights": hashlib.file_digest(weights, "sha256").hexdigest()}


class Volume(_Cost):
    """Matching cost: values of another matcher, see `intervals_of` and ``volume_of`` of `match_pair`."""

    method: Literal["volume"] = Field("volume", description="values of another matcher; from Python only")
    kind: Literal["cost", "similarity", "probability"] = Field(
        "cost", description="what the values are: the best is the smallest, or the largest; or they sum to 1"
    )
    span: Exact = Field(Decimal(1), gt=0, description="largest possible value minus the smallest; 1 for probabilities")
    lowest: Exact = Field(Decimal(0), description="smallest possible value")
    margin: int = Field(0, ge=0, le=1024, description="pixels that volume_of needs around a tile")
    name: str | None = Field(None, description="of volume_of and its version; by default that of the function")

    precomputed = 2
    converted = 4
    has_right_view = False

    @property
    def window(self) -> int:
        """Return the side of the window that a value depends on, in pixels."""
        return 2 * self.margin + 1

    @property
    def is_logarithmic(self) -> bool:
        """Return whether costs are logarithms of probabilities."""
        return self.kind == "probability"

    def numbers(self, p2: Fraction | None) -> Numbers:
        """Return the integer costs: a multiple of a whole span, if that fits; an impossible one as with Census.

        With SGM 8 times the sum of the largest cost and ``p2``, in units of the values, fits in 16 bits.
        """
        span = Fraction(self.span)
        most = _LEVELS if p2 is None else floor(_SGM_LEVELS * span / (span + p2))
        is_multiple = span.denominator == 1 and span <= most
        largest = most // span.numerator * span.numerator if is_multiple else max(most, 1)
        steps = largest / span
        return Numbers(largest, steps, 2 * max(1, min(int(steps), largest // 8)))

    @classmethod
    def completed(cls, cost: Mapping[str, Any], sgm: Any) -> Any:
        """Return no penalties by default; those that are not given follow from the span."""
        if sgm is True or (sgm and isinstance(sgm, Mapping)):
            with suppress(ArithmeticError, ValueError):  # the section names a span that is no number
                span = Decimal(str(cost.get("span", 1)))
                sgm = {"p1": float(span / 2), "p2": float(3 * span), **({} if sgm is True else sgm)}
        return super().completed(cost, sgm or None)

    def check_penalties(self, sgm: AnySgm) -> None:
        """Raise if penalties do not fit."""
        super().check_penalties(sgm)
        if self.is_logarithmic:
            raise ValueError("sgm is given with probabilities, allowed: constant penalties and costs or similarities")

    def key(self) -> dict[str, Any]:
        """Return what the values are."""
        return self.model_dump(mode="json", include={"method", "kind", "span", "lowest"})

    @model_validator(mode="after")
    def _check_probability(self) -> Self:
        if self.kind == "probability" and (self.span != 1 or self.lowest != 0):
            raise ValueError(f"span is {self.span}, lowest {self.lowest}, but probabilities are 0 to 1: leave both out")
        return self


class Sweep(_Cost):
    """Matching cost: Census of many images resampled to the ground at each height; a unit is a bit.

    Disparities are steps of height.
    """

    method: Literal["sweep"] = Field("sweep", description="many images, compared at heights above the ground")
    share: Exact = Field(Decimal("0.4"), gt=0, le=1, description="of the pairs that see a cell, the best that count")
    pairs: int = Field(3, ge=1, le=16, description="pairs of images to compare, for each image")
    step: float | None = Field(None, gt=0, description="metres between heights; null: half a cell of parallax")
    doubtful: float = Field(0.05, ge=0, lt=1, description="share of cells, of lowest confidence, without height")

    window: ClassVar = 5
    precomputed = 1
    has_right_view = False
    compares_two = False

    @property
    def rejected(self) -> float:
        """Return the share of the cells, of lowest confidence, that are not kept."""
        return self.doubtful

    def numbers(self, p2: Fraction | None) -> Numbers:
        """Return the integer costs: tenths of a bit, in a byte."""
        return Numbers(10 * (self.window**2 - 1), Fraction(10), 20)

    def key(self) -> dict[str, Any]:
        """Return what decides which coverage a level reaches, for calibrations."""
        return self.model_dump(mode="json", include={"method", "share"})


AnyCost = Annotated[Census | Mccnn | Volume | Sweep, Field(discriminator="method")]
SECTIONS = {section.model_fields["method"].default: section for section in get_args(get_args(AnyCost)[0])}
