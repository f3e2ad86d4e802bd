"""Sections of semi-global matching, one for each kind of penalties."""

from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from sat_intervals.config.sections import Exact, Section


class _Penalties(Section):
    """Semi-global matching over 8 paths (Hirschmuller 2008)."""

    penalty: str
    p1: Any
    p2: Any

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.p1 > self.p2:
            raise ValueError(f"p1 {self.p1} is above p2 {self.p2}, the penalty of a larger step: give p1 <= p2")
        return self


class Sgm(_Penalties):
    """Constant penalties for Census, in bits."""

    penalty: Literal["constant"] = Field("constant", description="the same everywhere; or negative or inverse")
    p1: int = Field(8, ge=1, description="penalty of a disparity step of one pixel")
    p2: int = Field(32, ge=1, description="penalty of a larger step, at least p1")

    @property
    def largest_p2(self) -> Fraction:
        """Return the largest penalty of a larger step."""
        return Fraction(self.p2)


class CosineSgm(_Penalties):
    """Constant penalties for MC-CNN, in units of the cosine; neither they nor the span have defaults."""

    penalty: Literal["constant"] = Field("constant", description="the same everywhere; or mc_cnn_fast")
    p1: Exact = Field(gt=0, description="penalty of a disparity step of one pixel")
    p2: Exact = Field(gt=0, description="penalty of a larger step, at least p1")
    span: Exact = Field(gt=0, description="span of the aggregated cost, for etas and alpha")

    @property
    def largest_p2(self) -> Fraction:
        """Return the largest penalty of a larger step."""
        return Fraction(self.p2)


class NegativeSgm(_Penalties):
    """Penalty of a larger step that decreases linearly with the gradient of the left image (Banz et al. 2012)."""

    penalty: Literal["negative"] = Field("negative", description="p2 is gamma - alpha * gradient")
    p1: int = Field(8, ge=1, description="penalty of a disparity step of one pixel")
    p2: int = Field(32, ge=1, description="least penalty of a larger step, at least p1")
    alpha: float = Field(ge=0, description="decrease of the penalty per grey value of gradient")
    gamma: float = Field(gt=0, description="penalty of a larger step at zero gradient")

    @property
    def largest_p2(self) -> Fraction:
        """Return the largest penalty of a larger step."""
        return max(Fraction(self.p2), Fraction(self.gamma))


class InverseSgm(_Penalties):
    """Penalty of a larger step that falls with the gradient of the left image by an inverse law (Banz et al. 2012)."""

    penalty: Literal["inverse"] = Field("inverse", description="p2 is gamma + alpha / (gradient + beta)")
    p1: int = Field(8, ge=1, description="penalty of a disparity step of one pixel")
    p2: int = Field(32, ge=1, description="least penalty of a larger step, at least p1")
    alpha: float = Field(ge=0, description="numerator of the part that decreases with the gradient")
    beta: float = Field(gt=0, description="gradient, in grey values, that halves this part")
    gamma: float = Field(ge=0, description="penalty of a larger step at an infinite gradient")

    @property
    def largest_p2(self) -> Fraction:
        """Return the largest penalty of a larger step."""
        return max(Fraction(self.p2), Fraction(self.gamma) + Fraction(self.alpha) / Fraction(self.beta))


class MccnnSgm(_Penalties):
    """Penalties of MC-CNN, in units of the cosine; smaller where an image has an edge along the path."""

    penalty: Literal["mc_cnn_fast"] = Field(
        "mc_cnn_fast", description="smaller where the images have edges; or constant"
    )
    p1: Exact = Field(Decimal("0.5"), gt=0, description="penalty of a disparity step of one pixel")
    p2: Exact = Field(Decimal("0.75"), gt=0, description="penalty of a larger step, at least p1")
    q1: Exact = Field(Decimal(3), ge=1, description="divides p1 and p2 where one image has an edge")
    q2: Exact = Field(Decimal(6), ge=1, description="divides them further where both have one")
    v: Exact = Field(Decimal("1.5"), ge=1, description="divides p1 on the vertical paths")
    d: float = Field(0.08, ge=0, description="gradient above which a pixel is an edge")
    gradients: Literal["normalized", "raw"] = Field(
        "normalized", description="in standard deviations, right at each candidate; or as the reference code"
    )
    span: Exact = Field(Decimal(16), gt=0, description="span of the aggregated cost, for etas and alpha")

    @model_validator(mode="after")
    def _check_span(self) -> Self:
        """Raise if penalties are changed and span is not: its default fits the default penalties only."""
        defaults = {key: field.default for key, field in type(self).model_fields.items()}
        changed = [key for key in defaults if getattr(self, key) != defaults[key]]
        if changed and "span" not in self.model_fields_set:
            raise ValueError(
                f"span is missing: its default, {self.span}, fits only the default penalties, not another "
                f"{' and '.join(changed)}: give one (see config --preset mccnn)"
            )
        return self

    @property
    def largest_p2(self) -> Fraction:
        """Return the largest penalty of a larger step."""
        return Fraction(self.p2)


# Differs from every value of penalty.
COSINE = "constant with span"


def sgm_kind(section: Any) -> str | None:
    """Return the discriminator of a section: its penalty, or COSINE for constant penalties with a span."""
    has = section.__contains__ if isinstance(section, Mapping) else lambda key: hasattr(section, key)
    if not has("penalty"):
        return None
    penalty = section["penalty"] if isinstance(section, Mapping) else section.penalty
    return COSINE if penalty == "constant" and has("span") else str(penalty)


AnySgm = Annotated[
    Annotated[Sgm, Tag("constant")]
    | Annotated[NegativeSgm, Tag("negative")]
    | Annotated[InverseSgm, Tag("inverse")]
    | Annotated[MccnnSgm, Tag("mc_cnn_fast")]
    | Annotated[CosineSgm, Tag(COSINE)],
    Discriminator(sgm_kind),
]
