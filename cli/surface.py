"""``sat-intervals surface``: from two images or many to a surface model in one command."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.dsm import calibration_option, cell_options, say_surface
from sat_intervals.cli.matching import (
    IMAGE_OPTIONS,
    PairArguments,
    RunArguments,
    SettingsArguments,
    pair_options,
    run_options,
    search_options,
)
from sat_intervals.cli.options import FILE, NAME, Grouped, gathered, sensor_options
from sat_intervals.cli.rectify import raw_options, say_rectified

if TYPE_CHECKING:
    from sat_intervals.raster import Image


def _of_many(
    *,
    images: tuple[str, ...],
    left_mask: str | None,
    right_mask: str | None,
    nodata: tuple[float, float] | None,
    band: tuple[int, int] | None,
    region: tuple[int, int, int, int] | None,
) -> PairArguments:
    """Return the first two images as a pair, with the others beside it."""
    if len(images) < 2:
        raise click.UsageError("give two images or more, and the folder OUT.")
    return PairArguments(images[0], images[1], left_mask, right_mask, nodata, band, region, images[2:])


_IMAGES = click.argument("images", metavar="LEFT RIGHT [MORE...]", nargs=-1, required=True, type=NAME)
_many_options = gathered("pair", _of_many, _IMAGES, *IMAGE_OPTIONS)


@click.command(cls=Grouped, short_help="Match two images or many and make a surface model.")
@search_options
@partial(pair_options, images=_many_options)
@click.argument("out", type=FILE)
@partial(sensor_options, models_alone=True)
@raw_options
@cell_options
@calibration_option("--height-calibration")
@click.option(
    "--heights",
    type=float,
    nargs=2,
    metavar="MIN MAX",
    help="Three images or more: heights of the ground, metres; default: found from the images.",
)
@click.option("--ortho", is_flag=True, help="Three images or more: write OUT/ortho.tif, their median on the surface.")
@run_options
def surface(
    pair: PairArguments,
    out: Path,
    sensor_files: list[tuple[Path, ...]],
    raw: dict[str, Any],
    cells: dict[str, Any],
    heights: tuple[float, float] | None,
    ortho: bool,
    settings: SettingsArguments,
    run: RunArguments,
) -> None:
    """Match two images, or three and more at once, and write the surface model to OUT/dsm.tif.

    Two images, LEFT and RIGHT, are raw images with RPC models, or an epipolar pair with the models and grids of its raw
    images. Raw images become the epipolar pair OUT/left.tif, OUT/right.tif, as by `rectify`; heights of --dem refer to
    --geoid. The same as `rectify`, `match` and `dsm`, with their options and files.

    Three raw images and more are compared at heights above the ground, all at once (preset many), and their models are
    shifted to fit each other: the more images, the more accurate, and the narrower the intervals.

    To resume, rerun the same command: what is finished with these images and settings is kept.
    """
    if pair.more:
        images = _opened(pair)
        _check_many(sensor_files, raw, cells, settings)
        _surface_of_many(images, out, cells | {"heights": heights, "makes_ortho": ortho}, settings, run)
        return
    if heights or ortho:
        raise click.UsageError("--heights and --ortho are for three images or more: leave them out.")
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


def _check_many(
    sensor_files: list[tuple[Path, ...]], raw: dict[str, Any], cells: dict[str, Any], settings: SettingsArguments
) -> None:
    """Raise if an option is given that only a pair has."""
    from sat_intervals.heights.choices import SurfaceChoices

    given = ["--left-model"] if sensor_files else []
    given += ["--" + name.replace("_", "-") for name, value in raw.items() if value is not None]
    given += ["--disparity"] if "disparity" in settings.sections else []
    given += ["--radius"] if cells["radius"] is not None else []
    given += ["an option for points"] if cells["choices"] != SurfaceChoices() else []
    if given:
        raise click.UsageError(f"{given[0]} is for two images: leave it out.")


def _surface_of_many(
    images: "list[Image]",
    out: Path,
    cells: dict[str, Any],
    settings: SettingsArguments,
    run: RunArguments,
) -> None:
    from sat_intervals.config import load_config
    from sat_intervals.workflows.many import surface_of_many

    settings.check_kept(out, out / "dsm.tif")
    preset = {} if "preset" in settings.sections else {"preset": "many"}
    config = load_config(settings.file or preset, settings.sections)
    how = {name: cells[name] for name in ("resolution", "crs", "geoid", "heights", "makes_ortho")}
    with run.console() as console:
        report = surface_of_many(
            images,
            out,
            config,
            **how,
            keep_tiles=run.keep_tiles,
            overwrite=run.overwrite,
            progress=console.progress,
        )
    run.say(report)
    console.summary_of_many(report, out)
    run.check_strict(report["warnings"])


def _opened(pair: PairArguments) -> "list[Image]":
    """Open all images; what was given for one side goes with two images only."""
    from sat_intervals.raster import open_image

    one_sided: dict[str, Any] = {
        "--left-mask": pair.left_mask,
        "--right-mask": pair.right_mask,
        "--window": pair.region,
    }
    for name, both in (("--nodata LEFT,RIGHT", pair.nodata), ("--band LEFT,RIGHT", pair.band)):
        one_sided[name] = both if both and both[0] != both[1] else None
    if given := [name for name, value in one_sided.items() if value is not None]:
        raise click.UsageError(f"{given[0]} is for two images: leave it out.")
    nodata, band = pair.nodata or (None,), pair.band or (None,)
    return [open_image(name, band=band[0], nodata=nodata[0]) for name in (pair.left, pair.right, *pair.more)]
