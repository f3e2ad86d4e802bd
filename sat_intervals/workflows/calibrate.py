"""Calibrate intervals on pairs and runs with a known truth, and write the calibration."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sat_intervals.config import Calibration, Cluster, Config, load_config, named_files, read_yaml
from sat_intervals.config.pairs import Pair, group_beside
from sat_intervals.errors import SatIntervalsError
from sat_intervals.progress import Progress
from sat_intervals.raster import OutputError, check_not_replaced, open_image, path_of
from sat_intervals.raster.publishing import check_free, write_file
from sat_intervals.results import open_results
from sat_intervals.run.calibrate import calibration_from, check_scenes
from sat_intervals.run.measure import CalibrationScene, measure_scenes, truth_of
from sat_intervals.workflows.sources import Source, find_sources

_HEAD = """\
# Calibration: levels of the cost curve, and factors, that reach a coverage, found by sat-intervals calibrate.
# Use it with: sat-intervals match LEFT RIGHT OUT --coverage 0.9 --calibration FILE, with the settings of `key`.
# `expected`: figures of pairs with the levels found on the other pairs; coverage of all, high, edge and low confidence.
"""


def calibrate(
    pairs: Sequence[str | Path],
    output: str | Path,
    config: Path | Mapping[str, Any] | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    truths: Sequence[str | Path] = (),
    tolerance: float = 0.0,
    remove_bias: bool = False,
    by_group: bool = False,
    name: str | None = None,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> tuple[Calibration, list[dict[str, float]]]:
    """Find the levels of the cost curve whose intervals reach coverages of .5 to .99 on pairs, and write them.

    Parameters
    ----------
    pairs
        Folders of pairs with ``left.tif``, ``right.tif``, ``truth.tif`` and ``meta.json``; CSV, YAML or JSON files of
        pairs; folders of finished runs, which are matched again.
    output
        YAML file to write, for the setting ``interval.calibration``.
    config, overrides
        Settings to match with: a file or sections, and sections that win over them. A run is matched with its own
        unless ``config``, or a preset or a cost, is given.
    truths
        True disparities, one for each of the pairs and runs; by default those of the pairs, and beside the left images.
    tolerance
        Distance in pixels up to which a truth outside an interval counts as inside.
    remove_bias
        Whether to add the median of disparity - truth of each pair to its truth.
    by_group
        Whether all pairs of a group are left out together, for the expected figures.
    name
        Name of the calibration; by default that of the file.
    overwrite
        Whether ``output`` may be replaced.
    progress
        Callback, see `Progress`.

    Returns
    -------
    The calibration, and what to expect of it: for each coverage the figures of each pair with the levels found on the
    others, means over pairs.

    Raises
    ------
    SatIntervalsError
        Pairs, truths, settings or output cannot be used.
    RunError
        Tiles failed.
    """
    output, paths, files = path_of(output), [*map(path_of, pairs)], [*map(path_of, truths)]
    scenes = scenes_of(paths, files, Choices(config, overrides, tolerance, remove_bias, by_group))
    _check_kept(scenes, [*paths, *files], config, output)
    check_output(output, overwrite=overwrite)
    check_scenes(scenes)
    parts = measure_scenes(scenes, output.absolute().parent, progress)
    calibration, expected = calibration_from(parts, scenes, name or output.stem)
    write_calibration(output, calibration)
    return calibration, expected


@dataclass(frozen=True)
class Choices:
    """How pairs are matched and compared with their truth, see `calibrate`."""

    config: Path | Mapping[str, Any] | None = None
    overrides: Mapping[str, Any] | None = None
    tolerance: float = 0.0
    remove_bias: bool = False
    by_group: bool = False

    def load(self, search: Mapping[str, Any]) -> Config:
        """Load the settings with a search range."""
        return load_config(load_config(self.config, self.overrides), {"disparity": search})


def scenes_of(paths: Sequence[Path], truths: Sequence[Path], choices: Choices) -> list[CalibrationScene]:
    """Open pairs and runs, in their order."""
    return [
        _of_pair(source.pair, source.truth or source.pair.truth, choices) if source.pair else _of_run(source, choices)
        for source in find_sources(paths, truths)
    ]


def _of_pair(pair: Pair, truth: Path, choices: Choices) -> CalibrationScene:
    config = choices.load({"minimum": pair.minimum, "maximum": pair.maximum})
    left = open_image(pair.left)
    return CalibrationScene(
        pair.name,
        pair.group if choices.by_group else pair.name,
        left,
        open_image(pair.right),
        truth_of(left, truth),
        config,
        tolerance=choices.tolerance if pair.tolerance is None else pair.tolerance,
        remove_bias=choices.remove_bias if pair.remove_bias is None else pair.remove_bias,
    )


def _of_run(source: Source, choices: Choices) -> CalibrationScene:
    """Open a finished run, with its own settings unless others are chosen."""
    run = open_results(source.name, source.truth)
    run.check_pair()
    if run.truth is None:
        raise SatIntervalsError(f"{run.out}: there is no truth.tif beside its left image {run.left.path}: give --truth")
    if choices.config or (choices.overrides or {}).keys() & {"preset", "cost"}:
        config = choices.load(run.config.disparity.model_dump())
    else:
        here = run.config.model_copy(update={"cluster": Cluster()})  # the run's may be jobs of a batch system
        config = load_config(here, choices.overrides)
    group = group_beside(path_of(run.left.path)) if choices.by_group else source.name
    judged = choices.tolerance, choices.remove_bias
    return CalibrationScene(source.name, group, run.left, run.right, run.truth, config, run.region, *judged)


def _check_kept(
    scenes: Sequence[CalibrationScene], given: Sequence[Path], config: Path | Mapping[str, Any] | None, output: Path
) -> None:
    """Raise if the output is an input, describes one, or is a file that the settings name."""
    settings = read_yaml(config) if isinstance(config, Path) else config
    named = [*named_files(settings), config if isinstance(config, Path) else None]
    read = [file for one in scenes for file in (one.left.path, one.right.path, one.truth.image.path)]
    described = [one / name for one in given for name in ("meta.json", "run.json")]
    check_not_replaced([*read, *given, *described, *named], [output])


def check_output(output: Path, *, overwrite: bool) -> None:
    """Raise if a file cannot be written, or exists and may not be replaced."""
    check_free(output, overwrite=overwrite)
    if not os.access(output.absolute().parent, os.W_OK):
        raise OutputError(f"{output} cannot be written: give --output a file in an existing folder")


def write_calibration(output: Path, calibration: Calibration) -> None:
    """Write a calibration with an explanation."""
    write_commented(output, _HEAD, calibration.model_dump(mode="json"))


def write_commented(output: Path, head: str, content: dict[str, Any]) -> None:
    """Write a YAML file; ``head`` is its explanation, lines of comments."""
    write_file(output, f"{head}{yaml.safe_dump(content, sort_keys=False, width=120)}".encode())
