"""Read the rows of a batch: pairs to match, and images to make surfaces of."""

import os
from collections.abc import Mapping
from dataclasses import field
from glob import glob, has_magic
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BeforeValidator
from pydantic.dataclasses import dataclass
from typing_extensions import TypedDict

from sat_intervals.config.files import load_yaml, set_by_name
from sat_intervals.config.pairs import check_names, checked, read_rows, why
from sat_intervals.config.settings import Config
from sat_intervals.config.wording import known
from sat_intervals.errors import SatIntervalsError, check_absent

# Report of a batch, in its folder. No pair may have its name or that of the folder of job logs.
REPORT = "batch.json"
_RESERVED = (REPORT, "logs")
# Bytes of a pair's name: a folder's name has at most 255, and a store adds a digest.
_LONGEST_NAME = 200
_SENSORS = ("left_model", "right_model", "left_grid", "right_grid")
_COLUMNS = ("name", "left", "right", "images", "minimum", "maximum", "window", "resolution")
_PATHS = ("left_mask", "right_mask", *_SENSORS, "geoid", "dem", "height_calibration", "flatten", "mask")
# Numbers, or text with them.
_SPLIT = BeforeValidator(lambda value: value.split() if isinstance(value, str) else value)
_WINDOW = Annotated[tuple[int, int, int, int], _SPLIT]
_EXTENT = Annotated[tuple[float, float, float, float], _SPLIT]
# Columns that only some rows have.
_ONLY_OF = {
    "two images": (
        *("window", "minimum", "maximum", "radius", "dem", "altitude", "resolution_of", *_PATHS[:6]),
        *("left_nodata", "right_nodata", "left_band", "right_band"),
    ),
    "three images or more": ("extent", "heights"),
}


class Reading(TypedDict, total=False):
    """No-data value and band of both images of a pair, or of one."""

    nodata: float
    band: int
    left_nodata: float
    right_nodata: float
    left_band: int
    right_band: int


class SurfaceOptions(TypedDict, total=False):
    """Further options of the surface model of a row, see `surface`."""

    crs: str
    geoid: Path
    radius: float
    dem: Path
    altitude: float
    resolution_of: str
    height_calibration: Path
    extent: _EXTENT
    heights: Annotated[tuple[float, float], _SPLIT]
    ortho: bool
    fill: float
    flatten: Path
    mask: Path


@dataclass(frozen=True)
class PairOfBatch:
    """One row of a batch: name, images, and the pair's own settings as nested sections.

    ``window`` is the region of the left image to match: row, column, height, width. ``resolution`` is the side of a
    cell in metres of a pair whose surface model is made too, with ``options``, and ``sensors`` are its models and grids
    of left and right; of raw images both models, or None if they belong to the images. With ``more`` images the surface
    is made of all.
    """

    name: str
    left: str
    right: str
    left_mask: str | None = None
    right_mask: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    reading: Reading = field(default_factory=Reading)
    window: _WINDOW | None = None
    sensors: tuple[str, ...] | None = None
    resolution: float | None = None
    options: SurfaceOptions = field(default_factory=SurfaceOptions)
    more: tuple[str, ...] = ()

    @property
    def images(self) -> tuple[str, ...]:
        """Return all images."""
        return self.left, self.right, *self.more


def read_batch(file: Path) -> list[PairOfBatch]:
    """Read the pairs of a batch from a CSV, YAML or JSON file (docs/clusters.md); paths are relative to the file."""
    rows = read_rows(file, ("name", "left", "right"), instead="images")
    pairs = [_of_batch(place, row, file) for place, row in rows]
    check_names((pair.name for pair in pairs), f"{file}: ")
    return pairs


