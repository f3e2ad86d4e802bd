"""``sat-intervals surface``: from two images or many to a surface model in one command."""

from functools import partial
from pathlib import Path
from typing import Any

import click

from sat_intervals.cli.dsm import cell_options, say_surface
from sat_intervals.cli.images import PairArguments, ground_options, many_options
from sat_intervals.cli.matching import RunArguments, SettingsArguments, run_options, search_options
from sat_intervals.cli.options import FILE, Grouped, sensor_options
from sat_intervals.cli.rectify import raw_options, say_rectified


@click.command(cls=Grouped, short_help="Make a surface model of two images or many.")
@search_options
@many_options
@click.argument("out", type=FILE)
@partial(sensor_options, models_alone=True)
@raw_options
@cell_options("--height-calibration")
@ground_options
@run_options
def surface(
    pair: PairArguments,
    out: Path,
    sensor_files: list[tuple[Path, ...]],
    raw: dict[str, Any],
    cells: dict[str, Any],
    ground: dict[str, Any],
    settings: SettingsArguments,
    run: RunArguments,
) -> None:
    """Make the surface model OUT/dsm.tif, with bounds of its heights, of two images, or three and more at once.

    Two images, LEFT and RIGHT, are raw images with RPC models, or an epipolar pair with the models and grids of its raw
    images. Raw images become the epipolar pair OUT/left.tif, OUT/right.tif, as by `rectify`; heights of --dem refer to
    --geoid. The same as `rectify`, `match` and `dsm`, with their options and files.

    Three raw images and more are compared at heights above the ground, all at once (preset many), and their models are
    shifted to fit each other: the more images, the more accurate.

    --fill fills voids inside the surface, --flatten gives areas such as lakes one height: count is 0 there.

    To resume, rerun the same command: what is finished with these images and settings is kept.
    """
    from sat_intervals.errors import check_absent
    from sat_intervals.workflows.surface import FILES, surface

    if sensor_files[1:]:
        raise click.UsageError("give --left-model, --right-model, --left-grid and --right-grid once.")
    check_absent({"--left-model": (pair.more and sensor_files) or None}, "two images")
    images = pair.open()
    settings.check_kept(out, *(out / name for name in FILES))
    if run.says_job(config := settings.load(len(images)), out):
        return
    with run.console() as console:
        done = surface(
            images,
            out,
            config,
            **(cells | raw | ground),
            sensors=sensor_files[0] if sensor_files else (),
            window=pair.window,
            keep_tiles=run.keep_tiles,
            overwrite=run.overwrite,
            progress=console.progress,
            on_rectified=partial(say_rectified, console),
        )
    run.say(done)
    if pair.more:
        console.summary_of_many(done, out)
    else:
        console.summary(done["run"], out)
        say_surface(console, done["surface"])
        console.say(str(out / "dsm.tif"))
    if cells["choices"].ortho:
        console.say(str(out / "ortho.tif"))
    run.check_strict(done["warnings"])
