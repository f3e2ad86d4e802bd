"""``sat-intervals demo``: match a procedural scene with exact truth."""

from pathlib import Path
from typing import Any

import click

from sat_intervals.cli.matching import RunArguments, SettingsArguments, run_options, settings_options
from sat_intervals.cli.options import FILE, Grouped


@click.command(cls=Grouped, short_help="Make a scene with exact truth, match it and compare.")
@click.argument("out", type=FILE)
@click.option(
    "--size", type=int, nargs=2, metavar="ROWS COLUMNS", default=(1200, 1200), show_default=True, help="Size in pixels."
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the scene.")
@click.option(
    "--relief",
    type=click.FloatRange(0, 2000),
    default=0,
    metavar="METRES",
    show_default=True,
    help="Height of a mountain under the city; 1 m is a disparity of 1 px.",
)
@click.option(
    "--images",
    type=click.IntRange(3, 24),
    metavar="N",
    help="Make N raw images, whose models are off by a pixel, and the surface of all of them.",
)
@settings_options
@run_options
def demo(
    out: Path,
    size: tuple[int, int],
    seed: int,
    relief: float,
    images: int | None,
    settings: SettingsArguments,
    run: RunArguments,
) -> None:
    """Make a procedural satellite scene, match it and print how often the interval contains the truth.

    \b
    OUT/left.tif, OUT/right.tif   the pair, georeferenced, no data in a corner
    OUT/truth.tif                 the exact disparity
    and the files of `match`; with --images
    OUT/1.tif, OUT/2.tif, ...     raw images with RPC models
    OUT/truth.tif                 the exact heights
    and the files of `surface`.
    """  # noqa: D301 (\b keeps the line breaks in click)
    if run.dry_run and run.says_job(settings.load(images or 2), out):
        return
    if images:
        _demo_of_many(out, images, size, settings, run, seed=seed, relief=relief)
        return
    from sat_intervals.demo import PIXEL, make_scene
    from sat_intervals.evaluate.disparity import evaluate_run
    from sat_intervals.raster import north_up
    from sat_intervals.workflows.demo import CRS, LEFT, TOP, write_once

    layers = [out / f"{name}.tif" for name in ("left", "right", "truth")]
    somewhere, nodata = north_up(CRS, LEFT, TOP, PIXEL), (0, 0, float("nan"))
    with run.console() as console:
        console.progress("scene", 0, 1)
        scene = make_scene(*size, seed=seed, relief=relief)
        config = settings.load(disparity={"minimum": scene.minimum, "maximum": scene.maximum})
        settings.check_kept(out, *layers)
        for path, pixels, value in zip(layers, (scene.left, scene.right, scene.truth), nodata, strict=True):
            write_once(path, pixels, value, somewhere, overwrite=run.overwrite)
        console.progress("scene", 1, 1)
        report = run.match(out / "left.tif", out / "right.tif", out, config, progress=console.progress)
    figures = evaluate_run(out, out / "truth.tif")["all"]
    run.say({"run": report, "truth": figures})
    if not run.as_json:
        console.summary(report, out)
        if figures["count"]:
            console.say(
                f"The interval contains the truth for {100 * figures['accuracy']:.1f} % of {figures['count']} pixels, "
                f"at a mean width of {figures['mean_width']:.2f} px."
            )
    run.check_strict(report["warnings"])


def _demo_of_many(
    out: Path, count: int, size: tuple[int, int], settings: SettingsArguments, run: RunArguments, **scene: Any
) -> None:
    """Make raw images and the surface of all of them, and compare it with the true heights."""
    from sat_intervals.demo import PIXEL
    from sat_intervals.evaluate.surface_accuracy import evaluate_surface
    from sat_intervals.workflows.demo import write_views
    from sat_intervals.workflows.surface import surface

    settings.check_kept(out, out / "truth.tif", out / "dsm.tif")
    config = settings.load(count)
    how = {"keep_tiles": run.keep_tiles, "overwrite": run.overwrite}
    with run.console() as console:
        console.progress("scene", 0, 1)
        paths, truth = write_views(out, *size, count, overwrite=run.overwrite, **scene)
        console.progress("scene", 1, 1)
        report = surface(paths, out, config, resolution=PIXEL, progress=console.progress, **how)
    figures = evaluate_surface(out / "dsm.tif", truth)["all"]
    run.say({"run": report, "truth": figures})
    if not run.as_json:
        console.summary_of_many(report, out)
        console.say(
            f"The interval contains the true height for {100 * figures['coverage']:.1f} % of the cells, once the "
            f"surface is moved onto the truth; NMAD of height - truth {figures['nmad']:.2f} m."
        )
    run.check_strict(report["warnings"])