def _of_batch(place: str, row: dict[str, Any], file: Path) -> PairOfBatch:
    columns = (*_COLUMNS, *_PATHS, *Reading.__annotations__, *SurfaceOptions.__annotations__, *Config.model_fields)
    if unknown := [str(key) for key in row if str(key).split(".")[0] not in columns]:
        raise SatIntervalsError(f"{place}: unknown column {unknown[0]!r}{known(unknown[0], columns)}")
    name = str(row.pop("name"))
    if "cluster" in (str(key).split(".")[0] for key in row):
        raise SatIntervalsError(f"{place}: all pairs share one cluster: set it with --config or --cluster")
    is_name = name.isprintable() and len(name.encode()) <= _LONGEST_NAME and os.sep not in name
    if not is_name or name.startswith(".") or name in _RESERVED:
        raise SatIntervalsError(
            f"{place}: name {name!r} cannot be a folder's name: choose another of at most {_LONGEST_NAME} bytes"
        )
    is_surface = "images" in row
    left, right, *more = _images_of(place, row, file)
    others = "two images" if more else "three images or more"
    check_absent({key: row.get(key) for key in _ONLY_OF[others]}, others, f"{place}: ")
    row |= {key: _relative_to(file, str(row[key])) for key in _PATHS if key in row}
    values: dict[str, Any] = {
        key: row.pop(key) for key in ("left_mask", "right_mask", "window", "resolution") if key in row
    }
    values["reading"] = {key: row.pop(key) for key in Reading.__annotations__ if key in row}
    values["options"] = {key: row.pop(key) for key in SurfaceOptions.__annotations__ if key in row}
    sensors = {key: row.pop(key) for key in _SENSORS if key in row}
    if is_surface or sensors or values["options"] or "resolution" in values:
        _check_surface(place, sensors, values.get("resolution"))
    values |= {"name": name, "left": left, "right": right, "more": tuple(more)}
    values |= {"settings": _settings_of(place, row), "sensors": tuple(sensors.values()) or None}
    pair: PairOfBatch = checked(place, PairOfBatch, values)
    return pair


def _settings_of(place: str, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sections of settings by their dotted names."""
    settings: dict[str, Any] = {}
    for key, value in row.items():
        try:
            name = f"disparity.{key}" if key in ("minimum", "maximum") else str(key)
            set_by_name(settings, name, load_yaml(value) if isinstance(value, str) else value)
        except (ValueError, RecursionError, yaml.YAMLError) as error:
            raise SatIntervalsError(f"{place}: {key} is {value!r}: {why(error)}") from error
    return settings


def _images_of(place: str, row: dict[str, Any], file: Path) -> list[str]:
    """Take left and right, or ``images``, out of a row; return the images. Patterns become the files that match."""
    if "images" not in row:
        return [_relative_to(file, str(row.pop(side))) for side in ("left", "right")]
    given = row.pop("images")
    if {"left", "right"} & row.keys():
        raise SatIntervalsError(f"{place}: give either images, or left and right")
    found: list[str] = []
    for name in map(str, given) if isinstance(given, list) else str(given).split():
        is_pattern = has_magic(name) and not _is_remote(name)
        names = sorted(glob(name, root_dir=file.parent)) if is_pattern else [name]
        if not names:
            raise SatIntervalsError(
                f"{place}: images is {name!r}, which no file matches: give names, or a pattern of files"
            )
        found += (_relative_to(file, one) for one in names)
    if len(found) < 2:
        raise SatIntervalsError(f"{place}: images: {len(found)} given, a surface needs two or more")
    return found


def _check_surface(place: str, sensors: Mapping[str, str], resolution: Any) -> None:
    """Raise unless a row has all that a surface model needs."""
    # raw images have no grids, and perhaps models beside them
    needed = _SENSORS if any(key.endswith("grid") for key in sensors) else _SENSORS[:2] if sensors else ()
    missing = [key for key in needed if key not in sensors] + ["resolution"] * (resolution is None)
    if missing:
        needed = (*needed, "resolution")
        raise SatIntervalsError(f"{place} lacks {' and '.join(missing)}: a surface needs {', '.join(needed)}")


def _is_remote(path: str) -> bool:
    return "://" in path or path.startswith("/vsi")


def _relative_to(file: Path, path: str) -> str:
    return path if _is_remote(path) else str(file.parent / path)
