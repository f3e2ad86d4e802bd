"""Read lists of pairs: pairs with known truth for evaluation, and pairs of a batch."""

import csv
import io
import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError

from sat_intervals.config.files import LARGEST_TABLE, load_yaml, read_small, set_by_name
from sat_intervals.errors import SatIntervalsError

_FILES = ("left.tif", "right.tif", "truth.tif", "meta.json")
_COLUMNS = ("left", "right", "truth", "minimum", "maximum")
NO_GROUP = "all"

# Report of a batch, in its folder. No pair may have its name or that of the folder of job logs.
REPORT = "batch.json"
_RESERVED = (REPORT, "logs")
# Bytes of a pair's name: a folder's name has at most 255, and a store adds a digest.
_LONGEST_NAME = 200
_IMAGES = ("left", "right", "left_mask", "right_mask")
_READING = {
    f"{side}{what}": kind for what, kind in (("nodata", float), ("band", int)) for side in ("", "left_", "right_")
}
# Four integers, or text with them.
_WINDOW = Annotated[
    tuple[int, int, int, int], BeforeValidator(lambda value: value.split() if isinstance(value, str) else value)
]
_TOLERANCE = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_SENSORS = ("left_model", "right_model", "left_grid", "right_grid")
# YAML nodes allowed in a list of pairs, which may have thousands of rows.
_NODES = 200_000
_INTEGER = TypeAdapter(int)  # also of 14.0


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
    tolerance: float | None = None
    remove_bias: bool | None = None


@dataclass(frozen=True)
class PairOfBatch:
    """One row of a batch: name, images, and the pair's own settings as nested sections.

    ``reading`` may have ``nodata`` and ``band`` for both images, ``left_nodata`` and so on for one; ``window`` is the
    region of the left image to match: row, column, height, width. ``resolution`` is the side of a cell in metres of a
    pair whose surface model is made too, and ``sensors`` are its models and grids of left and right; of raw images
    both models, or None if they belong to the images.
    """

    name: str
    left: str
    right: str
    left_mask: str | None = None
    right_mask: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    reading: Mapping[str, Any] = field(default_factory=dict)
    window: tuple[int, int, int, int] | None = None
    sensors: tuple[str, ...] | None = None
    resolution: float | None = None


def is_pair(path: Path) -> bool:
    """Return whether a path looks like the folder of a pair or a CSV file of pairs."""
    return path.suffix == ".csv" or (path / "left.tif").exists()


def find_pairs(paths: Iterable[str | Path]) -> list[Pair]:
    """Read pairs from folders and CSV files, in their order.

    A folder holds ``left.tif``, ``right.tif``, ``truth.tif`` and ``meta.json`` with ``disparity``, the search range
    ``[minimum, maximum]``, and optionally ``group``. A CSV file has a header with the columns left, right, truth,
    minimum, maximum and optionally name, group, tolerance and remove_bias; its paths are relative to the file.
    """
    pairs = []
    for path in map(Path, paths):
        pairs += _of_table(path) if path.suffix == ".csv" else [_of_folder(path)]
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
    """Read the pairs of a batch from a CSV, YAML or JSON file.

    A row has ``name``, ``left`` and ``right``; ``minimum`` and ``maximum``, the search range; ``left_mask`` and
    ``right_mask``; ``nodata`` and ``band``, or ``left_nodata`` and so on; ``window``; ``left_model``, ``right_model``,
    ``left_grid``, ``right_grid`` and ``resolution`` for a surface model, of raw images without grids; and any setting
    under its dotted name, such as ``sgm.p2``. YAML and JSON hold a list of such rows, in which a setting may also be a
    section. Paths are relative to the file.
    """
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
        meta = json.loads(read_small(file).decode())
    except SatIntervalsError:
        raise
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
        minimum, maximum = row["minimum"], row["maximum"]
        try:
            search = _INTEGER.validate_python(minimum), _INTEGER.validate_python(maximum)
        except ValueError as error:
            raise SatIntervalsError(f"{place}: minimum {minimum!r}, maximum {maximum!r}, needed: integers") from error
        left, right, truth = (file.parent / row[image] for image in ("left", "right", "truth"))
        named = row.get("name", row["left"]), row.get("group", NO_GROUP)
        judging = _value(place, row, "tolerance", _TOLERANCE), _value(place, row, "remove_bias", bool)
        pairs.append(Pair(*named, left, right, truth, *search, *judging))
    return pairs


