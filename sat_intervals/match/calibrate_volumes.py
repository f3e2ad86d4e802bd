"""Calibrations of intervals of volumes of another matcher, from volumes with truth (docs/volumes.md)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sat_intervals.config import Calibration, Config, ConfigError, key_of
from sat_intervals.match.external import open_external
from sat_intervals.match.gauge import Gauge, at_levels, block_numbers, pairs_of
from sat_intervals.match.levels import calibration_of_parts
from sat_intervals.match.measurement import Measured, threshold_sweep
from sat_intervals.match.volume import unmasked
from sat_intervals.match.volumes import Kind, Values, costs_of, flags_of, matched_volume, volume_config
from sat_intervals.match.whole import scale_of_rows

_FEWEST = 1000  # pixels with truth, of all volumes
_AMONG = 0.5  # of the truths of a volume that must be among its candidates


def calibrate_volumes(
    pairs: Sequence[tuple[Values, Any]],
    disparities: Sequence[float] | np.ndarray | None = None,
    *,
    kind: Kind | None = None,
    span: float | tuple[float, float] | None = None,
    tolerance: float = 0.0,
    name: str = "volumes",
    config: Config | Mapping[str, Any] | None = None,
) -> Calibration:
    """Find the levels at which intervals of the volumes of one matcher contain shares of true disparities.

    Parameters
    ----------
    pairs
        Each a volume, as of `intervals_of`, and the true disparities of its pixels, ``(rows, columns)`` in pixels, NaN
        where unknown. Each weighs the same. Coverages are expected of pairs that were left out, of a single one of
        blocks that were left out.
    disparities, kind, span
        As of `intervals_of`, of all volumes.
    tolerance
        Distance in pixels up to which a truth outside an interval counts as inside, such as half a step of the truth.
    name
        Of the calibration.
    config
        Settings, those that `intervals_of` is later called with, without a coverage.

    Returns
    -------
    Calibration
        Give it to `intervals_of` as ``{"interval": {"coverage": 0.9, "calibration": calibration}}`` in the settings.
        ``calibration.model_dump(mode="json")`` is the content of a file of one.

    Raises
    ------
    SatIntervalsError
        A volume or its truth cannot be used; fewer than 1000 pixels have a truth.
    """
    parts: list[Measured] = []
    described, pairs = [], list(pairs)
    for number, (volume, truth) in enumerate(pairs):
        external = open_external(volume, disparities, kind, span)
        settings = volume_config(external, config)
        if missing := [step for step in ("ambiguity", "regularization") if getattr(settings, step) is None]:
            raise ConfigError(f"{' and '.join(missing)} is null, but a calibration needs confidence: leave it on")
        true = unmasked(truth.data if isinstance(truth, xr.DataArray) else truth).astype(np.float64)
        if true.shape != external.shape[:2]:
            raise ConfigError(f"truth {number} is {true.shape}, its volume {external.shape[:2]}: give one a pixel")
        thresholds, flags = threshold_sweep(settings), flags_of(None, external.shape)
        gauge = Gauge(thresholds, f"volume {number}", tolerance / external.step, in_blocks=len(pairs) == 1)
        blocks = block_numbers(0, len(true), true.shape) if len(pairs) == 1 else np.zeros(true.shape, np.int64)
        known = true[np.isfinite(true)]
        among = np.mean((known >= external.disparities[0]) & (known <= external.disparities[-1])) if known.size else 1.0
        if among < _AMONG:
            raise ConfigError(
                f"{100 * among:.0f} % of the disparities of truth {number} are among the candidates: check their sign, "
                "x_right = x_left + disparity"
            )
        true = (true - external.first) / external.step + settings.disparity.minimum
        cost = costs_of(external, flags, settings)
        for pair in pairs_of(thresholds):
            high, low = (float(thresholds.low[threshold]) for threshold in pair)
            rows, chosen = matched_volume(external, cost, flags, None, at_levels(settings, high, low, None))
            scale = scale_of_rows(rows, chosen)
            gauge.add(rows, slice(0, len(true)), scale, (true, blocks), pair, chosen)
        parts += gauge.measured()
        ends = [float(external.disparities[0]), float(external.disparities[-1])]
        described.append({"name": f"volume {number}", "search_range": ends, "tolerance": tolerance})
    if (kept := sum(part.kept for part in parts)) < _FEWEST:
        raise ConfigError(f"{kept} kept pixels have a truth, at least {_FEWEST} are needed: give more pairs")
    return calibration_of_parts(parts, settings, name, described, key_of(settings))[0]
