"""``sat-intervals evaluate``: how often intervals contain the truth, and how wide they are."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.evaluate_dsm import Surface, surface_options
from sat_intervals.cli.judging import Judging, judging_options, say_scenes
from sat_intervals.cli.options import FILE

if TYPE_CHECKING:
    from sat_intervals.config import Config
    from sat_intervals.config.pairs import Pair
    from sat_intervals.evaluate.paper import SceneMetrics


@dataclass(frozen=True)
class _Source:
    """A finished run, or a pair to match first; with its truth and mask."""

    name: str
    pair: "Pair | None"
    truth: Path | None
    mask: Path | None


@click.command(short_help="Evaluate intervals against a known truth.")
@click.argument("folders", metavar="OUT...", nargs=-1, type=FILE)
@click.option("--truth", type=FILE, multiple=True, help="True disparity; one for each OUT, in that order.")
@click.option("--mask", type=FILE, multiple=True, help="Pixels to evaluate (not 0); one for each OUT, in that order.")
@click.option("--remove-bias", is_flag=True, help="Add the median of disparity - truth to the truth first.")
@click.option("--group", metavar="LABEL", help="Put all scenes in this group; ignore meta.json.")
@surface_options
@judging_options
def evaluate(
    folders: tuple[Path, ...],
    truth: tuple[Path, ...],
    mask: tuple[Path, ...],
    remove_bias: bool,
    group: str | None,
    surface: Surface | None,
    judging: Judging,
) -> None:
    """Evaluate the intervals of the runs in the folders OUT against the truth of their left images.

    Prints figures over valid pixels: accuracy (share of intervals that contain the truth), relative size (median width
    / width of the search range) and, for low confidence, relative overestimation (median of 1 - largest error of the
    area / width). If a run kept rejected pixels, also prints figures over all pixels with an interval. For several OUT,
    prints means over the scenes of each group (the paper's table 1), and the coverage of each scene; `group` is read
    from meta.json beside the left image.

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
        others = {
            "--truth": truth, "--mask": mask, "--remove-bias": remove_bias, "--group": group,
            "--config": judging.config_file, "--preset": judging.preset, "--accurate": judging.accurate,
            "--tolerance": judging.tolerance,
        }  # fmt: skip
        surface.check_alone(folders, others)
        surface.evaluate(judging.as_json, judging.quiet)
        return
    from sat_intervals.cli.tables import show_scene, show_scenes
    from sat_intervals.evaluate.disparity import evaluate_run
    from sat_intervals.evaluate.paper import SceneMetrics

    sources = _sources(folders, truth, mask)
    configs = _configs(sources, judging)
    judge = partial(evaluate_run, tolerance=judging.tolerance, remove_bias=remove_bias)
    scenes = [
        SceneMetrics(source.name, group or _group(source), _evaluated(judge, source, config, judging.quiet))
        for source, config in zip(sources, configs, strict=True)
    ]
    if not judging.quiet:
        _warn_of_whole_truth(scenes, judging.tolerance)
    if judging.as_json:
        say_scenes(scenes)
    elif len(scenes) == 1:
        show_scene(scenes[0])
    else:
        show_scenes(scenes)


def _warn_of_whole_truth(scenes: "list[SceneMetrics]", tolerance: float) -> None:
    """Suggest a tolerance for truths of whole pixels, which may be wrong by half a pixel."""
    names = [scene.name for scene in scenes if scene.report["truth_is_whole"]]
    if names and not tolerance:
        click.echo(f"warning: the truth of {', '.join(names)} has whole pixels only: try --tolerance 0.5", err=True)


def _sources(folders: tuple[Path, ...], truths: tuple[Path, ...], masks: tuple[Path, ...]) -> list[_Source]:
    """Return the sources named by the arguments, in their order."""
    if not folders:
        raise click.UsageError("Missing argument 'OUT...'.")
    from sat_intervals.config.pairs import check_names, find_pairs, is_pair
    from sat_intervals.errors import SatIntervalsError

    pairs = [folder for folder in folders if is_pair(folder) and not (folder / "run.json").exists()]
    find_pairs(pairs)  # raises if a pair is given twice
    runs = [folder.resolve() for folder in folders if folder not in pairs]
    for run, count in Counter(runs).items():
        if count > 1:
            raise SatIntervalsError(f"the run in {run} is given {count} times: give it once")
    found: list[tuple[str, Pair | None]] = []
    for folder in folders:
        if folder in pairs:
            found += [(pair.name, pair) for pair in find_pairs([folder])]
        else:
            found.append((str(folder), None))
    check_names(name for name, _ in found)
    for option, given in (("--truth", truths), ("--mask", masks)):
        if len(given) not in (0, len(found)):
            raise SatIntervalsError(f"{option} is given {len(given)} times for {len(found)} OUT: give it once for each")
    absent = (None,) * len(found)
    return [
        _Source(name, pair, truth, mask)
        for (name, pair), truth, mask in zip(found, truths or absent, masks or absent, strict=True)
    ]


def _configs(sources: list[_Source], judging: Judging) -> "list[Config | None]":
    """Return the settings to match each pair with; None for a run."""
    from sat_intervals.errors import SatIntervalsError

    given = {
        "--accurate": judging.accurate,
        f"--config {judging.config_file}": judging.config_file,
        f"--preset {judging.preset}": judging.preset,
    }
    option = next((name for name, value in given.items() if value), None)
    if option and not any(source.pair for source in sources):
        raise SatIntervalsError(f"{option} applies to pairs, but every OUT is a finished run: leave it out")
    configs: list[Config | None] = []
    for source in sources:
        config = None
        if source.pair:
            config = judging.load(source.pair, products={"keep_rejected": True})
            if config.interval is None:
                raise SatIntervalsError(
                    f"{judging.config_file}: interval is null, but evaluate needs intervals: leave it on"
                )
        configs.append(config)
    return configs


def _evaluated(
    judge: Callable[..., dict[str, Any]], source: _Source, config: "Config | None", quiet: bool
) -> dict[str, Any]:
    """Evaluate a run; match a pair to files first."""
    if source.pair is None or config is None:
        return judge(source.name, source.truth, source.mask)
    from sat_intervals.run.pair import match_pair

    if not quiet:
        click.echo(f"matching {source.name}", err=True)
    with TemporaryDirectory(prefix="sat-intervals-") as out:
        match_pair(source.pair.left, source.pair.right, out, config)
        return judge(out, source.truth or source.pair.truth, source.mask)


def _group(source: _Source) -> str:
    from sat_intervals.config.pairs import group_beside
    from sat_intervals.results import open_run

    if source.pair is not None:
        return source.pair.group
    return group_beside(open_run(source.name).report["inputs"]["left"]["path"])
