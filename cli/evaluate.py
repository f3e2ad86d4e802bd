"""``sat-intervals evaluate``: how often intervals contain the truth, and how wide they are."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli import options
from sat_intervals.cli.evaluate_dsm import Details, details_options, evaluate_heights
from sat_intervals.cli.logs import warn
from sat_intervals.cli.matching import SettingsArguments, settings_options
from sat_intervals.cli.options import FILE, Printing, Surface

if TYPE_CHECKING:
    from sat_intervals.evaluate.paper import SceneMetrics

# Pixels of median error above which the truth may be biased.
_BIAS = 0.25


@click.command(cls=options.Grouped, short_help="Compare intervals, or heights of a surface, with a truth.")
@click.argument("folders", metavar="[OUT]...", nargs=-1, type=FILE)
@click.option("--truth", "truths", type=FILE, multiple=True, help="True disparity; one for each OUT, in that order.")
@click.option(
    "--mask", "masks", type=FILE, multiple=True, help="Pixels to evaluate (not 0); one for each OUT, in that order."
)
@click.option("--remove-bias", is_flag=True, help="Add the median of disparity - truth to the truth first.")
@click.option("--group", metavar="LABEL", help="Put all scenes in this group; ignore meta.json.")
@options.surface_options(
    "Evaluate this surface model against --reference, instead of runs.",
    "runs and pairs",
    *("classes", "within", "pictures", "line", "overwrite"),
)
@details_options
@settings_options
@options.tolerance_option
@options.gathered(
    "printing",
    Printing,
    options.json_option,
    click.option("--quiet", "-q", is_flag=True, help="Print figures and errors only."),
)
@options.log_options
def evaluate(
    folders: tuple[Path, ...],
    surface: Surface | None,
    details: Details,
    settings: SettingsArguments,
    printing: Printing,
    **how: Any,
) -> None:
    """Evaluate the intervals of the runs in the folders OUT against the truth of their images, or a surface (--dsm).

    Prints figures over valid pixels: coverage (share of intervals that contain the truth), widths and interval score;
    --json also has the paper's relative size (median width / width of the search range) and relative overestimation
    (median of 1 - largest error of the area / width). If a run kept rejected pixels, also prints figures over all
    pixels with an interval. For several OUT, prints means over the scenes of each group (the paper's table 1), and the
    coverage of each scene; `group` is read from meta.json beside the left image.

    Without --truth, the truth is truth.tif beside the left image. OUT may also be a pair, which is matched first: a
    folder with left.tif, right.tif, truth.tif and meta.json (`disparity`: [minimum, maximum], `group`), or a CSV file
    with the columns left, right, truth, minimum, maximum and optionally name and group. Its paths are relative to the
    file.

    For a surface model (--dsm), prints bias, median, NMAD (1.4826 times the median distance from the median), RMSE and
    LE90 of height - reference, the share of reference heights inside the cells' intervals, the half widths, and
    completeness (shares of the reference heights that have a height, and one --within so many metres), by slope of the
    reference, by half width of the interval and by --classes; and how well half widths rank errors (AUSE). The
    reference is first moved by its constant shift from the surface; figures of all cells are printed before and after
    that.
    """
    if surface:
        evaluate_heights(surface, details, printing)
        return
    if not folders:
        raise click.UsageError("Missing argument 'OUT...'.")
    from sat_intervals.cli.tables import show_scene, show_scenes
    from sat_intervals.errors import SatIntervalsError
    from sat_intervals.workflows.evaluate import evaluate_scenes

    if settings.options and all((folder / "run.json").exists() for folder in folders):
        raise SatIntervalsError(
            f"{settings.options[0]} applies to pairs, but every OUT is a finished run: leave it out"
        )

    def on_match(name: str) -> None:
        if not printing.quiet:
            click.echo(f"matching {name}", err=True)

    scenes = evaluate_scenes(folders, settings.file, settings.sections, on_match=on_match, **how)
    if printing.as_json:
        printing.say(scenes[0].report if len(scenes) == 1 else {scene.name: scene.report for scene in scenes})
    elif len(scenes) == 1:
        show_scene(scenes[0])
    else:
        show_scenes(scenes)
    if not printing.quiet:
        warn(_doubts(scenes, how["tolerance"]))


def _doubts(scenes: "list[SceneMetrics]", tolerance: float) -> list[str]:
    """Return warnings of truths that may be biased or rounded."""
    biased = [scene for scene in scenes if abs(scene.report["median_error"] or 0.0) > _BIAS]
    lines = [
        f"{scene.name}: the median of disparity - truth is {scene.report['median_error']:+.2f} px: if the truth is "
        "only known up to a constant, such as one of registered heights, try --remove-bias"
        for scene in biased
    ]
    names = [scene.name for scene in scenes if scene.report["truth_is_whole"] and scene not in biased]
    if names and not tolerance:  # such a truth may be wrong by half a pixel
        lines.append(f"the truth of {', '.join(names)} has whole pixels only: try --tolerance 0.5")
    return lines
