"""Read lists of pairs: pairs with known truth for evaluation, and pairs of a batch."""

import csv
import io
import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BeforeValidator, Field, ValidationError
from pydantic.dataclasses import dataclass
from typing_extensions import TypedDict

from sat_intervals.config.files import load_yaml, set_by_name
from sat_intervals.config.settings import Config
from sat_intervals.config.wording import known
from sat_intervals.errors import SatIntervalsError

_FILES = ("left.tif", "right.tif", "truth.tif", "meta.json")
_COLUMNS = ("left", "right", "truth", "minimum", "maximum")
_TABLES = (".csv", ".yaml", ".yml", ".json")
NO_GROUP = "all"

# Report of a batch, in its folder. No pair may have its name or that of the folder of job logs.
REPORT = "batch.json"
_RESERVED = (REPORT, "logs")
# Bytes of a pair's name: a folder's name has at most 255, and a store adds a digest.
_LONGEST_NAME = 200
_IMAGES = ("left", "right", "left_mask", "right_mask")
_SENSORS = ("left_model", "right_model", "left_grid", "right_grid")
# Four integers, or text with them.
_WINDOW = Annotated[
    tuple[int, int, int, int], BeforeValidator(lambda value: value.split() if isinstance(value, str) else value)
]
_TOLERANCE = Annotated[float, Field(ge=0, allow_inf_nan=False)]


@dataclass(frozen=True)
class Pair:
    """Two epipolar images, their true disparity and the search range, both ends included.

    ``tolerance`` and ``remove_bias`` determine how `calibrate` compares with the truth; None: its options do.
    """

    name: str
    group: str
    left: Path
    right: Path
    truth: Path
    minimum: int
    maximum: int
    tolerance: _TOLERANCE | None = None
    remove_bias: bool | None = None


class Reading(TypedDict, total=False):
    """No-data value and band of both images of a pair, or of one."""

    nodata: float
    band: int
    left_nodata: float
    right_nodata: float
    left_band: int
    right_band: int


