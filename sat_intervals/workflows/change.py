"""What changed between two dates: differences of two surfaces, areas of change and their volumes, as files."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.accuracy import LARGEST
from sat_intervals.evaluate.change import open_pair
from sat_intervals.evaluate.change_areas import ChangedAreas, signs_of
from sat_intervals.heights.polygons import read_areas, write_polygons
from sat_intervals.kernels.significance import SCALE
from sat_intervals.products import plain
from sat_intervals.progress import Progress
from sat_intervals.raster import OutputWriter, check_free, check_not_replaced, path_of
from sat_intervals.raster.files import change_file
from sat_intervals.raster.polygons import outlines
from sat_intervals.raster.publishing import write_record

FILES = "change.tif", "changes.gpkg", "change.json"
# Median of absolute ratios from which standard deviations are too small: .67 of normal errors, and a tenth more.
_STATED = 0.75
_DOUBTFUL = 1.3  # times the named rate of false alarms, from which there is a warning


def change(
    before: str | Path,
    after: str | Path,
    out: str | Path,
    *,
    false_alarms: float = 0.01,
    smallest_area: float = 50.0,
    registers: bool = True,
    sigma: float | None = None,
    stable: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Find what changed between two dates, at a rate of false alarms: METHOD.md, section 21.

    Parameters
    ----------
    before, after
        Surface models, on any grids, or folders that have one as ``dsm.tif``. The second is moved to the first by
        their constant shift, and resampled to its cells. Surfaces of other tools have the standard deviation of their
        heights in a band named sigma, std, error or uncertainty, or given by ``sigma``.
    out
        Folder for ``change.tif`` (difference, its bounds, significance, change), ``changes.gpkg`` (areas of change; it
        needs the extra ``reference``) and ``change.json``, what is returned.
    false_alarms
        Share of the cells without a change that may count as changed.
    smallest_area
        Square metres that an area of change has at least.
    registers
        Whether the second surface is moved; its shift includes a change of height that all ground has.
    sigma
        Standard deviation in metres of heights of surfaces without bounds.
    stable
        Ground without a change, to check the rate: a raster that is not 0 there, or polygons.
    overwrite
        Whether files that exist are replaced.
    progress
        Callback, see `Progress`.

    Returns
    -------
    ``registration``, see `Registration.report`; ``cells``: numbers of cells ``compared``, ``undecided``, ``risen``,
    ``fallen``; ``areas`` of change; ``volume`` in cubic metres with its standard deviation: ``gained``, ``lost``,
    ``net``; ``rate`` of false alarms: ``named``, ``measured`` on so many ``stable`` cells, None without, and the
    ``median`` of all differences in standard deviations; ``correlation`` of errors; ``warnings``, lines; and what was
    asked for.

    Raises
    ------
    SatIntervalsError
        A surface cannot be used, nothing is common, or a file exists.
    """
    out, stable = path_of(out), None if stable is None else path_of(stable)
    _check(false_alarms, smallest_area, sigma)
    for name in FILES:
        check_free(out / name, overwrite=overwrite)
    pair, registration, warnings = open_pair(before, after, sigma, registers=registers)
    one, other = pair.before, pair.after
    check_not_replaced([one.path, other.path, stable], [out / name for name in FILES])
    ground = read_areas(stable).on(one.place, one.shape) if stable else None
    signs, counts = signs_of(pair, false_alarms, ground)
    if stable and not counts["stable"]:
        raise SatIntervalsError(f"{stable} has no ground that both surfaces have: give one of the place")
    areas = ChangedAreas(pair, signs, smallest_area)
    tags = {
        "SOFTWARE": "sat-intervals", "BEFORE": str(one.path), "AFTER": str(other.path), "COVERAGE": f"{one.coverage:g}",
        "HEIGHTS": one.level or other.level or "unknown", "FALSE_ALARMS": f"{false_alarms:g}",
        "SMALLEST_AREA": f"{smallest_area:g} m2",
    }  # fmt: skip
    with OutputWriter(out, [change_file(FILES[0])], *one.shape, one.place, tags) as writer:
        for window in pair.strips():
            writer.write(window.row, areas.add(window))
            progress("change", window.row_stop, one.shape[0])
        writer.publish()
    figures, found = areas.report()
    if find_spec("pyogrio") and find_spec("shapely"):
        write_polygons(out / FILES[1], outlines(areas.labels, one.place), figures, one.place)
    else:
        (out / FILES[1]).unlink(missing_ok=True)  # never beside files of another change
        warnings.append(f"{FILES[1]} is not written: it needs pip install 'sat-intervals[reference]'")
    measured = counts["false"] / counts["stable"] if counts["stable"] else None
    rate = {"named": false_alarms, "measured": measured, "stable": counts["stable"], "median": pair.median}
    compared = {"compared": counts["compared"], "undecided": signs.size - counts["compared"]}
    report: dict[str, Any] = plain({
        "software": "sat-intervals", "before": one.path, "after": other.path, "smallest_area": smallest_area,
        "coverage": one.coverage, "cell": one.place.pixel_size[0], "registration": registration, "rate": rate,
        "correlation": pair.correlation._asdict(), **found, "cells": compared | found["cells"],
        "warnings": warnings + _rate_warnings(rate, pair.scale),
    })  # fmt: skip
    write_record(out / FILES[2], report)
    return report


def _check(false_alarms: float, smallest_area: float, sigma: float | None) -> None:
    """Raise for numbers that have no meaning."""
    if not 0 < false_alarms < 1:
        raise SatIntervalsError(f"false_alarms is {false_alarms:g}: give a share between 0 and 1, such as 0.01")
    if not 0 <= smallest_area < float("inf"):
        raise SatIntervalsError(f"smallest_area is {smallest_area:g}: give a number that is not negative")
    if sigma is not None and not 0 < sigma < LARGEST:
        raise SatIntervalsError(f"sigma is {sigma:g} m: give one above 0, up to {LARGEST:g}")


def _rate_warnings(rate: dict[str, Any], scale: float) -> list[str]:
    """Return warnings of more false alarms than named, or differences wider than intervals allow."""
    named, measured, found = rate["named"], rate["measured"] or 0.0, []
    if measured > _DOUBTFUL * named:
        found.append(
            f"{100 * measured:.2g} % of the stable ground count as changed, {100 * named:g} % were to: its heights "
            "changed, or intervals are too narrow there: calibrate them with calibrate --dsm"
        )
    if rate["median"] > _STATED:
        found.append(
            f"half of the differences exceed {rate['median']:.2f} standard deviations, .67 are expected: most of the "
            f"ground changed, or intervals are too narrow; they count as {scale / SCALE:.2g} times as wide as usual"
        )
    return found
