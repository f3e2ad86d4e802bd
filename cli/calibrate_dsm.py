"""Calibrate the intervals of a surface model: the options of ``sat-intervals calibrate --dsm``, and what it prints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.options import Command, with_options

if TYPE_CHECKING:
    from sat_intervals.cli.matching import SettingsArguments
    from sat_intervals.config import HeightCalibration

_FILE = click.Path(path_type=Path)


@dataclass(frozen=True)
class Heights:
    """A surface model to calibrate, its reference, and whether the reference is moved to it."""

    dsm: Path
    reference: Path
    registers: bool

    def check_alone(self, pairs: Sequence[Path], settings: "SettingsArguments", options: Mapping[str, Any]) -> None:
        """Raise if there are pairs to calibrate too, or options for them."""
        if pairs:
            raise click.UsageError(f"{pairs[0]} is a pair and --dsm a surface model: calibrate one of them at a time.")
        sections = settings.sections
        given = {name: value for name, value in sections.items() if name != "interval"} | {"config": settings.file}
        given |= {"calibration": sections.get("interval", {}).get("calibration"), **options}
        for name, value in given.items():
            if value:
                option = {"tiles": "tile-size", "cluster": "workers"}.get(name, name.replace("_", "-"))
                raise click.UsageError(f"--{option} applies to pairs, not to --dsm: leave it out.")


_OPTIONS = (
    click.option("--dsm", type=_FILE, help="Calibrate this surface model against --reference, instead of pairs."),
    click.option("--reference", type=_FILE, help="With --dsm: reference heights above the same datum, in any CRS."),
    click.option("--no-register", is_flag=True, help="With --dsm: do not move the reference to the surface."),
)


def height_options(command: Command) -> Command:
    """Add options for a surface model; the command gets ``heights``, None without one."""

    @wraps(command)
    def with_heights(*, dsm: Path | None, reference: Path | None, no_register: bool, **others: Any) -> Any:
        if bool(dsm) != bool(reference):
            raise click.UsageError("--dsm and --reference go together: give both.")
        if no_register and not dsm:
            raise click.UsageError("--no-register goes with --dsm: leave it out.")
        return command(heights=Heights(dsm, reference, not no_register) if dsm and reference else None, **others)

    return with_options(with_heights, *_OPTIONS)


def show_heights(calibration: "HeightCalibration") -> None:
    """Print the margins of each class, and what to expect."""
    from sat_intervals.cli.tables import show

    start, rows = 0.0, []
    for kind in calibration.classes:
        ends = f"from {start:g}" if kind.below is None else f"{start:g} to {kind.below:g}"
        rows.append([f"width {ends} m", str(kind.cells), f"{kind.margin:+.2f}"])
        start = kind.below or 0.0
    show(
        ["", "cells", "margin (m)"],
        rows,
        f"both bounds move outwards by the margin, for coverage {calibration.coverage:g}",
    )
    found = calibration.provenance
    if found["shift"] is not None:
        east, north, up = found["shift"]
        click.echo(f"reference moved: easting {east:+.2f} m, northing {north:+.2f} m, height {up:+.2f} m")
    for line in found["warnings"]:
        click.echo(line)
    keys = {
        "coverage": "coverage",
        "lowest": "lowest",
        "median_width": "median width (m)",
        "mean_width": "mean width (m)",
    }
    figures = {"before": found["before"], "calibrated on the other blocks": found["expected"] or {}}
    rows = [
        [name, *("-" if one.get(key) is None else f"{one[key]:.3f}" for key in keys)] for name, one in figures.items()
    ]
    show(["", *keys.values()], rows, "expected: figures of blocks of ground that were held out")
