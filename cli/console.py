"""Progress of a command, and the tables at its end."""

import time
from pathlib import Path
from shlex import quote
from types import TracebackType
from typing import Any, Self

from rich.console import Console as Terminal
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Table

from sat_intervals.cli.logs import warn
from sat_intervals.cli.options import PICTURES

STAGES = {
    "scene": "making a scene",
    "pairs": "checking pairs",
    "pairs.files": "writing files of pairs",
    "scenes": "measuring pairs",
    "levels": "matching at levels",
    "kernels": "preparing kernels (compiled once per machine, then about a second)",
    "range": "finding the search range",
    "rows": "comparing rows",
    "images": "measuring images",
    "heights": "finding heights",
    "shifts": "finding shifts of the images",
    "ortho": "resampling rows to the surface",
    "tiles": "matching tiles",
    "bands": "postprocessing rows",
    "points": "triangulating rows",
    "geometry": "reading models and grids",
    "resampling": "resampling rows",
    "extent": "finding the extent of the points",
    "alignment": "comparing runs",
    "cells": "filling rows of cells",
    "fill": "filling voids",
    "change": "comparing rows of cells",
    "registration": "registering the reference",
    "reference": "reading points",
    "truth": "finding disparities of rows",
    "files": "writing files",
}


# Causes of invalid pixels whose flags do not say enough.
_CAUSES = {"left_window": "no data or border", "no_candidate": "nothing to match within the range"}

# Files that other commands write to the folder of a run.
_MADE_FROM_RUNS = ("points.tif", "dsm.tif", "report.html", "project.qgz", "stac.json", *(f"{n}.png" for n in PICTURES))


def _is_older(file: Path, other: Path) -> bool:
    """Return whether a file exists and was written before another one."""
    return file.exists() and other.exists() and file.stat().st_mtime < other.stat().st_mtime


