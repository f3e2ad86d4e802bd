"""All settings of a run, checks across sections, and the integer thresholds derived from them."""

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from decimal import Decimal
from fractions import Fraction
from math import ceil, floor, log1p
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from sat_intervals.config.calibration import Calibration, Levels, at, built_in
from sat_intervals.config.interval import Interval
from sat_intervals.config.penalties import AnySgm, MccnnSgm, Sgm
from sat_intervals.config.presets import PRESETS, merged, preset_settings
from sat_intervals.config.sections import (
    Ambiguity,
    Census,
    Cluster,
    CrossCheck,
    Disparity,
    Mccnn,
    Median,
    Products,
    Refinement,
    Regularization,
    Section,
    Tiles,
    Volume,
)
from sat_intervals.config.weights import weights_file
from sat_intervals.products import BOUND_STEPS, IMPOSSIBLE_COST, LOG_SPAN

SGM_PATHS = 8
_CUT = 0.2  # of the span


class Config(Section):
    """All settings of a run; None in place of a section switches its step off."""

    preset: Literal[PRESETS] = Field(PRESETS[0], description="settings for all keys that are not given")  # type: ignore[valid-type]
    disparity: Disparity = Disparity()
    rows: Literal["auto", "none"] = Field(
        "auto", description="row offsets of the right image: measured and taken out, or left"
    )
    cost: Census | Mccnn | Volume = Field(Census(), discriminator="method")
    sgm: AnySgm | None = Sgm()
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
        """Add what the preset has for missing keys, and the penalties of the cost."""
        if not isinstance(values, Mapping):
            return values
        preset = values.get("preset", PRESETS[0])
        values = merged(preset_settings(preset) if preset in PRESETS else {}, values)
        cost, sgm = values.get("cost"), values.get("sgm", {})
        if isinstance(cost, Mapping) and cost.get("method") == "volume":
            values["sgm"] = sgm = _sgm_of_volume(cost, sgm)
        if isinstance(sgm, Mapping):
            is_mccnn = isinstance(cost, Mapping) and cost.get("method") == "mccnn"
            values["sgm"] = {"penalty": "mc_cnn_fast" if is_mccnn else "constant", **sgm}
        return values

    @model_validator(mode="after")
    def _check_sections(self) -> Self:
        if self.sgm is not None:
            self._check_sgm(self.sgm)
        off = [name for name in ("ambiguity", "interval") if getattr(self, name) is None]
        if self.regularization is not None and off:
            raise ValueError(
                f"regularization needs {' and '.join(off)}, set to null: give {' and '.join(off)} or set "
                "regularization to null too"
            )
        if self.has_coverage and self.regularization is None:
            raise ValueError(
                "interval has a coverage and regularization null, but calibrations are for two "
                "classes of confidence, which it makes: give regularization, or alpha instead of the coverage"
            )
        if self.products.sigma and not self.fits:
            raise ValueError("products.sigma needs refinement.method least_squares: give it, or set sigma to false")
        if self.disparity.is_local and self.cross_check and self.cross_check.method == "accurate":
            raise ValueError(
                "disparity has local ranges, which cross_check.method accurate does not know: use fast, or one range"
            )
        if isinstance(self.cost, Volume) and (self.disparity.is_local or self.matches_right_view):
            raise ValueError(
                "cost.method volume goes with one search range and cross_check.method fast: leave out local ranges and "
                "accurate"
            )
        # Neighbouring tiles are compared on a ring of one pixel around the core, which needs complete windows.
        smallest = self.cost.window // 2 + 1
        if self.tiles.overlap != "exact" and self.tiles.overlap < smallest:
            raise ValueError(
                f"tiles.overlap is {self.tiles.overlap}, allowed: >= {smallest} with {self._cost_in_words}"
            )
        return self

    def _check_sgm(self, sgm: Sgm | MccnnSgm) -> None:
        is_census = isinstance(self.cost, Census)
        if isinstance(self.cost, Volume):
            if isinstance(sgm, MccnnSgm) or self.cost.kind == "probability":
                what = f"penalty {sgm.penalty}" if isinstance(sgm, MccnnSgm) else "probabilities"
                raise ValueError(f"sgm is given with {what}, allowed: constant penalties and costs or similarities")
            return
        if is_census and isinstance(sgm, MccnnSgm):
            raise ValueError(f"sgm.penalty is {sgm.penalty}, allowed: constant with cost.method census")
        if is_census and sgm.span is not None:
            raise ValueError("sgm.span is given, but with cost.method census it follows from p2: leave it out")
        if is_census and (fraction := [name for name in ("p1", "p2") if getattr(sgm, name) % 1]):
            raise ValueError(f"sgm.{fraction[0]} is {getattr(sgm, fraction[0])}, allowed: whole numbers with census")
        if not is_census and sgm.span is None:
            raise ValueError(
                "sgm.span is missing: it has no default with cost.method mccnn (see config --preset mccnn)"
            )
        # The largest uint16 marks the summed cost of an impossible candidate.
        largest = (IMPOSSIBLE_COST - 1) // SGM_PATHS - self.cost.largest
        if self.largest_p2 > largest:
            raise ValueError(
                f"sgm.p2 is {sgm.p2}, allowed: <= {largest // self.cost.steps} with {self._cost_in_words}, so that "
                f"costs summed over {SGM_PATHS} paths fit in 16 bits"
            )
        if self.cost_span > self.largest_sum:
            raise ValueError(
                f"sgm.span is {sgm.span}, allowed: <= {self.largest_sum / self.cost.steps:g} with p2 {sgm.p2}"
            )

    @property
    def _cost_in_words(self) -> str:
        return f"cost.window {self.cost.window}" if isinstance(self.cost, Census) else f"cost.method {self.cost.method}"

    @property
    def largest_cost(self) -> int:
        """Return the largest integer cost before SGM; the smallest is 0."""
        if isinstance(self.cost, Volume):
            return self.cost.levels(Fraction(self.sgm.p2) if self.sgm else None)
        return self.cost.largest

    @property
    def steps(self) -> Fraction:
        """Return the number of integer costs of a unit of the settings."""
        if isinstance(self.cost, Volume):
            return self.largest_cost / Fraction(self.cost.span)
        return Fraction(self.cost.steps)

    def in_steps(self, value: Decimal | float | Fraction) -> int:
        """Round a cost in units of the settings to the nearest integer cost."""
        return floor(Fraction(value) * self.steps + Fraction(1, 2))

    @property
    def matches_right_view(self) -> bool:
        """Return whether the right view is matched with its own cost volume, for accurate cross-checking."""
        return self.cross_check is not None and self.cross_check.method == "accurate"

    @property
    def hands_states_on(self) -> bool:
        """Return whether tiles hand path states of SGM to their neighbours."""
        return self.tiles.overlap == "exact" and self.sgm is not None

    @property
    def extra_bands(self) -> tuple[str, ...]:
        """Return the bands after those of every run, see `interval_bands`."""
        asked = {"sigma": self.products.sigma, "agreement": self.disparity.around is not None}
        return tuple(name for name, is_asked in asked.items() if is_asked)

    @property
    def opens_ends(self) -> bool:
        """Return whether intervals at the ends of the search range are open, with confidence 0."""
        return self.disparity.open_ends or self.has_coverage

    @property
    def largest_p2(self) -> int:
        """Return the largest penalty as an integer cost, 0 without SGM."""
        return 0 if self.sgm is None else self.in_steps(self.sgm.p2)

    @property
    def impossible_cost(self) -> int:
        """Return the cost of an impossible candidate inside SGM, above every possible cost + P2."""
        if isinstance(self.cost, Volume):  # with a whole span as with Census
            return self.largest_cost + self.largest_p2 + 2 * max(1, min(int(self.steps), self.largest_cost // 8))
        return self.cost.ceiling + self.largest_p2 + self.cost.steps

    @property
    def largest_sum(self) -> int:
        """Return the largest possible cost, after SGM if it is on; the smallest is 0."""
        return self.largest_cost if self.sgm is None else SGM_PATHS * (self.largest_cost + self.largest_p2)

    @property
    def cost_span(self) -> int:
        """Return the cost span of etas and alpha: largest minus smallest possible cost, or the setting ``sgm.span``.

        This is the paper's ``max C_V - min C_V``, declared rather than measured: a span measured on a tile would make
        the result depend on the tiling. With Census real scenes attain both bounds. With MC-CNN they stay far from
        them and vary, hence the setting.
        """
        return self.largest_sum if self.sgm is None or self.sgm.span is None else self.in_steps(self.sgm.span)

    @property
    def _is_logarithmic(self) -> bool:
        """Return whether costs are logarithms of probabilities."""
        return isinstance(self.cost, Volume) and self.cost.kind == "probability"

    def _excess(self, share: Fraction) -> Fraction:
        """Return the excess of the cost at which the possibility has fallen from 1 by a share."""
        if self._is_logarithmic:
            return Fraction(-log1p(-float(share)) / LOG_SPAN) * self.cost_span
        return share * self.cost_span

    @property
    def cut_level(self) -> int | None:
        """Return the largest whole ``S(d) - min S`` of the alpha-cut, ``floor((1 - alpha) * cost_span)``.

        None without intervals or with a coverage.
        """
        if self.interval is None or self.interval.alpha is None:
            return None
        return floor(self._excess(1 - Fraction(self.interval.alpha)))

    @property
    def cuts(self) -> Levels | None:
        """Return the calibrated levels of sub-pixel cuts in integer costs, and the quantile of the regularisation.

        None without a coverage. Whether a calibration that is given belongs to the settings is checked by
        `calibrated.resolved`, once a run.
        """
        if self.interval is None or self.interval.coverage is None:
            return None
        given = self.interval.calibration
        calibration = given if isinstance(given, Calibration) else built_in(key_of(self), self.preset)
        return at(calibration, float(self.interval.coverage))

    @property
    def fit_cut(self) -> float:
        """Return the level of the cut that intervals of least squares are made from, that of possibility .8."""
        return _CUT * self.cost_span

    @property
    def fits(self) -> bool:
        """Return whether disparities are refined by least squares."""
        return self.refinement is not None and self.refinement.method == "least_squares"

    @property
    def has_coverage(self) -> bool:
        """Return whether intervals have a coverage, and so sub-pixel bounds at two calibrated levels."""
        return self.interval is not None and self.interval.coverage is not None

    @property
    def bound_steps(self) -> int:
        """Return the steps per pixel of sub-pixel bounds in the tiles, a power of two; 0 for bounds in whole pixels.

        It is 64 up to 1024 disparities; beyond, the largest with which the range fits in 16 bits.
        """
        if not self.has_coverage:
            return 0
        steps = BOUND_STEPS
        while (self.disparity.count - 1) * steps >= np.iinfo(np.uint16).max:
            steps //= 2
        return steps

    @property
    def ambiguity_levels(self) -> tuple[int, ...] | None:
        """Return the largest ambiguous ``S(d) - min S`` of each eta, ``floor(eta * cost_span)``; None if off."""
        if self.ambiguity is None:
            return None
        step = Fraction(self.ambiguity.eta_step)
        count = ceil(Fraction(self.ambiguity.eta_max) / step)
        if self._is_logarithmic:
            return tuple(floor(self._excess(i * step)) for i in range(count))
        levels = step * self.cost_span  # integers from here on: fractions would take longer than matching a small tile
        return tuple(i * levels.numerator // levels.denominator for i in range(count))

    @property
    def largest_ambiguity(self) -> int:
        """Return the ambiguity of a pixel with all disparities ambiguous at every eta, 0 without ambiguity."""
        return len(self.ambiguity_levels or ()) * self.disparity.count

    @property
    def ambiguity_weights(self) -> npt.NDArray[np.uint16] | None:
        """Return the contribution of a candidate to the ambiguity by its ``S(d) - min S``: ``(largest_sum + 1,)``.

        It is the number of levels at or above that value. An impossible candidate contributes ``weights[0]``, the
        number of all levels. None if off.
        """
        levels = self.ambiguity_levels
        if levels is None:
            return None
        below = np.searchsorted(levels, np.arange(self.largest_sum + 1), side="left")
        return (len(levels) - below).astype(np.uint16)


def _sgm_of_volume(cost: Mapping[str, Any], sgm: Any) -> Any:
    """Return the section ``sgm`` of a foreign volume: none by default; penalties follow from its span."""
    if sgm is True or (sgm and isinstance(sgm, Mapping)):
        with suppress(ArithmeticError, ValueError):  # the section names a span that is no number
            span = Decimal(str(cost.get("span", 1)))
            return {"p1": float(span / 2), "p2": float(3 * span), **({} if sgm is True else sgm)}
    return sgm or None


def key_of(config: Config) -> dict[str, Any]:
    """Return all settings that decide which coverage a level reaches, as a calibration holds them.

    Neither the search range nor alpha nor the quantile of the regularisation is among them.
    """
    sections = config.model_dump(mode="json")
    cost, sgm, ambiguity, low = (sections[name] for name in ("cost", "sgm", "ambiguity", "regularization"))
    if isinstance(config.cost, Volume):
        cost = {name: cost[name] for name in ("method", "kind", "span", "lowest")}
    if "weights" in cost:
        with weights_file(cost["weights"]).open("rb") as weights:
            cost["weights"] = hashlib.file_digest(weights, "sha256").hexdigest()
    return {
        "cost": cost,
        "sgm": sgm and {name: value for name, value in sgm.items() if value is not None},
        "span": config.cost_span,
        "ambiguity": ambiguity and {name: ambiguity[name] for name in ("eta_max", "eta_step", "normalization")},
        "refinement": sections["refinement"],
        "cross_check": sections["cross_check"],
        "median": sections["median"],
        "confidence": low and {name: low[name] for name in ("threshold", "kernel", "depth")},
    }
