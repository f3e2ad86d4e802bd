"""What a person reads while a run goes on, and at its end."""

import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rich.console import Console as Terminal
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

STAGES = {
    "scene": "making a scene",
    "kernels": "preparing kernels (compiled once a machine, then about a second)",
    "tiles": "matching tiles",
    "bands": "finishing rows",
    "files": "writing files",
}


class Console:
    """Progress as a bar on a terminal, as plain lines elsewhere, not at all when quiet."""

    def __init__(self, quiet: bool) -> None:
        self._terminal = Terminal(quiet=quiet, highlight=False)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            console=self._terminal,
            transient=True,
            disable=quiet or not self._terminal.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}
        self._began: dict[str, tuple[float, int]] = {}
        self._told: dict[str, int] = {}

    def __enter__(self) -> Self:
        self._bar.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.__exit__(kind, error, trace)

    def progress(self, stage: str, done: int, total: int) -> None:
        """Take note of how far a stage is."""
        began, before = self._began.setdefault(stage, (time.monotonic(), done))
        elapsed = time.monotonic() - began
        rate = (done - before) / elapsed if elapsed > 0 else 0.0
        if self._bar.disable:
            self._tell(stage, done, total, rate)
            return
        if stage not in self._tasks:
            self._tasks[stage] = self._bar.add_task(STAGES[stage], total=total, rate="")
        self._bar.update(self._tasks[stage], completed=done, total=total, rate=f"{rate:.2g}/s" if done else "")

    def _tell(self, stage: str, done: int, total: int, rate: float) -> None:
        """A plain line when a stage begins and at every tenth of it."""
        tenth = 10 * done // max(total, 1)
        if self._told.get(stage) == tenth:
            return
        self._told[stage] = tenth
        left = f", {(total - done) / rate:.0f} s left" if rate > 0 and done < total else ""
        self._terminal.print(f"{STAGES[stage]}: {done}/{total}{left}")

    def say(self, text: str) -> None:
        """Print a line."""
        self._terminal.print(text)

    def summary(self, report: dict[str, Any], out: Path) -> None:
        """The table at the end of a run."""
        counts = report["counts"]
        table = Table(show_header=False, box=None, pad_edge=False)
        table.add_column(style="bold")
        table.add_column(justify="right")
        pixels = counts["pixels"]
        table.add_row("valid pixels", _share(counts["valid"], pixels))
        for flag, count in counts["flags"].items():
            if count and report["validity_bits"][flag]["invalid"]:
                table.add_row(f"  {flag.replace('_', ' ')}", _share(count, pixels))
        width = counts["median_interval_width"]
        table.add_row("median interval width", "none" if width is None else f"{width:.2f} px")
        table.add_row("low confidence, of valid pixels", _share(counts["low_confidence"], counts["valid"]))
        table.add_row("time", f"{report['seconds']['total']:.1f} s")
        self._terminal.print(table)
        for name in ("intervals.tif", "validity.tif", "run.json"):
            self._terminal.print(str(out / name), soft_wrap=True)


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "-"
