"""Intervals from the cost volume of another matcher (docs/volumes.md)."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import xarray as xr

from sat_intervals.config import Config, ConfigError, load_config, resolved
from sat_intervals.kernels.disparity import cross_check
from sat_intervals.match.external import ExternalVolume, open_external
from sat_intervals.match.labelled import labelled
from sat_intervals.match.matching_cost import AreaCosts
from sat_intervals.match.memory import check_memory, volume_bytes
from sat_intervals.match.patch import PatchFrame, match_patch
from sat_intervals.match.postprocess import RawRows
from sat_intervals.match.volume import external_costs, integer_costs
from sat_intervals.match.whole import finish_whole
from sat_intervals.products import IMPOSSIBLE_COST, INVALID, LEFT_MASKED, NO_DISPARITY, REJECTED, Bands
from sat_intervals.tiling import Window, strips

Kind = Literal["cost", "similarity", "probability"]
Values = np.ndarray | xr.DataArray | xr.Dataset
# Pixels of rows that are converted at a time.
_PIXELS = 1 << 14


def intervals_of(
    volume: Values,
    disparities: Sequence[float] | np.ndarray | None = None,
    *,
    kind: Kind | None = None,
    span: float | tuple[float, float] | None = None,
    valid: np.ndarray | xr.DataArray | None = None,
    right: Values | None = None,
    config: Config | Mapping[str, Any] | None = None,
) -> xr.Dataset:
    """Turn the cost volume of another matcher into disparities with intervals.

    Parameters
    ----------
    volume
        Array ``(rows, columns, disparities)`` of real numbers; a DataArray, whose dimension of disparities is named
        ``disp`` or ``disparity``, in any order; or a dataset of Pandora with ``cost_volume``. Values that are not
        finite mark impossible candidates.
    disparities
        Of the candidates, in pixels, ascending and evenly spaced, also by fractions of a pixel; by default the
        coordinate of the DataArray. ``x_right = x_left + disparity``.
    kind
        ``cost``: the smallest value is the best. ``similarity``: the largest. ``probability``: the values of a pixel
        sum to 1, such as a softmax; the possibility of a candidate is its probability over the largest of the pixel.
        By default that of Pandora's ``type_measure``.
    span
        Largest possible value minus the smallest, which is then 0, or both ends ``(smallest, largest)``. It is a
        property of the matcher, declared and not measured, so that a result does not depend on the part of an image.
        With a similarity of Pandora the largest is its ``cmax``. Not with probabilities.
    valid
        ``(rows, columns)``: bool, False where the left pixel is no data; or uint16 validity flags, ours or Pandora's.
    right
        Volume of the right image, for cross-checking, with candidates ``-disparities[::-1]`` if it is an array. By
        default right pixels are looked up along the diagonals of ``volume``.
    config
        Settings, as `load_config` takes them; by default those of the preset ``paper``. ``cost`` and ``disparity`` are
        those of the volume. ``sgm: true`` runs SGM on the volume, with penalties of 1/2 and 3 times the span, or give
        ``p1`` and ``p2`` in the unit of the values; by default there is none. A ``coverage`` needs a calibration of
        `calibrate_volumes`. Disparities are refined by V-fit only, for least squares needs the images.

    Returns
    -------
    Dataset
        That of `match_arrays`, with dimensions ``y`` and ``x``. Without images, textureless pixels are not known.

    Raises
    ------
    SatIntervalsError
        The volume cannot be used, or the settings do not fit it.
    """
    external = open_external(volume, disparities, kind, span)
    settings = volume_config(external, config)
    if settings.interval and settings.has_coverage and settings.interval.calibration is None:
        raise ConfigError(
            "interval.coverage needs a calibration of volumes of this matcher: make one with calibrate_volumes, or "
            "give interval.alpha"
        )
    settings = resolved(settings)
    flags = flags_of(valid, external.shape)
    rows, settings = matched_volume(external, costs_of(external, flags, settings), flags, right, settings)
    return labelled(_in_pixels(finish_whole(rows, settings), external, settings), external.labels, {})


def volume_config(external: ExternalVolume, config: Config | Mapping[str, Any] | None) -> Config:
    """Return settings for a volume."""
    given: Any = config if isinstance(config, Config) else {"preset": "paper", **(config or {})}
    sgm = {"sgm": given["sgm"]} if isinstance(config, Mapping) and "sgm" in config else {}
    first = external.first_index
    search = {"minimum": first, "maximum": first + external.shape[2] - 1, "local": False, "grid": None, "around": None}
    found = load_config(given, {"cost": external.cost, "disparity": search, **sgm})  # not the penalties of another cost
    if found.fits:
        found = load_config(found, {"refinement": {"method": "vfit"}, "products": {"sigma": False}})
    return found


def costs_of(external: ExternalVolume, flags: np.ndarray, config: Config) -> AreaCosts:
    """Return the costs of a volume; ``flags`` are those of pixels that are not matched, see `flags_of`."""
    rows, columns, count = external.shape
    check_memory(volume_bytes(rows, columns, config), f"{rows} x {columns} x {count} values", "give parts of it")
    return external_costs(integer_costs(external.values, config, flags != 0), count, config)


def matched_volume(
    external: ExternalVolume, cost: AreaCosts, flags: np.ndarray, right: Values | None, config: Config
) -> tuple[RawRows, Config]:
    """Return the raw products of a volume, cross-checked already if the settings that come back have none."""
    rows, columns, _ = external.shape
    checks = config.cross_check
    is_plain = right is None and external.step == 1 and external.kind != "probability"
    if checks and not is_plain:
        config = config.model_copy(update={"cross_check": None})
    raw, _, right_view, _ = match_patch(PatchFrame.of_whole(Window(0, 0, rows, columns)), [cost], config)
    if not (raw.winner != NO_DISPARITY).any():
        raise ConfigError("the volume has no finite value at any valid pixel")
    np.copyto(raw.validity, flags, where=flags != 0)
    if checks and not is_plain:
        minimum, winners = (
            _of_right(external, right, config) if right is not None else _of_diagonals(external, flags, config)
        )
        found = external.first + external.step * (raw.winner.astype(np.float64) - config.disparity.minimum)
        last = minimum + winners.shape[1] - columns
        whole = np.clip(np.floor(found + 0.5), minimum, last).astype(np.int16)
        whole[raw.winner == NO_DISPARITY] = NO_DISPARITY
        np.bitwise_or(raw.validity, cross_check(whole, winners, minimum, checks.tolerance), out=raw.validity)
    return RawRows.of(raw, right_view), config


def flags_of(valid: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return the flags of pixels that are not matched, uint16, 0 for the others."""
    if valid is None:
        return np.zeros(shape[:2], np.uint16)
    given = np.asarray(valid)
    if given.shape != shape[:2] or given.dtype not in (np.bool_, np.uint16):
        raise ConfigError(
            f"valid is {given.shape} of {given.dtype}: give {shape[:2]} of bool, such as mask != 0, or of "
            "validity flags (uint16)"
        )
    if given.dtype == np.bool_:
        return np.where(given, 0, LEFT_MASKED).astype(np.uint16)
    return (given & (INVALID & ~REJECTED)).astype(np.uint16)


