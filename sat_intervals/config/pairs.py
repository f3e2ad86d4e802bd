"""Read lists of pairs with known truth, and the rows of any list."""

import csv
import io
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field, ValidationError
from pydantic.dataclasses import dataclass

from sat_intervals.config.files import load_yaml
from sat_intervals.errors import SatIntervalsError

_FILES = ("left.tif", "right.tif", "truth.tif", "meta.json")
_COLUMNS = ("left", "right", "truth", "minimum", "maximum")
_TABLES = (".csv", ".yaml", ".yml", ".json")
NO_GROUP = "all"

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


def check_names(names: Iterable[str], where: str = "") -> None:
    """Raise if names are not unique; ``where`` begins the message."""
    for name, count in Counter(names).items():
        if count > 1:
            raise SatIntervalsError(f"{where}{count} pairs or runs are called {name}: give each its own name")


def group_beside(image: Path) -> str:
    """Return the group in the ``meta.json`` beside an image, NO_GROUP without one."""
    meta = image.parent / "meta.json"
    return str(_meta(meta).get("group", NO_GROUP)) if meta.exists() else NO_GROUP


def _meta(file: Path) -> dict[str, Any]:
    try:
        meta = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise SatIntervalsError(f"{file} cannot be read: {why(error)}: it must be a JSON object") from error
    if not isinstance(meta, dict):
        raise SatIntervalsError(f"{file} holds {type(meta).__name__}, it must be a JSON object")
    return meta


def why(error: Exception) -> str:
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
    for place, row in read_rows(file, _COLUMNS):
        row = {"name": row["left"], "group": NO_GROUP} | row
        row |= {key: str(row[key]) for key in ("name", "group")}
        row |= {image: file.parent / row[image] for image in ("left", "right", "truth")}
        pairs.append(checked(place, Pair, {key: row[key] for key in Pair.__dataclass_fields__ if key in row}))
    return pairs


def checked(place: str, kind: type[Any], values: dict[str, Any]) -> Any:
    """Return a pair of checked values."""
    try:
        return kind(**values)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        key = [name for name in problem["loc"] if isinstance(name, str)][-1]
        raise SatIntervalsError(f"{place}: {key} is {problem['input']!r}: {problem['msg'].lower()}") from error


def read_rows(file: Path, needed: Sequence[str], instead: str = "") -> list[tuple[str, dict[str, Any]]]:
    """Read the rows of a CSV, YAML or JSON file without empty values; each comes after its place in the file.

    With the column ``instead`` only the first of the ``needed`` ones is.
    """
    wanted = f"give a list of pairs, each with {', '.join(needed)}"
    try:
        text = file.read_bytes().decode("utf-8-sig")  # with a byte order mark
        rows = _rows_of_csv(text) if file.suffix.lower() == ".csv" else load_yaml(text)
    except (OSError, ValueError, RecursionError, yaml.YAMLError, csv.Error) as error:
        raise SatIntervalsError(f"{file} cannot be read: {why(error)}: {wanted}") from error
    if not isinstance(rows, list) or not rows or not all(isinstance(row, Mapping) for row in rows):
        raise SatIntervalsError(f"{file} holds no pairs: {wanted}")
    found = []
    for number, row in enumerate(rows, start=1):
        place = f"{file}, row {number}"
        values = {key: value for key, value in row.items() if value not in ("", None)}
        if missing := [key for key in (needed[:1] if instead in values else needed) if key not in values]:
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
