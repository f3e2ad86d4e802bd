"""Make the paper's table 1: means over scenes, with the figures of the paper and of its implementation, Pandora.

Pandora was measured with penalties 8 and 32, on pixels that pass its accurate cross-checking. None was not measured.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

# Column of the table -> path to its figure in the report of a scene.
ACCURACY = ("all", "accuracy")
TABLE_1 = {
    "acc.": ACCURACY,
    "size": ("all", "relative_size"),
    "high acc.": ("high", "accuracy"),
    "high size": ("high", "relative_size"),
    "low acc.": ("low", "accuracy"),
    "low size": ("low", "relative_size"),
    "overest.": ("low", "relative_overestimation"),
    "overest. with rejected": ("with_rejected", "low", "relative_overestimation"),
}
OBJECTIVE = 0.9  # the paper's target accuracy of each scene
_Published = Mapping[tuple[str, str], tuple[float | None, ...]]

_PAPER_1: _Published = {
    ("census", "middlebury2003"): (0.973, 0.033, 0.983, 0.033, 0.942, 0.183, 0.165),
    ("census", "middlebury2005"): (0.963, 0.026, 0.969, 0.026, 0.950, 0.218, 0.152),
    ("census", "middlebury2006"): (0.989, 0.026, 0.993, 0.026, 0.980, 0.569, 0.109),
    ("census", "middlebury2014"): (0.957, 0.063, 0.912, 0.007, 0.991, 0.872, 0.120),
    ("census", "middlebury2021"): (0.936, 0.594, 0.818, 0.012, 0.987, 0.859, 0.168),
    ("mccnn", "middlebury2003"): (0.954, 0.033, 0.968, 0.033, 0.890, 0.233, 0.182),
    ("mccnn", "middlebury2005"): (0.971, 0.038, 0.973, 0.026, 0.969, 0.256, 0.228),
    ("mccnn", "middlebury2006"): (0.989, 0.038, 0.992, 0.026, 0.985, 0.397, 0.268),
    ("mccnn", "middlebury2014"): (0.983, 0.029, 0.972, 0.013, 0.996, 0.993, 0.339),
    ("mccnn", "middlebury2021"): (0.991, 1.000, 0.969, 0.026, 0.999, 1.000, 0.314),
}
_REFERENCE_1: _Published = {
    ("census", "middlebury2003"): (0.975, 0.035, None, None, None, None, 0.479, 0.06),
    ("census", "middlebury2005"): (0.959, 0.026, None, None, None, None, 0.637, 0.14),
    ("census", "middlebury2006"): (0.988,),
    ("mccnn", "middlebury2003"): (0.971, 0.036),
    ("mccnn", "middlebury2005"): (0.976, 0.040),
}


@dataclass(frozen=True)
class SceneMetrics:
    """The report of one scene from `evaluate_run` and its group."""

    name: str
    group: str
    report: dict[str, Any]


@dataclass(frozen=True)
class Row:
    """A row of a table: means over the scenes of a group, or published figures."""

    label: str
    figures: dict[str, float | None]
    scenes: int | None = None
    at_objective: int | None = None


def look_up(report: dict[str, Any], place: tuple[str, ...]) -> float | None:
    """Return the figure at a path of a report, None if it is missing."""
    found: Any = report
    for key in place:
        found = None if found is None else found[key]
    return None if found is None else float(found)


def table_1(scenes: Iterable[SceneMetrics]) -> list[Row]:
    """Return accuracy, relative size and overestimation by group (paper, table 1)."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for scene in scenes:
        groups.setdefault((scene.report["cost"], scene.group), []).append(scene.report)
    rows = []
    places = list(dict.fromkeys(group for _, group in groups))
    several = len({cost for cost, _ in groups}) > 1
    # List the costs of a group one below the other.
    for cost, group in sorted(groups, key=lambda key: places.index(key[1])):
        reports = groups[cost, group]
        means = {name: _mean([look_up(report, place) for report in reports]) for name, place in TABLE_1.items()}
        reached = sum((look_up(report, ACCURACY) or 0.0) >= OBJECTIVE for report in reports)
        rows.append(Row(f"{group} {cost}" if several else group, means, len(reports), reached))
        for label, table in {"paper": _PAPER_1, "reference": _REFERENCE_1}.items():
            if (cost, group) in table:
                known = dict(zip(TABLE_1, table[cost, group], strict=False))
                rows.append(Row(label, {name: known.get(name) for name in TABLE_1}))
    return rows


def _mean(figures: list[float | None]) -> float | None:
    known = [figure for figure in figures if figure is not None]
    return sum(known) / len(known) if known else None
