"""Means over the scenes of each group, with the figures of the paper's table 1."""

from collections.abc import Iterable
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


@dataclass(frozen=True)
class SceneMetrics:
    """The report of one scene from `evaluate_run` and its group."""

    name: str
    group: str
    report: dict[str, Any]


@dataclass(frozen=True)
class Row:
    """A row of a table: means over the scenes of a group, and how many of them reach the objective."""

    label: str
    figures: dict[str, float | None]
    scenes: int
    at_objective: int


def look_up(report: dict[str, Any], place: tuple[str, ...]) -> float | None:
    """Return the figure at a path of a report, None if it is missing."""
    found: Any = report
    for key in place:
        found = None if found is None else found[key]
    return None if found is None else float(found)


def table_1(scenes: Iterable[SceneMetrics]) -> list[Row]:
    """Return accuracy, relative size and overestimation by group, the costs of a group one below the other."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for scene in scenes:
        groups.setdefault((scene.group, scene.report["cost"]), []).append(scene.report)
    places = list(dict.fromkeys(group for group, _ in groups))
    several = len({cost for _, cost in groups}) > 1
    rows = []
    for group, cost in sorted(groups, key=lambda key: places.index(key[0])):
        reports = groups[group, cost]
        means = {name: mean(look_up(report, place) for report in reports) for name, place in TABLE_1.items()}
        reached = sum((look_up(report, ACCURACY) or 0.0) >= OBJECTIVE for report in reports)
        rows.append(Row(f"{group} {cost}" if several else group, means, len(reports), reached))
    return rows


def mean(figures: Iterable[float | None]) -> float | None:
    """Return the mean of those that are known."""
    known = [figure for figure in figures if figure is not None]
    return sum(known) / len(known) if known else None
