"""Make an epipolar pair of two raw images, and compare its rows."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sat_intervals.config import load_config
from sat_intervals.heights.rectify import RawPair, make_pair
from sat_intervals.progress import Progress
from sat_intervals.raster import Image, open_image, path_of
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers, pool_of
from sat_intervals.run.preparing import compared_rows
from sat_intervals.run.quality import doubts_of_images


def rectify(
    left: str | Path | Image,
    right: str | Path | Image,
    out: str | Path,
    *,
    left_model: str | Path | None = None,
    right_model: str | Path | None = None,
    dem: str | Path | None = None,
    altitude: float | None = None,
    geoid: str | Path | None = None,
    resolution_of: str | None = None,
    compares_rows: bool = True,
    overwrite: bool = False,
    config: Any = None,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Resample two raw images to an epipolar pair, with its grids.

    Parameters
    ----------
    left, right
        Paths of raw images, or images opened by `open_image` with a band, a no-data value or a mask.
    out
        Folder for ``left.tif``, ``right.tif``, ``left_grid.tif``, ``right_grid.tif`` and ``rectify.json``. What it has
        of the same inputs and settings is kept.
    left_model, right_model
        RPC models, see `set_geometry`; by default those in or beside the images.
    dem
        Raster of heights (metres) that have disparity 0.
    altitude
        Metres above the ellipsoid that have disparity 0, instead of a DEM; by default the middle of the ground's.
    geoid
        Grid of geoid heights that the heights of ``dem`` refer to; by default the ellipsoid.
    resolution_of
        Whose pixel size to take if they differ by more than 10 %: ``coarser`` (default) or ``left``.
    compares_rows
        Whether to measure how far rows of the pair differ.
    overwrite
        Whether a pair in ``out`` that was made otherwise may be replaced.
    config
        Settings, or a source for `load_config`, by default those of satellite images; their ``cluster`` says where the
        images are resampled.
    progress
        Callback, see `Progress`.

    Returns
    -------
    The content of ``rectify.json``: ``inputs``, ``settings``, ``altitude`` (metres, None with a DEM),
    ``base_to_height``, ``metres_per_disparity``, ``pixel_size`` (metres), ``overlap`` (share), ``footprint`` (degrees),
    ``size`` (rows, columns), ``rows`` (None if they were not compared) and others; and ``warnings``, lines about the
    images.

    Raises
    ------
    SatIntervalsError
        Images, models or heights cannot be used, or the folder holds a pair made otherwise.
    """
    raw: dict[str, Any] = {"left_model": left_model, "right_model": right_model, "dem": dem, "altitude": altitude}
    raw |= {"geoid": geoid, "resolution_of": resolution_of, "compares_rows": compares_rows, "overwrite": overwrite}
    images = [one if isinstance(one, Image) else open_image(one) for one in (left, right)]
    out = path_of(out)
    with Connection(load_config(config).cluster, out) as connection:
        return rectified(images, out, pool_of(connection, out, progress), **raw)


def rectified(
    images: Sequence[Image],
    out: Path,
    pool: EachOnWorkers,
    *,
    compares_rows: bool = False,
    overwrite: bool = False,
    **raw: Any,
) -> dict[str, Any]:
    """Resample two raw images on workers; ``raw`` are arguments of `rectify`, and ``side``, see `RawPair`."""
    from sat_intervals.heights.epipolar import Terrain  # needs the extra `dsm`

    left, right = images
    dem, geoid, left_model, right_model = (
        None if raw.get(name) is None else path_of(raw[name]) for name in ("dem", "geoid", "left_model", "right_model")
    )
    terrain = Terrain(dem, raw["altitude"], geoid)
    pair = RawPair(left, right, (left_model, right_model), terrain, raw["resolution_of"] or "coarser", raw.get("side"))
    compare = partial(compared_rows, each=pool) if compares_rows else None
    record = make_pair(pair, out, pool, overwrite=overwrite, compare=compare)
    return record | {"warnings": doubts_of_images(left, right)}
