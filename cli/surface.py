"""``sat-intervals surface``: from two images to a surface model in one command."""

from functools import partial
from pathlib import Path
from typing import Any

import click

from sat_intervals.cli.dsm import calibration_option, cell_options, say_surface
from sat_intervals.cli.matching import (
    PairArguments,
    RunArguments,
    SettingsArguments,
    pair_options,
    run_options,
    search_options,
)
from sat_intervals.cli.options import FILE, Grouped, sensor_options
from sat_intervals.cli.rectify import raw_options, say_rectified


@click.command(cls=Grouped, short_help="Match a pair and make a surface model.")
@search_options
@pair_options
@click.argument("out", type=FILE)
@partial(sensor_options, models_alone=True)
@raw_options
@cell_options
@calibration_option("--height-calibration")
@run_options
def surface(
    pair: PairArguments,
    out: Path,
    sensor_files: list[tuple[Path, ...]],
    raw: dict[str, Any],
    cells: dict[str, Any],
    settings: SettingsArguments,
    run: RunArguments,
) -> None:
    """Match the images LEFT and RIGHT and write the surface model to OUT/dsm.tif.

    LEFT and RIGHT are raw images with RPC models, or an epipolar pair with the models and grids of its raw images. Raw
    images become the epipolar pair OUT/left.tif, OUT/right.tif, as by `rectify`; heights of --dem refer to --geoid.

    The same as `rectify`, `match` and `dsm`, with their options and files. To resume, rerun the same command: what is
    finished with these images and settings is kept, the surface is made again.
    """
    from sat_intervals.workflows.surface import FILES, surface

    if len(sensor_files) > 1:
        raise click.UsageError("give --left-model, --right-model, --left-grid and --right-grid once.")
    left, right = pair.open()
    settings.check_kept(out, *(out / name for name in FILES))
    config = settings.load()
    with run.console() as console:
        done = surface(
            left,
            right,
            out,
            config,
            **cells,
            **raw,
            sensors=sensor_files[0] if sensor_files else (),
            window=pair.window,
            keep_tiles=run.keep_tiles,
            overwrite=run.overwrite,
            progress=console.progress,
            on_rectified=partial(say_rectified, console),
        )
    run.say(done)
    console.summary(done["run"], out)
    say_surface(console, done["surface"])
    console.say(str(out / "dsm.tif"))
    run.check_strict(done["warnings"])
