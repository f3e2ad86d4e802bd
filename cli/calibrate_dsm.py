"""Calibrate the intervals of a surface model: ``sat-intervals calibrate --dsm``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sat_intervals.cli.logs import warn
from sat_intervals.cli.options import Printing, Surface

if TYPE_CHECKING:
    from sat_intervals.config import HeightCalibration

_HEIGHTS = """\
# Calibration of heights: metres that widen the intervals of a surface model, found by sat-intervals calibrate --dsm.
# Use it with: sat-intervals dsm OUT --calibration FILE, with the options that the surface was made with.
# Classes, in metres: `relief_below`: their end of the range of heights in 5 x 5 cells, `half_width_below`: that of half
# the width of the interval. `margin`: both bounds move outwards by it, inwards if negative; half widths are multiplied
# by `factor` first.
"""


def calibrate_heights(
    surface: Surface, output: Path, name: str | None, coverage: float | None, printing: Printing, *, overwrite: bool
) -> None:
    """Calibrate the intervals of a surface model, and write and print their margins."""
    from sat_intervals.evaluate.surface_calibration import calibrate_surface
    from sat_intervals.raster import check_not_replaced
    from sat_intervals.workflows.calibrate import check_output, write_commented

    files = surface.dsm, surface.reference
    check_not_replaced(files, [output])
    check_output(output, overwrite=overwrite)
    calibration = calibrate_surface(*files, name or output.stem, coverage=coverage, **surface.how)
    write_commented(output, _HEIGHTS, calibration.model_dump(mode="json"))
    printing.say(calibration.model_dump(mode="json"))
    if not printing.is_silent:
        _show(calibration)
        click.echo(str(output))


def _show(calibration: "HeightCalibration") -> None:
    """Print the margins of each class, and what to expect."""
    from sat_intervals.cli.tables import points_lines, show

    rows = [
        [*("others" if end is None else f"below {end:g}" for end in ends), str(kind.cells), f"{kind.margin:+.2f}"]
        for kind in calibration.classes
        for ends in [(kind.relief_below, kind.half_width_below)]
    ]
    reached = f"for coverage {calibration.coverage:g}"
    if calibration.factor == 1:
        header = ["range in 5 x 5 cells (m)", "half width (m)", "cells", "margin (m)"]
        show(header, rows, f"both bounds move outwards by the margin, {reached}")
    else:
        click.echo(
            f"half widths are multiplied by {calibration.factor:g}, {reached}: few or noisy heights have no classes"
        )
    found = calibration.provenance
    if found["shift"] is not None:
        east, north, up = found["shift"]
        click.echo(f"reference moved: easting {east:+.2f} m, northing {north:+.2f} m, height {up:+.2f} m")
    keys = "coverage", "deviation", "lowest", "median_half_width", "mean_half_width"
    figures = {"before": found["before"], "calibrated on the other blocks": found["expected"] or {}}
    rows = [
        [name, *("-" if one.get(key) is None else f"{one[key]:.3f}" for key in keys)] for name, one in figures.items()
    ]
    header = ["", "coverage", "standard error", "lowest", "median half width (m)", "mean half width (m)"]
    show(header, rows, "coverage and half widths: before, and expected on ground that was held out")
    expected = found["expected"] or {}
    count = sum(kind.cells for kind in calibration.classes)
    for line in points_lines(found["points"], count, expected.get("deviation")):
        click.echo(line)
    warn(found["warnings"])
