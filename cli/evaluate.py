"""``sat-intervals evaluate``: how often intervals contain the truth, and how wide they are."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.evaluate_dsm import Details, details_options, evaluate_heights
from sat_intervals.cli.judging import Judging, Source, find_sources, judging_options, say_scenes
from sat_intervals.cli.logs import warn
from sat_intervals.cli.options import FILE, Surface, surface_options

if TYPE_CHECKING:
    from sat_intervals.config import Config
    from sat_intervals.evaluate.paper import SceneMetrics

# Pixels of median error above which the truth may be biased.
_BIAS = 0.25


@click.command(short_help="Evaluate intervals against a known truth.")
@click.argument("folders", metavar="OUT...", nargs=-1, type=FILE)
@click.option("--truth", type=FILE, multiple=True, help="True disparity; one for each OUT, in that order.")
@click.option("--mask", type=FILE, multiple=True, help="Pixels to evaluate (not 0); one for each OUT, in that order.")
@click.option("--remove-bias", is_flag=True, help="Add the median of disparity - truth to the truth first.")
@click.option("--group", metavar="LABEL", help="Put all scenes in this group; ignore meta.json.")
@surface_options(
    "Evaluate this surface model against --reference, instead of runs.",
    "runs and pairs",
    *("classes", "pictures", "line", "overwrite"),
)
@details_options
@judging_options
def evaluate(
    folders: tuple[Path, ...],
    truth: tuple[Path, ...],
    mask: tuple[Path, ...],
    remove_bias: bool,
    group: str | None,
    surface: Surface | None,
    details: Details,
    judging: Judging,
) -> None:
    """Evaluate the intervals of the runs in the folders OUT against the truth of their left images.

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
    LE90 of height - reference, the share of reference heights inside the cells' intervals and the half widths, by slope
    of the reference, by width of the interval and by --classes. The reference is first moved by its constant shift from
    the surface; figures of all cells are printed before and after that.
    """
    if surface:
        evaluate_heights(surface, details, as_json=judging.as_json, quiet=judging.quiet)
        return
    if not folders:
        raise click.UsageError("Missing argument 'OUT...'.")
    from sat_intervals.cli.tables import show_scene, show_scenes
    from sat_intervals.evaluate.paper import SceneMetrics

    sources = find_sources(folders, truth, mask)
    configs = _configs(sources, judging)
    scenes = []
    for source, config in zip(sources, configs, strict=True):
        if config and not judging.quiet:
            click.echo(f"matching {source.name}", err=True)
        report = _evaluated(source, config, tolerance=judging.tolerance, remove_bias=remove_bias)
        scenes.append(SceneMetrics(source.name, group or _group(source), report))
    if judging.as_json:
        say_scenes(scenes)
    elif len(scenes) == 1:
        show_scene(scenes[0])
    else:
        show_scenes(scenes)
    if not judging.quiet:
        biased = [scene for scene in scenes if abs(scene.report["median_error"] or 0.0) > _BIAS]
        warn(map(_biased, biased))
        names = [scene.name for scene in scenes if scene.report["truth_is_whole"] and scene not in biased]
        if names and not judging.tolerance:  # such a truth may be wrong by half a pixel
            warn([f"the truth of {', '.join(names)} has whole pixels only: try --tolerance 0.5"])


def _biased(scene: "SceneMetrics") -> str:
    error = scene.report["median_error"]
    return (
        f"{scene.name}: the median of disparity - truth is {error:+.2f} px: if the truth is only known up to a "
        "constant, such as one of registered heights, try --remove-bias"
    )


def _configs(sources: list[Source], judging: Judging) -> "list[Config | None]":
    """Return the settings to match each pair with; None for a run."""
    from sat_intervals.errors import SatIntervalsError

    if judging.settings.options and not any(source.pair for source in sources):
        option = judging.settings.options[0]
        raise SatIntervalsError(f"{option} applies to pairs, but every OUT is a finished run: leave it out")
    configs = [
        judging.load(source.pair, products={"keep_rejected": True}) if source.pair else None for source in sources
    ]
    if any(config and config.interval is None for config in configs):
        place = f"{judging.settings.file}: " if judging.settings.file else ""
        raise SatIntervalsError(f"{place}interval is null, but evaluate needs intervals: leave it on")
    return configs


def _evaluated(source: Source, config: "Config | None", **how: Any) -> dict[str, Any]:
    """Evaluate a run; match a pair to files first."""
    from sat_intervals.evaluate.disparity import evaluate_run

    if source.pair is None or config is None:
        return evaluate_run(source.name, source.truth, source.mask, **how)
    from sat_intervals.run.pair import match_pair

    with TemporaryDirectory(prefix="sat-intervals-") as out:
        warn(match_pair(source.pair.left, source.pair.right, out, config)["warnings"])
        return evaluate_run(out, source.truth or source.pair.truth, source.mask, **how)


def _group(source: Source) -> str:
    from sat_intervals.config.pairs import group_beside
    from sat_intervals.results import open_run

    if source.pair is None:
        return group_beside(open_run(source.name).report["inputs"]["left"]["path"])
    group: str = source.pair.group
    return group
