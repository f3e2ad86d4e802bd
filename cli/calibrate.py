"""``sat-intervals calibrate``: find the levels that reach a coverage, on pairs with known truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.calibrate_dsm import calibrate_heights
from sat_intervals.cli.calibration_files import check_output, write
from sat_intervals.cli.judging import find_sources, tolerance_option
from sat_intervals.cli.matching import SettingsArguments, settings_options
from sat_intervals.cli.options import (
    FILE,
    Surface,
    json_option,
    log_options,
    overwrite_option,
    quiet_option,
    say_json,
    surface_options,
)

if TYPE_CHECKING:
    from sat_intervals.config import Calibration
    from sat_intervals.config.pairs import Pair
    from sat_intervals.run.measure import CalibrationScene

_CALIBRATION = """\
# Calibration: levels of the cost curve, and factors, that reach a coverage, found by sat-intervals calibrate.
# Use it with: sat-intervals match LEFT RIGHT OUT --coverage 0.9 --calibration FILE, with the settings of `key`.
# `expected`: figures of pairs with the levels found on the other pairs; coverage of all, high and low confidence.
"""


@click.command(short_help="Find the levels that reach a coverage, on pairs with known truth.")
@click.argument("pairs", nargs=-1, type=FILE)
@click.option("--output", type=FILE, required=True, help="Calibration to write (YAML).")
@overwrite_option
@click.option("--truth", type=FILE, multiple=True, help="True disparity; one for each of PAIRS, in that order.")
@tolerance_option
@click.option("--remove-bias", is_flag=True, help="Add the median of disparity - truth of each pair to its truth.")
@click.option(
    "--by-group", is_flag=True, help="Leave out all pairs of a group together (meta.json, CSV), not each pair."
)
@click.option("--name", help="Name of the calibration; by default that of the file.")
@surface_options("Calibrate this surface model against --reference, instead of pairs.", "pairs", "coverage")
@json_option
@click.option(
    "--coverage",
    type=float,
    metavar="C",
    help="With --dsm: coverage that the margins must reach, .5 to .99; default: the coverage of the runs.",
)
@partial(settings_options, levels=False)
@quiet_option
@log_options
def calibrate(
    pairs: tuple[Path, ...],
    output: Path,
    overwrite: bool,
    truth: tuple[Path, ...],
    name: str | None,
    surface: Surface | None,
    coverage: float | None,
    settings: SettingsArguments,
    as_json: bool,
    quiet: bool,
    **judging: Any,
) -> None:
    """Find the levels of the cost curve whose intervals reach coverages of .5 to .99 on PAIRS, and write them to FILE.

    Use FILE with: match --coverage 0.9 --calibration FILE. It is valid for images like those of PAIRS, and only with
    the same settings.

    One of PAIRS is a folder with left.tif, right.tif, truth.tif and meta.json (`disparity`: [minimum, maximum],
    `group`), a CSV, YAML or JSON file with left, right, truth, minimum, maximum and optionally name, group, tolerance
    and remove_bias, or the folder of a finished run, which is matched again from its images. The truth may be sparse:
    unknown pixels are NaN or no data.

    The table shows what to expect: figures of each pair with the levels found on the others, means over pairs. A single
    pair is split into 16 blocks, and each block is evaluated with the levels found on the other 15.

    With --dsm: find margins in metres, so that the intervals of a surface model contain the required share of the
    heights of --reference (its own coverage, or --coverage). Use FILE with: dsm --calibration FILE.
    """
    if surface is not None:
        calibrate_heights(surface, output, name, coverage, overwrite=overwrite, as_json=as_json, quiet=quiet)
        return
    if not pairs:
        raise click.UsageError("give PAIRS, or --dsm and --reference.")
    from sat_intervals.cli.console import Console
    from sat_intervals.cli.tables import show_calibration
    from sat_intervals.run.calibrate import calibration_from, check_scenes
    from sat_intervals.run.measure import measure_scenes

    scenes = _scenes(pairs, truth, _Judging(settings, **judging))
    _check_kept(settings, scenes, [*pairs, *truth], output)
    check_output(output, overwrite=overwrite)
    folder = output.absolute().parent
    check_scenes(scenes)
    with Console(quiet or as_json) as console:
        parts = measure_scenes(scenes, folder, console.progress)
    calibration, expected = calibration_from(parts, scenes, name or output.stem)
    write_calibration(output, calibration)
    if as_json:
        say_json({"calibration": calibration.model_dump(mode="json"), "expected": expected})
    elif not quiet:
        show_calibration(calibration, expected)
        click.echo(str(output))


def _check_kept(
    settings: SettingsArguments, scenes: "list[CalibrationScene]", given: Sequence[Path], output: Path
) -> None:
    """Raise if the output is an input, describes one, or is a file that the settings name."""
    from sat_intervals.config import named_files, read_yaml
    from sat_intervals.raster.identity import check_not_replaced

    named = named_files(read_yaml(settings.file)) if settings.file else []
    read = [file for one in scenes for file in (one.left.path, one.right.path, one.truth.image.path)]
    described = [one / name for one in given for name in ("meta.json", "run.json")]
    check_not_replaced([*read, *given, *described, settings.file, *named], [output])


@dataclass(frozen=True)
class _Judging:
    """Options that decide how pairs are matched and compared with their truth."""

    settings: SettingsArguments
    tolerance: float
    remove_bias: bool
    by_group: bool


def _scenes(paths: tuple[Path, ...], truths: tuple[Path, ...], judging: _Judging) -> "list[CalibrationScene]":
    """Open the pairs and runs named by the arguments, in their order."""
    return [
        _of_pair(source.pair, source.truth, judging)
        if source.pair
        else _of_run(Path(source.name), source.truth, judging)
        for source in find_sources(paths, truths)
    ]


def _of_pair(pair: "Pair", truth: Path | None, judging: _Judging) -> "CalibrationScene":
    from sat_intervals.raster import open_image
    from sat_intervals.run.measure import CalibrationScene, truth_of

    config = judging.settings.load(disparity={"minimum": pair.minimum, "maximum": pair.maximum})
    left = open_image(pair.left)
    return CalibrationScene(
        pair.name,
        pair.group if judging.by_group else pair.name,
        left,
        open_image(pair.right),
        truth_of(left, truth or pair.truth),
        config,
        tolerance=judging.tolerance if pair.tolerance is None else pair.tolerance,
        remove_bias=judging.remove_bias if pair.remove_bias is None else pair.remove_bias,
    )


def _of_run(out: Path, truth: Path | None, judging: _Judging) -> "CalibrationScene":
    """Open a finished run, with its own settings unless the options choose others."""
    from sat_intervals.config import Cluster, load_config
    from sat_intervals.config.pairs import group_beside
    from sat_intervals.errors import SatIntervalsError
    from sat_intervals.results import open_results
    from sat_intervals.run.measure import CalibrationScene

    run = open_results(out, truth)
    if run.truth is None:
        raise SatIntervalsError(f"{out}: there is no truth.tif beside its left image {run.left.path}: give --truth")
    settings = judging.settings
    if settings.file or settings.sections.keys() & {"preset", "cost"}:
        config = settings.load(disparity=run.config.disparity.model_dump())
    else:
        here = run.config.model_copy(update={"cluster": Cluster()})  # the run's may be jobs of a batch system
        config = load_config(here, settings.sections)
    group = group_beside(run.left.path) if judging.by_group else str(out)
    return CalibrationScene(
        str(out), group, run.left, run.right, run.truth, config, run.region, judging.tolerance, judging.remove_bias
    )


def write_calibration(output: Path, calibration: "Calibration") -> None:
    """Write a calibration with an explanation."""
    write(output, _CALIBRATION, calibration.model_dump(mode="json"))