def _of_right(external: ExternalVolume, right: Values, config: Config) -> tuple[int, np.ndarray]:
    """Return the winners of another volume, in the layout of `cross_check`, and the first disparity of that layout."""
    disparities = None if isinstance(right, xr.Dataset | xr.DataArray) else -external.disparities[::-1]
    span = None if external.kind == "probability" else (external.lowest, external.highest)
    there = open_external(right, disparities, external.kind, span)
    if there.shape[0] != external.shape[0]:
        raise ConfigError(f"the right volume has {there.shape[0]} rows, the left one {external.shape[0]}")
    settings = volume_config(there, config)
    cost = costs_of(there, np.zeros(there.shape[:2], np.uint16), settings)
    raw = match_patch(PatchFrame.of_whole(Window(0, 0, *there.shape[:2])), [cost], settings).raw
    back = np.floor(0.5 - (there.first + there.step * (raw.winner.astype(np.float64) - settings.disparity.minimum)))
    back[raw.winner == NO_DISPARITY] = NO_DISPARITY
    first, last = int(np.floor(external.disparities[0])), int(np.ceil(external.disparities[-1]))
    winners = np.full((external.shape[0], external.shape[1] + last - first), NO_DISPARITY, np.int16)
    start = max(0, first)
    stop = max(start, min(there.shape[1], first + winners.shape[1]))
    winners[:, start - first : stop - first] = back[:, start:stop]
    return first, winners


def _of_diagonals(external: ExternalVolume, flags: np.ndarray, config: Config) -> tuple[int, np.ndarray]:
    """Return the same along the diagonals of the volume, among the candidates at whole pixels."""
    every, start = external.whole_pixels
    if every == 0 or config.sgm:
        raise ConfigError(
            f"candidates {external.step:g} px apart{' with sgm' if config.sgm else ''} have no diagonals to "
            "cross-check with: give right, or cross_check null"
        )
    minimum = round(external.first + start * external.step)
    found = []
    for window in strips(*external.shape[:2], _PIXELS):
        values = external.values[window.row : window.row_stop, :, start::every]
        blocked = flags[window.row : window.row_stop] != 0
        costs = integer_costs(values, config, blocked, compares_pixels=True)[:, :, : values.shape[2]]
        costs[costs == config.impossible_cost] = IMPOSSIBLE_COST
        found.append(read_right_winners(costs, minimum))
    return minimum, np.concatenate(found)


def read_right_winners(volume: np.ndarray, minimum: int) -> np.ndarray:
    """Winners of right pixels along the diagonals of a left volume; the largest disparity at ties.

    volume: ``(rows, columns, count)`` uint16, IMPOSSIBLE_COST at impossible candidates.
    Returns ``(rows, columns + count - 1)`` int16 as `cross_check` takes it.
    """
    rows, columns, count = volume.shape
    width = columns + count - 1
    winner = np.full((rows, width), NO_DISPARITY, np.int16)
    for r in range(rows):
        # Each line is one longer than the right image: read as lines of its width, each begins one column later.
        sheared = np.full((count, width + 1), IMPOSSIBLE_COST, np.uint16)
        sheared[:, :columns] = volume[r].T
        facing = sheared.ravel()[: count * width].reshape(count, width)[::-1]
        found = (facing != IMPOSSIBLE_COST).any(axis=0)
        winner[r, found] = minimum + count - 1 - facing.argmin(axis=0)[found]
    return winner


def _in_pixels(bands: Bands, external: ExternalVolume, config: Config) -> Bands:
    """Convert disparities in steps of the candidates to pixels."""
    first = config.disparity.minimum
    if external.step == 1 and external.first == first:
        return bands
    disparity, lower, upper = (
        ((band.astype(np.float64) - first) * external.step + external.first).astype(np.float32) for band in bands[:3]
    )
    return bands._replace(disparity=disparity, lower=lower, upper=upper)
