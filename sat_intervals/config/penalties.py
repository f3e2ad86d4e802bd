"""Sections of semi-global matching, one for each kind of penalties."""

from decimal import Decimal
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from sat_intervals.config.sections import Exact, Section


class _Penalties(Section):
    """Semi-global matching over 8 paths (Hirschmuller 2008); penalties are bits, or with MC-CNN units of the cosine."""

    penalty: str
    p1: Exact
    p2: Exact

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.p1 > self.p2:
            raise ValueError(f"p1 {self.p1} is above p2 {self.p2}, the penalty of a larger step: give p1 <= p2")
        return self

    def at_edges(self) -> tuple[list[list[Decimal]], list[list[Decimal]], float] | None:
        """Return p1 and p2 where the images have edges, and the gradient of an edge in standard deviations, if any.

        Rows are paths, the last one vertical; columns the number of images with an edge.
        """
        return None


class Sgm(_Penalties):
    """Constant penalties."""

    penalty: Literal["constant"] = Field("constant", description="the same everywhere, or mc_cnn_fast with mccnn")
    p1: Exact = Field(Decimal(24), gt=0, description="penalty of a disparity step of one pixel; whole with census")
    p2: Exact = Field(Decimal(144), gt=0, description="penalty of a larger step, at least p1; whole with census")
    span: Exact | None = Field(
        None, gt=0, description="span of the aggregated cost, for etas and alpha; with census it follows from p2"
    )


class MccnnSgm(_Penalties):
    """Penalties of MC-CNN that are smaller where an image has an edge along the path."""

    penalty: Literal["mc_cnn_fast"] = Field(
        "mc_cnn_fast", description="smaller where the images have edges; or constant"
    )
    p1: Exact = Field(Decimal("0.5"), gt=0, description="penalty of a disparity step of one pixel")
    p2: Exact = Field(Decimal("0.75"), gt=0, description="penalty of a larger step, at least p1")
    q1: Exact = Field(Decimal(3), ge=1, description="divides p1 and p2 where one image has an edge")
    q2: Exact = Field(Decimal(6), ge=1, description="divides them further where both have one")
    v: Exact = Field(Decimal("1.5"), ge=1, description="divides p1 on the vertical paths")
    d: float = Field(0.08, ge=0, description="gradient above which a pixel is an edge, in standard deviations")
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

    def at_edges(self) -> tuple[list[list[Decimal]], list[list[Decimal]], float]:
        """Return p1 and p2, divided where images have edges."""
        p1, p2 = ([one / divisor for divisor in (1, self.q1, self.q1 * self.q2)] for one in (self.p1, self.p2))
        return [p1, p1, p1, [one / self.v for one in p1]], [p2] * 4, self.d


AnySgm = Annotated[Sgm | MccnnSgm, Field(discriminator="penalty")]
