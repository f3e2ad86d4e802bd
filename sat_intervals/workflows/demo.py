"""Write raw images of a procedural scene with exact truth, as satellites with imperfect models would see it."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.demo import DATUM, PIXEL, make_views
from sat_intervals.errors import InputError
from sat_intervals.raster import Georeferencing, Projection, fitted_rpc, north_up, read_layers, write_layer
from sat_intervals.raster.publishing import check_free

# Where the scene stands: a map, and the corner of its first pixel.
CRS = "EPSG:32631"
LEFT = 370_000.0
TOP = 4_830_000.0
# Half of the largest base-to-height ratio of three images, and of more; pixels of the errors of models (sigma).
_FEW = 0.15
_MANY = 0.35
ERROR = 0.7
# Metres above and below the datum that models are made for.
_REACH = 80.0
_TAGS = {"SOFTWARE": "sat-intervals"}


def slants_of(count: int) -> np.ndarray:
    """Return the slants of views spread along an orbit, in pixels per metre."""
    half = _FEW if count <= 3 else _MANY
    return np.linspace(-half, half, count) / PIXEL


def errors_of(count: int, seed: int, date: int = 0) -> np.ndarray:
    """Return rows and columns by which models are off, ``(views, 2)`` pixels, with mean 0."""
    errors = np.random.default_rng([seed, 3, date]).normal(0, ERROR, (count, 2))
    return np.asarray(errors - errors.mean(axis=0))


def write_views(
    folder: Path,
    rows: int,
    columns: int,
    count: int,
    seed: int = 0,
    *,
    date: int = 0,
    overwrite: bool = False,
    **scene: Any,
) -> tuple[list[Path], Path]:
    """Write raw images with RPC models that are off, and the true heights; return their paths.

    ``scene`` and ``date`` are further arguments of `make_views`. What is there already is kept.
    """
    slants, errors = slants_of(count), errors_of(count, seed, date)
    images, heights = make_views(rows, columns, slants.tolist(), seed, date=date, **scene)
    reach = _REACH + float(np.abs(heights).max())
    nodes = np.meshgrid(np.linspace(0, rows, 7), np.linspace(0, columns, 7), DATUM + reach * np.linspace(-1, 1, 3))
    row, column, height = (axis.ravel() for axis in nodes)
    longitude, latitude = Projection(CRS).degrees(LEFT + PIXEL * (column + 0.5), TOP - PIXEL * (row + 0.5))
    ground = np.stack([longitude, latitude, height], axis=1)
    paths = [folder / f"{number}.tif" for number in range(1, count + 1)]
    for path, pixels, slant, error in zip(paths, images, slants, errors, strict=True):
        places = np.stack([row, column + slant * (height - DATUM)], axis=1) + error
        write_once(path, pixels, 0, Georeferencing(), overwrite=overwrite, rpcs=fitted_rpc(ground, places))
    truth = folder / "truth.tif"
    write_once(truth, heights, float("nan"), north_up(CRS, LEFT, TOP, PIXEL), overwrite=overwrite)
    return paths, truth


def write_once(
    path: Path, pixels: np.ndarray, nodata: float, place: Georeferencing, *, overwrite: bool, **options: Any
) -> None:
    """Write a layer, unless the file has it already: a rerun resumes."""
    if path.is_file():
        with suppress(InputError):
            if np.array_equal(read_layers(path), pixels[np.newaxis], equal_nan=pixels.dtype.kind == "f"):
                return
    check_free(path, overwrite=overwrite)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_layer(path, pixels, nodata, place, _TAGS, **options)