class Console:
    """Shows progress: a bar on a terminal, plain lines elsewhere, nothing with ``--quiet``."""

    def __init__(self, quiet: bool) -> None:
        # Paths may have square brackets and colons, which are not markup.
        self._terminal = Terminal(quiet=quiet, highlight=False, markup=False, emoji=False)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[state]}", markup=False),
            console=self._terminal,
            transient=True,
            disable=quiet or not self._terminal.is_terminal,
        )
        self._task: tuple[str, TaskID] | None = None
        self._began: dict[str, tuple[float, int]] = {}
        self._printed: set[str] = set()

    def __enter__(self) -> Self:
        self._bar.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.__exit__(kind, error, trace)

    def progress(self, stage: str, done: int, total: int) -> None:
        """Show the progress of a stage; a stage of one step has no figures."""
        began, before = self._began.setdefault(stage, (time.monotonic(), done))
        elapsed = time.monotonic() - began
        rate = (done - before) / elapsed if elapsed > 0 else 0.0
        if not self._bar.disable:
            self._draw(stage, done, total, _state(done, total, rate) if total > 1 else "")
        elif stage not in self._printed:
            self._printed.add(stage)
            self.say(f"{STAGES[stage]}: {total}" if total > 1 else STAGES[stage])

    def _draw(self, stage: str, done: int, total: int, state: str) -> None:
        """Draw the bar of a stage in place of the previous one."""
        if self._task is None or self._task[0] != stage:
            if self._task:
                self._bar.remove_task(self._task[1])
            self._task = stage, self._bar.add_task(STAGES[stage], state="")
        self._bar.update(self._task[1], completed=done, total=total if total > 1 else None, state=state)

    def say(self, text: str) -> None:
        """Print a line."""
        self._terminal.print(text, soft_wrap=True)

    def summary(self, report: dict[str, Any], out: Path, then: str | None = None) -> None:
        """Print the table at the end of a run, its verdict, its warnings, its files, and the next command, if any."""
        counts, rows = report["counts"], dict[str, str]()
        if report.get("search") and report["requested"]["disparity"]["minimum"] == "auto":
            rows["search range, found"] = f"{report['search']['minimum']} to {report['search']['maximum']} px"
        if report.get("local_ranges"):
            rows["local ranges, of the whole"] = f"{100 * report['local_ranges']['share']:.0f} %"
        rows["valid pixels"] = _share(counts["valid"], counts["pixels"])
        for flag, count in counts["causes"].items():
            if count:
                rows[f"  {_CAUSES.get(flag, flag.replace('_', ' '))}"] = _share(count, counts["pixels"])
        width = counts["median_interval_width"]
        rows["median interval width"] = "none" if width is None else f"{width:.2f} px"
        rows["low confidence, of valid pixels"] = _share(counts["low_confidence"], counts["valid"])
        if any((given := counts["agreement"]).values()):
            rows["given disparities inside"] = _share(given["inside"], sum(given.values()))
        if report.get("rows"):
            of_rows = report["survey"]["rows"]
            moved = f"up to {of_rows['most']:.2f} px, {of_rows['after'][0]:.2f} px left"
            rows["rows of the right image moved"] = moved
        self._say_rows(rows, report)
        self.say(report["verdict"])
        self._say_files(report, out, "intervals.tif")
        if old := [name for name in _MADE_FROM_RUNS if _is_older(out / name, out / "run.json")]:
            self.say(f"of an earlier run: {', '.join(old)}: make them again")
        if then:
            self.say(f"next: sat-intervals {then} {quote(str(out))}")

    def _say_rows(self, rows: dict[str, str], report: dict[str, Any]) -> None:
        """Print what a run found, and its time."""
        table = Table(show_header=False, box=None, pad_edge=False)
        table.add_column(style="bold")
        table.add_column(justify="right")
        for row in (*rows.items(), ("time", f"{report['seconds']['total']:.1f} s")):
            table.add_row(*row)
        self._terminal.print(table)

    def _say_files(self, report: dict[str, Any], out: Path, name: str) -> None:
        """Print the warnings of a run and the names of its files."""
        warn(report["warnings"])
        for file in (name, "validity.tif", "run.json"):
            self.say(str(out / file))

    def say_images(self, swept: dict[str, Any]) -> None:
        """Print the shifts and likeness of the images of a sweep."""
        images = Table("image", "row", "column", "left", "likeness", box=None, pad_edge=False)
        for one in swept["images"]:
            shift = (f"{part:+.2f}" for part in one["shift"])
            images.add_row(Path(one["path"]).name, *shift, _known(one["left"]), _known(one["alike"]))
        self.say("shifts of the models and what they leave (px), and likeness to the other images (-1 to 1)")
        self._terminal.print(images)

    def summary_of_many(self, report: dict[str, Any], out: Path) -> None:
        """Print the table at the end of a sweep of many images, its shifts and warnings."""
        counts, swept = report["counts"], report["sweep"]
        self.say_images(swept)
        seen, width = counts["pixels"] - counts["causes"]["left_window"], counts["median_interval_width"]
        rows = lines_of_grid(swept) | {"height, of cells that two images see": _share(counts["valid"], seen)}
        rows["median half width"] = "none" if width is None else f"+-{width * swept['step'] / 2:.2f} m"
        self._say_rows(rows, report)
        say_completed(self, swept.get("completed"))
        self._say_files(report, out, "dsm.tif")

    def batch_summary(self, report: dict[str, dict[str, Any]]) -> None:
        """Print the table at the end of a batch: the state of each pair, and its surface if any pair has one."""
        surfaces = {name: end["surface"] for name, end in report.items() if "surface" in end}
        of_surfaces = ("filled", "median half width") if surfaces else ()
        table = Table("pair", "state", "valid", "median width", *of_surfaces, "warnings", box=None, pad_edge=False)
        for name, end in report.items():
            counts = end.get("counts")
            width = counts and counts["median_interval_width"]
            valid = _share(counts["valid"], counts["pixels"]) if counts else ""
            in_pixels = width is not None and "step" not in surfaces.get(name, {})  # else in steps of height
            row = [name, end["state"], valid, f"{width:.2f} px" if in_pixels else ""]
            if name in surfaces:
                half = surfaces[name]["median_half_width"]
                row += [f"{100 * surfaces[name]['filled']:.1f} %", f"+-{half:.2f} m" if half is not None else ""]
            elif surfaces:
                row += ["", ""]
            table.add_row(*row, str(len(end.get("warnings", ()))) if counts else "")
        self._terminal.print(table)
        warn(f"{name}: {line}" for name, end in report.items() for line in end.get("warnings", ()))


def say_completed(console: Console, completed: dict[str, Any] | None) -> None:
    """Print how many cells of a surface were filled, flattened and masked."""
    if completed is None:
        return
    names = {"filled": "filled from their rims", "flattened": "of one height", "masked": "masked", "voids": "voids"}
    console.say("cells " + ", ".join(f"{what}: {completed[name]}" for name, what in names.items()))
    if completed["without_rim"]:
        warn([f"{completed['without_rim']} of {completed['areas']} areas of --flatten have no heights around: no data"])


def lines_of_grid(swept: dict[str, Any]) -> dict[str, str]:
    """Return the cells and heights of a sweep, by what they are."""
    cells, (low, high) = swept["cells"], swept["heights"]
    return {
        "cells": f"{cells['rows']} x {cells['columns']} of {cells['resolution']:g} m in {swept['crs']}",
        "heights searched": f"{low:.0f} to {high:.0f} m, every {swept['step']:.2f} m",
    }


def _known(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "-"


def _state(done: int, total: int, rate: float) -> str:
    """Format the progress of a stage: done, speed and time left, such as ``12/30, 5/s, 4 s left``."""
    if rate <= 0 or done >= total:
        return f"{done}/{total}"
    left = round((total - done) / rate)
    time_left = f"{left} s" if left < 100 else f"{left // 3600} h {left % 3600 // 60:02} min"
    speed = f"{rate:.0f}/s" if rate >= 1 else f"{1 / rate:.0f} s each"
    return f"{done}/{total}, {speed}, {time_left} left"
