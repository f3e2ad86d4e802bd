"""``sat-intervals batch``: match many pairs on one cluster."""

from pathlib import Path
from typing import Any

import click

from sat_intervals.cli.logs import warn
from sat_intervals.cli.matching import RunArguments, SettingsArguments, run_options, settings_options
from sat_intervals.cli.options import FILE, Grouped
from sat_intervals.cli.rectify import say_rectified


@click.command(cls=Grouped, short_help="Match many pairs or stacks; a rerun matches the missing ones.")
@click.argument("pairs", type=FILE)
@click.argument("out", type=FILE)
@settings_options
@run_options
def batch(pairs: Path, out: Path, settings: SettingsArguments, run: RunArguments) -> None:
    """Match the PAIRS of a CSV, YAML or JSON file, or make surfaces, each in its own folder in OUT.

    Columns of a pair: name, left, right, minimum, maximum, left_mask, right_mask, nodata, band, window, and any setting
    such as sgm.p2.

    With resolution also its surface model, as by `surface`: of raw images with RPC models, or of an epipolar pair with
    left_model, right_model, left_grid, right_grid. Further columns: crs, radius, geoid, dem, altitude, resolution_of,
    height_calibration, ortho, fill (metres), flatten, mask.

    Of many images: name, resolution, and images (names or patterns separated by spaces) in place of left and right.
    Further columns: crs, geoid, extent, heights, height_calibration, ortho, fill, flatten, mask.

    A failed pair does not stop the others. OUT/batch.json has the state of each pair; the exit status is 1 if any
    failed.
    """
    from sat_intervals.config.batch import REPORT, read_batch
    from sat_intervals.heights.geometry import geometry_warnings
    from sat_intervals.raster.identity import check_not_replaced
    from sat_intervals.workflows.batch import match_batch

    check_not_replaced([pairs, settings.file], [out / REPORT])
    if run.dry_run and run.says_job(settings.load(), out):
        return
    doubts: list[str] = []
    with run.console() as console:

        def on_rectified(record: dict[str, Any]) -> None:
            say_rectified(console, record)
            doubts.extend(record["warnings"])

        report = match_batch(
            read_batch(pairs),
            out,
            settings.file,
            overrides=settings.sections,
            overwrite=run.overwrite,
            keep_tiles=run.keep_tiles,
            progress=console.progress,
            on_rectified=on_rectified,
        )
    run.say(report)
    console.batch_summary(report)
    of_surfaces = [
        line for end in report.values() for line in geometry_warnings(end.get("surface", {}).get("geometry", {}))
    ]
    warn(of_surfaces)
    done = ("done", "done before")
    failed = {name: end.get("error", end["state"]) for name, end in report.items() if end["state"] not in done}
    if failed:
        from sat_intervals.errors import RunError

        lines = "\n".join(f"  {name}: {error}" for name, error in failed.items())
        raise RunError(
            f"{len(failed)} of {len(report)} pairs failed; fix the causes and rerun the same command: it matches only "
            f"the missing pairs:\n{lines}"
        )
    of_runs = [line for end in report.values() for line in end.get("warnings", ())]
    run.check_strict([*doubts, *of_runs, *of_surfaces])
