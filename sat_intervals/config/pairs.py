"""Pairs of known truth, as evaluation takes them: folders, or the rows of a CSV file."""

import csv
import io
import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sat_intervals.config.reading import LARGEST_TABLE, read_small
from sat_intervals.errors import SatIntervalsError

_FILES = ("left.tif", "right.tif", "truth.tif", "meta.json")
_COLUMNS = ("left", "right", "truth", "minimum", "maximum")
_OPTIONAL = ("name", "group")
NO_GROUP = "all"


@dataclass(frozen=True)
class Pair:
    """Two epipolar images, their true disparity and the range in which to search it, both ends included."""

    name: str
    group: str
    left: Path
    right: Path
    truth: Path
    minimum: int
    maximum: int


def is_pair(path: Path) -> bool:
    """Whether a path looks like a folder of a pair, or a CSV file of pairs."""
    return path.suffix == ".csv" or (path / "left.tif").exists()


def find_pairs(paths: Iterable[str | Path]) -> list[Pair]:
    """Pairs from folders and CSV files, in their order.

    A folder holds ``left.tif``, ``right.tif``, ``truth.tif`` and ``meta.json`` with ``disparity``, the search range
    ``[minimum, maximum]``, and, if it pleases, ``group``. A CSV file has a header of the columns left, right, truth,
    minimum, maximum and, if it pleases, name and group; its paths are relative to the file.

    Raises
    ------
    SatIntervalsError
        What is missing, and where.
    """
    pairs = []
    for path in map(Path, paths):
        pairs += _of_table(path) if path.suffix == ".csv" else [_of_folder(path)]
    check_names(pair.name for pair in pairs)
    for pair, count in Counter(map(_unnamed, pairs)).items():
        if count > 1:
            raise SatIntervalsError(f"the pair of {pair.left} is given {count} times: give it once")
    return pairs


def check_names(names: Iterable[str]) -> None:
    """Hold that what is judged can be told apart."""
    for name, count in Counter(names).items():
        if count > 1:
            raise SatIntervalsError(f"{count} pairs or runs are called {name}: give each its own name")


def _unnamed(pair: Pair) -> Pair:
    """What a pair is, whatever it is called and from wherever its files are named."""
    left, right, truth = (path.resolve() for path in (pair.left, pair.right, pair.truth))
    return replace(pair, name="", group="", left=left, right=right, truth=truth)


def group_beside(image: str | Path) -> str:
    """The group that the ``meta.json`` beside an image names; NO_GROUP where there is none."""
    meta = Path(image).parent / "meta.json"
    return str(_meta(meta).get("group", NO_GROUP)) if meta.exists() else NO_GROUP


def _meta(file: Path) -> dict[str, Any]:
    try:
        meta = json.loads(read_small(file).decode())
    except SatIntervalsError:
        raise
    except OSError as error:
        raise SatIntervalsError(f"{file} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise SatIntervalsError(f"{file} cannot be read: {error}: it must be a JSON object") from error
    if not isinstance(meta, dict):
        raise SatIntervalsError(f"{file} holds {type(meta).__name__}, it must be a JSON object")
    return meta


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
    try:
        text = read_small(file, LARGEST_TABLE).decode("utf-8-sig")  # spreadsheets begin with a mark
        reader = csv.DictReader(io.StringIO(text, newline=""))
        rows, columns = list(reader), reader.fieldnames or []
    except SatIntervalsError:
        raise
    except OSError as error:
        raise SatIntervalsError(f"{file} cannot be read: {error.strerror}: give a CSV file of pairs") from error
    except (ValueError, csv.Error) as error:
        raise SatIntervalsError(f"{file} cannot be read: {error}: give a CSV file in UTF-8") from error
    missing = [column for column in _COLUMNS if column not in columns]
    if missing:
        raise SatIntervalsError(
            f"{file}: no column {', '.join(missing)}; needed: {', '.join(_COLUMNS)}, known: {', '.join(_OPTIONAL)}"
        )
    if not rows:
        raise SatIntervalsError(f"{file} has a header but no rows: give a row a pair")
    return [_of_row(file, number, row) for number, row in enumerate(rows, start=2)]


def _of_row(file: Path, number: int, row: dict[str, str | None]) -> Pair:
    left, right, truth, minimum, maximum = (row[column] or "" for column in _COLUMNS)
    try:
        search = int(minimum), int(maximum)
    except ValueError as error:
        raise SatIntervalsError(
            f"{file}, line {number}: minimum {minimum!r}, maximum {maximum!r}, needed: integers"
        ) from error
    first, second, known = (file.parent / path for path in (left, right, truth))
    return Pair(row.get("name") or left, row.get("group") or NO_GROUP, first, second, known, *search)