def _value(place: str, row: dict[str, Any], key: str, kind: Any) -> Any:
    """Take a value, or the text of one, out of a row; None if it has none."""
    if (value := row.pop(key, None)) is None:
        return None
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        why = error.errors(include_url=False)[0]["msg"].lower()
        raise SatIntervalsError(f"{place}: {key} is {value!r}: {why}") from error


def _of_batch(place: str, row: dict[str, Any], file: Path) -> PairOfBatch:
    name = str(row.pop("name"))
    if "cluster" in (str(key).split(".")[0] for key in row):
        raise SatIntervalsError(f"{place}: all pairs share one cluster: set it with --config or --cluster")
    is_name = name.isprintable() and len(name.encode()) <= _LONGEST_NAME and os.sep not in name
    if not is_name or name.startswith(".") or name in _RESERVED:
        raise SatIntervalsError(
            f"{place}: name {name!r} cannot be a folder's name: choose another of at most {_LONGEST_NAME} bytes"
        )
    images: dict[str, Any] = {key: _relative_to(file, str(row.pop(key))) for key in _IMAGES if key in row}
    reading = {key: _value(place, row, key, kind) for key, kind in _READING.items() if key in row}
    window = _value(place, row, "window", _WINDOW)
    surface = _surface(place, row, file)
    settings: dict[str, Any] = {}
    for key, value in row.items():
        try:
            name_of_setting = f"disparity.{key}" if key in ("minimum", "maximum") else str(key)
            set_by_name(settings, name_of_setting, load_yaml(value) if isinstance(value, str) else value)
        except (ValueError, RecursionError, yaml.YAMLError) as error:
            raise SatIntervalsError(f"{place}: {key} is {value!r}: {_why(error)}") from error
    return PairOfBatch(name, settings=settings, reading=reading, window=window, **images, **surface)


def _surface(place: str, row: dict[str, Any], file: Path) -> dict[str, Any]:
    """Take what a surface model needs out of a row, all or nothing."""
    given = {key: _relative_to(file, str(row.pop(key))) for key in _SENSORS if key in row}
    resolution = _value(place, row, "resolution", float)
    if not given and resolution is None:
        return {}
    # raw images have no grids, and perhaps models beside them
    needed = _SENSORS if any(key.endswith("grid") for key in given) else _SENSORS[:2] if given else ()
    missing = [key for key in needed if key not in given] + ["resolution"] * (resolution is None)
    if missing:
        needed = (*needed, "resolution")
        raise SatIntervalsError(f"{place} lacks {' and '.join(missing)}: a surface needs {', '.join(needed)}")
    return {"sensors": tuple(given.values()) or None, "resolution": resolution}


def _relative_to(file: Path, path: str) -> str:
    return path if "://" in path or path.startswith("/vsi") else str(file.parent / path)


def _rows(file: Path, needed: Sequence[str]) -> list[tuple[str, dict[str, Any]]]:
    """Read the rows of a CSV, YAML or JSON file without empty values; each comes after its place in the file."""
    wanted = f"give a list of pairs, each with {', '.join(needed)}"
    try:
        if file.suffix.lower() == ".csv":
            rows = _rows_of_csv(read_small(file, LARGEST_TABLE).decode("utf-8-sig"))  # with a byte order mark
        else:
            rows = load_yaml(read_small(file).decode("utf-8-sig"), _NODES)
    except SatIntervalsError:
        raise
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