@dataclass(frozen=True)
class PairOfBatch:
    """One row of a batch: name, images, and the pair's own settings as nested sections.

    ``window`` is the region of the left image to match: row, column, height, width. ``resolution`` is the side of a
    cell in metres of a pair whose surface model is made too, and ``sensors`` are its models and grids of left and
    right; of raw images both models, or None if they belong to the images.
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


def is_pair(path: Path) -> bool:
    """Return whether a path looks like the folder of a pair or a table of pairs."""
    return path.suffix.lower() in _TABLES or (path / "left.tif").exists()


def find_pairs(paths: Iterable[str | Path]) -> list[Pair]:
    """Read pairs with their truth from folders and tables, in their order (docs/coverage.md)."""
    pairs = []
    for path in map(Path, paths):
        pairs += _of_table(path) if path.suffix.lower() in _TABLES else [_of_folder(path)]
    check_names(pair.name for pair in pairs)
    nameless = (
        replace(pair, name="", group="", **{side: getattr(pair, side).resolve() for side in ("left", "right", "truth")})
        for pair in pairs
    )
    for pair, count in Counter(nameless).items():
        if count > 1:
            raise SatIntervalsError(f"the pair of {pair.left} is given {count} times: give it once")
    return pairs


def read_batch(file: Path) -> list[PairOfBatch]:
    """Read the pairs of a batch from a CSV, YAML or JSON file (docs/clusters.md); paths are relative to the file."""
    pairs = [_of_batch(place, row, file) for place, row in _rows(file, ("name", "left", "right"))]
    check_names((pair.name for pair in pairs), f"{file}: ")
    return pairs


def check_names(names: Iterable[str], where: str = "") -> None:
    """Raise if names are not unique; ``where`` begins the message."""
    for name, count in Counter(names).items():
        if count > 1:
            raise SatIntervalsError(f"{where}{count} pairs or runs are called {name}: give each its own name")


def group_beside(image: str | Path) -> str:
    """Return the group in the ``meta.json`` beside an image, NO_GROUP without one."""
    meta = Path(image).parent / "meta.json"
    return str(_meta(meta).get("group", NO_GROUP)) if meta.exists() else NO_GROUP


def _meta(file: Path) -> dict[str, Any]:
    try:
        meta = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise SatIntervalsError(f"{file} cannot be read: {_why(error)}: it must be a JSON object") from error
    if not isinstance(meta, dict):
        raise SatIntervalsError(f"{file} holds {type(meta).__name__}, it must be a JSON object")
    return meta


def _why(error: Exception) -> str:
    """Return the reason of an error in one line."""
    return " ".join(str(getattr(error, "strerror", None) or error).split())


def _of_folder(folder: Path) -> Pair:
    missing = [name for name in _FILES if not (folder / name).exists()]
    if missing:
        raise SatIntervalsError(f"{folder}: {', '.join(missing)} missing; a pair is a folder of {', '.join(_FILES)}")
    meta = _meta(folder / "meta.json")
    match meta.get("disparity"):
        case [int(minimum), int(maximum)]:
            left, right, truth = (folder / file for file in _FILES[:3])
            return Pair(str(folder), group_beside(left), left, right, truth, minimum, maximum)
        case other:
            raise SatIntervalsError(
                f"{folder / 'meta.json'}: disparity is {other}, needed: [minimum, maximum], integers"
            )


def _of_table(file: Path) -> list[Pair]:
    pairs = []
    for place, row in _rows(file, _COLUMNS):
        row = {"name": row["left"], "group": NO_GROUP} | row
        row |= {key: str(row[key]) for key in ("name", "group")}
        row |= {image: file.parent / row[image] for image in ("left", "right", "truth")}
        pairs.append(_checked(place, Pair, {key: row[key] for key in Pair.__dataclass_fields__ if key in row}))
    return pairs


def _checked(place: str, kind: type[Any], values: dict[str, Any]) -> Any:
    """Return a pair of checked values."""
    try:
        return kind(**values)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        key = [name for name in problem["loc"] if isinstance(name, str)][-1]
        raise SatIntervalsError(f"{place}: {key} is {problem['input']!r}: {problem['msg'].lower()}") from error


def _of_batch(place: str, row: dict[str, Any], file: Path) -> PairOfBatch:
    columns = ("name", *_IMAGES, "minimum", "maximum", *Reading.__annotations__, "window", *_SENSORS, "resolution")
    columns += (*Config.model_fields,)
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
    values: dict[str, Any] = {key: _relative_to(file, str(row.pop(key))) for key in _IMAGES if key in row}
    values["reading"] = {key: row.pop(key) for key in Reading.__annotations__ if key in row}
    sensors = {key: _relative_to(file, str(row.pop(key))) for key in _SENSORS if key in row}
    values |= {key: row.pop(key, None) for key in ("window", "resolution")}
    _check_surface(place, sensors, values["resolution"])
    settings: dict[str, Any] = {}
    for key, value in row.items():
        try:
            name_of_setting = f"disparity.{key}" if key in ("minimum", "maximum") else str(key)
            set_by_name(settings, name_of_setting, load_yaml(value) if isinstance(value, str) else value)
        except (ValueError, RecursionError, yaml.YAMLError) as error:
            raise SatIntervalsError(f"{place}: {key} is {value!r}: {_why(error)}") from error
    values |= {"name": name, "settings": settings, "sensors": tuple(sensors.values()) or None}
    pair: PairOfBatch = _checked(place, PairOfBatch, values)
    return pair


def _check_surface(place: str, sensors: Mapping[str, str], resolution: Any) -> None:
    """Raise unless a row has all that a surface model needs, or nothing of it."""
    if not sensors and resolution is None:
        return
    # raw images have no grids, and perhaps models beside them
    needed = _SENSORS if any(key.endswith("grid") for key in sensors) else _SENSORS[:2] if sensors else ()
    missing = [key for key in needed if key not in sensors] + ["resolution"] * (resolution is None)
    if missing:
        needed = (*needed, "resolution")
        raise SatIntervalsError(f"{place} lacks {' and '.join(missing)}: a surface needs {', '.join(needed)}")


def _relative_to(file: Path, path: str) -> str:
    return path if "://" in path or path.startswith("/vsi") else str(file.parent / path)


def _rows(file: Path, needed: Sequence[str]) -> list[tuple[str, dict[str, Any]]]:
    """Read the rows of a CSV, YAML or JSON file without empty values; each comes after its place in the file."""
    wanted = f"give a list of pairs, each with {', '.join(needed)}"
    try:
        text = file.read_bytes().decode("utf-8-sig")  # with a byte order mark
        rows = _rows_of_csv(text) if file.suffix.lower() == ".csv" else load_yaml(text)
    except (OSError, ValueError, RecursionError, yaml.YAMLError, csv.Error) as error:
        raise SatIntervalsError(f"{file} cannot be read: {_why(error)}: {wanted}") from error
    if not isinstance(rows, list) or not rows or not all(isinstance(row, Mapping) for row in rows):
        raise SatIntervalsError(f"{file} holds no pairs: {wanted}")
    found = []
    for number, row in enumerate(rows, start=1):
        place = f"{file}, row {number}"
        values = {key: value for key, value in row.items() if value not in ("", None)}
        if missing := [key for key in needed if key not in values]:
            raise SatIntervalsError(f"{place} lacks {' and '.join(missing)}: {wanted}")
        if None in row:
            raise SatIntervalsError(f"{place} has more values than columns: {row[None]}")
        found.append((place, values))
    return found


def _rows_of_csv(text: str) -> list[Any]:
    """Read rows as programs and spreadsheets write them: semicolons, spaces, capitals, empty rows."""
    delimiter = max(",;\t", key=text.partition("\n")[0].count)
    rows = csv.DictReader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True)
    rows.fieldnames = [name.strip().lower() for name in rows.fieldnames or ()]
    if twice := [name for name, count in Counter(filter(None, rows.fieldnames)).items() if count > 1]:
        raise ValueError(f"column {twice[0]} appears twice")
    trimmed = ({key: value.strip() if isinstance(value, str) else value for key, value in row.items()} for row in rows)
    return [row for row in trimmed if any(row.values())]
