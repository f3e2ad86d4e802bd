"""All settings of a run, checks across sections, and the integer thresholds derived from them."""

from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from math import ceil, floor, log1p
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from sat_intervals.config import sections
from sat_intervals.config.calibration import Calibration, Levels, at, built_in
from sat_intervals.config.costs import SECTIONS, AnyCost, Census, Numbers
from sat_intervals.config.interval import Interval
from sat_intervals.config.penalties import AnySgm, Sgm
from sat_intervals.config.presets import PRESETS, merged, preset_settings
from sat_intervals.products import BOUND_STEPS, IMPOSSIBLE_COST, LOG_SPAN

SGM_PATHS = 8
_CUT = 0.2  # of the span


class Config(sections.Section):
    """All settings of a run; None in place of a section switches its step off."""

    preset: Literal[PRESETS] = Field(PRESETS[0], description="settings for all keys that are not given")  # type: ignore[valid-type]
    disparity: sections.Disparity = sections.Disparity()
    rows: Literal["auto", "none"] = Field(
        "auto", description="row offsets of the right image: measured and taken out, or left"
    )
    interval: Interval | None = Interval()
    # From here to `regularization` a calibration belongs to the settings, see `key_of`.
    cost: AnyCost = Census()
    sgm: AnySgm | None = Sgm()
    ambiguity: sections.Ambiguity | None = sections.Ambiguity()
    refinement: sections.Refinement | None = sections.Refinement()
    cross_check: sections.CrossCheck | None = sections.CrossCheck()
    median: sections.Median | None = sections.Median()
    regularization: sections.Regularization | None = sections.Regularization()
    tiles: sections.Tiles = sections.Tiles()
    products: sections.Products = sections.Products()
    cluster: sections.Cluster = sections.Cluster()

    @model_validator(mode="before")
    @classmethod
    def _choose_methods(cls, values: Any) -> Any:
        """Add what the preset has for missing keys, and the penalties of the cost."""
        if not isinstance(values, Mapping):
            return values
        preset = values.get("preset", PRESETS[0])
        values = merged(preset_settings(preset) if preset in PRESETS else {}, values)
        cost, sgm = values.get("cost"), values.get("sgm", {})
        cost = cost if isinstance(cost, Mapping) else {}
        return values | {"sgm": SECTIONS.get(str(cost.get("method")), Census).completed(cost, sgm)}

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
        if not self.cost.has_right_view and (self.disparity.is_local or self.matches_right_view):
            raise ValueError(
                f"cost.method {self.cost.method} goes with one search range and cross_check.method fast: leave out "
                "local ranges and accurate"
            )
        if not self.cost.compares_two and (self.cross_check or self.fits or self.disparity.around):
            raise ValueError(
                f"cost.method {self.cost.method} has no right image: set cross_check to null, refinement.method to "
                "vfit or planes, and leave out around"
            )
        # Neighbouring tiles are compared on a ring of one pixel around the core, which needs complete windows.
        smallest = self.cost.window // 2 + 1
        if self.tiles.overlap != "exact" and self.tiles.overlap < smallest:
            raise ValueError(f"tiles.overlap is {self.tiles.overlap}, allowed: >= {smallest} with {self.cost.words}")
        return self

    def _check_sgm(self, sgm: AnySgm) -> None:
        self.cost.check_penalties(sgm)
        # The largest uint16 marks the summed cost of an impossible candidate.
        largest = (IMPOSSIBLE_COST - 1) // SGM_PATHS - self.numbers.largest
        if self.largest_p2 > largest:
            raise ValueError(
                f"sgm.p2 is {sgm.p2}, allowed: <= {largest // self.numbers.steps} with {self.cost.words}, so that "
                f"costs summed over {SGM_PATHS} paths fit in 16 bits"
            )
        if self.cost_span > self.largest_sum:
            raise ValueError(
                f"sgm.span is {sgm.span}, allowed: <= {float(self.largest_sum / self.numbers.steps):g} with p2 {sgm.p2}"
            )

    @property
    def numbers(self) -> Numbers:
        """Return the integer costs before SGM."""
        return self.cost.numbers(Fraction(self.sgm.p2) if self.sgm else None)

    def in_steps(self, value: Decimal | float | Fraction) -> int:
        """Round a cost in units of the settings to the nearest integer cost."""
        return floor(Fraction(value) * self.numbers.steps + Fraction(1, 2))

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
        return self.numbers.largest + self.largest_p2 + self.numbers.gap

    @property
    def largest_sum(self) -> int:
        """Return the largest possible cost, after SGM if it is on; the smallest is 0."""
        return self.numbers.largest if self.sgm is None else SGM_PATHS * (self.numbers.largest + self.largest_p2)

    @property
    def cost_span(self) -> int:
        """Return the cost span of etas and alpha: largest minus smallest possible cost, or the setting ``sgm.span``."""
        # This is the paper's ``max C_V - min C_V``, declared rather than measured: a span measured on a tile would make
        # the result depend on the tiling. With Census real scenes attain both bounds. With MC-CNN they stay far from
        # them and vary, hence the setting.
        return self.largest_sum if self.sgm is None or self.sgm.span is None else self.in_steps(self.sgm.span)

    def _excess(self, share: Fraction) -> Fraction:
        """Return the excess of the cost at which the possibility has fallen from 1 by a share."""
        if self.cost.is_logarithmic:
            return Fraction(-log1p(-float(share)) / LOG_SPAN) * self.cost_span
        return share * self.cost_span

    @property
    def cut_level(self) -> int | None:
        """Return the largest ``S(d) - min S`` of a cut, ``floor((1 - alpha) * cost_span)``; None without alpha."""
        if self.interval is None or self.interval.alpha is None:
            return None
        return floor(self._excess(1 - Fraction(self.interval.alpha)))

    @property
    def cuts(self) -> Levels | None:
        """Return the levels of the calibration, None without a coverage; `reading.resolved` checks that it fits."""
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
    def has_planes(self) -> bool:
        """Return whether disparities become those of planes through their surroundings."""
        return self.refinement is not None and self.refinement.method != "vfit"

    @property
    def has_coverage(self) -> bool:
        """Return whether intervals have a coverage, and so sub-pixel bounds at two calibrated levels."""
        return self.interval is not None and self.interval.coverage is not None

    @property
    def bound_steps(self) -> int:
        """Return the steps per pixel of bounds in the tiles, a power of two; 1 for bounds in whole pixels."""
        # With a coverage it is 64 up to 1024 disparities; beyond, the largest with which the range fits in 16 bits.
        if not self.has_coverage:
            return 1
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
        if self.cost.is_logarithmic:
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


def key_of(config: Config) -> dict[str, Any]:
    """Return the settings that decide which coverage a level reaches; search range and alpha are not among them."""
    dumped = config.model_dump(mode="json")
    sgm, ambiguity, low = (dumped[name] for name in ("sgm", "ambiguity", "regularization"))
    return {
        "cost": config.cost.key(),
        "sgm": sgm and {name: value for name, value in sgm.items() if value is not None},
        "span": config.cost_span,
        "ambiguity": ambiguity and {name: ambiguity[name] for name in ("eta_max", "eta_step", "normalization")},
        "refinement": dumped["refinement"],
        "cross_check": dumped["cross_check"],
        "median": dumped["median"],
        "confidence": low and {name: low[name] for name in ("threshold", "kernel", "depth")},
    }
