"""Matching of two arrays in memory as one tile, without files, store or scheduler."""

import logging
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr

from sat_intervals.config import Config, load_config, resolved, unreached
from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.around import with_agreement
from sat_intervals.match.labelled import labelled
from sat_intervals.match.memory import check_memory, volume_bytes
from sat_intervals.match.whole import match_whole
from sat_intervals.prepare.pair import ArrayPair
from sat_intervals.prepare.prepared import prepare
from sat_intervals.products import as_json

_LOG = logging.getLogger(__name__)

Array = np.ndarray | xr.DataArray


def match_arrays(left: Array, right: Array, config: Config | Mapping[str, Any] | None = None) -> xr.Dataset:
    """Match two epipolar images in memory.

    Parameters
    ----------
    left, right
        ``(rows, columns)`` real numbers; the numbers of columns may differ. Rows correspond, or are made to, see the
        setting ``rows``. NaN, infinity and the masked pixels of a masked array are no data.
    config
        Settings, or a mapping as `load_config` takes it, by default those of satellite images; ``tiles`` has no effect.
        A search range that is auto is found first.

    Returns
    -------
    Dataset
        ``disparity``, ``lower``, ``upper``, ``width`` (pixels), ``confidence`` (0 to 1), float32, ``validity``, uint16
        flags, and ``sigma`` (pixels) if the settings ask for it; with the dimensions and coordinates of a left
        DataArray, else ``y`` and ``x``. The attribute ``rows`` has the row offsets that were taken out of the right
        image, as JSON.

    Raises
    ------
    SatIntervalsError
        If the arrays do not fit each other or the search range, or the volume does not fit in memory.
    """
    return _matched(left, right, load_config(config))


def intervals_around(
    left: Array, right: Array, disparity: Array, config: Config | Mapping[str, Any] | None = None
) -> xr.Dataset:
    """Judge the disparities of another matcher: match around them, and look whether they are in the intervals.

    Parameters
    ----------
    left, right
        Images as of `match_arrays`.
    disparity
        ``(rows, columns)`` of the left image, ``x_right = x_left + disparity`` in pixels; not finite, or masked, where
        there is none.
    config
        Settings, as `load_config` takes them; by default those of the preset ``satellite``. Cells of 64 x 64 pixels
        search the range of their disparities with ``disparity.margin`` on both sides; those without any the whole
        range, which is that of all cells unless it is given.

    Returns
    -------
    Dataset
        That of `match_arrays`, and ``agreement``, float32: 1 where the given disparity is in the interval, 0 where it
        is not, NaN where one of them is missing. Disparities and intervals are ours: the given ones only decide where
        is searched.

    Raises
    ------
    SatIntervalsError
        As `match_arrays`; the disparities have another shape than the left image, or there are none.
    """
    given = _image(_pixels(disparity, "disparity")).filled(np.nan)
    local = {"disparity": {"local": True, "grid": None, "around": None}}
    return _matched(left, right, load_config(load_config(config), local), given)


def _matched(left: Array, right: Array, config: Config, given: np.ndarray | None = None) -> xr.Dataset:
    """Match two images, around ``given`` disparities if there are some."""
    config = resolved(config)
    if missed := unreached(config):
        _LOG.warning("%s", missed)
    pixels = _pixels(left, "left"), _pixels(right, "right")
    _check_shapes(*pixels, given)
    if not config.disparity.is_auto:
        _check_memory(pixels[0], config)
    prepared = prepare(ArrayPair(_image(pixels[0]), _image(pixels[1]), given), config, measures_rows=False)
    config, images = prepared.config, prepared.pair.images
    _check_memory(pixels[0], config)
    final = match_whole(*images, config, prepared.statistics, prepared.ranges)
    labels = left if isinstance(left, xr.DataArray) else xr.DataArray(images[0], dims=("y", "x"))
    if given is not None:
        final = with_agreement(final, given)
    rows = {"rows": as_json(asdict(prepared.rows), indent=None)} if prepared.rows else {}
    return labelled(final, labels, {"preset": config.preset} | rows)


def _pixels(array: Array, side: str) -> np.ma.MaskedArray:
    """Pixels of an array as given; raise if it is not an image."""
    values = np.ma.asanyarray(array.data if isinstance(array, xr.DataArray) else array)
    if values.ndim != 2 or values.dtype.kind not in "uif":
        raise SatIntervalsError(
            f"the {side} array has {values.ndim} dimensions of {values.dtype}: "
            "give 2 dimensions, rows and columns, of real numbers"
        )
    is_long = values.dtype in (np.int64, np.uint64)
    if is_long and ((values.compressed() > 2**53) | (values.compressed() < -(2**53))).any():
        raise SatIntervalsError(
            f"the {side} array has {values.dtype} values that float64 cannot represent, which would lose texture: "
            "subtract an offset"
        )
    return values


def _image(pixels: np.ma.MaskedArray) -> np.ma.MaskedArray:
    """Convert pixels to float and mask no data."""
    dtype = np.float32 if np.can_cast(pixels.dtype, np.float32) else np.float64
    return np.ma.masked_invalid(pixels.astype(dtype))


def _check_shapes(left: np.ndarray, right: np.ndarray, given: np.ndarray | None) -> None:
    if left.shape[0] != right.shape[0]:
        raise SatIntervalsError(
            f"the left array has {left.shape[0]} rows, the right {right.shape[0]}, but rows must correspond: "
            "resample the pair together"
        )
    if 0 in left.shape or 0 in right.shape:
        raise SatIntervalsError(f"nothing to match: shapes {left.shape} and {right.shape}")
    if given is not None and given.shape != left.shape:
        raise SatIntervalsError(f"the disparities are {given.shape}, the left array {left.shape}: give one a pixel")


def _check_memory(left: np.ndarray, config: Config) -> None:
    rows, columns = left.shape
    check_memory(
        volume_bytes(rows, columns, config),
        f"{rows} x {columns} pixels x {config.disparity.count} disparities",
        "write the arrays to files and use match_pair, which works in tiles",
    )
