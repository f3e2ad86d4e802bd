"""What the commands share that compare with a known truth: pairs and runs, options, reports."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.matching import SettingsArguments, settings_options
from sat_intervals.cli.options import Command, gathered, json_option, log_options, say_json

if TYPE_CHECKING:
    from sat_intervals.config import Config
    from sat_intervals.config.pairs import Pair
    from sat_intervals.evaluate.paper import SceneMetrics


def _finite(context: click.Context, parameter: click.Parameter, value: float) -> float:
    """Raise if a number of pixels is infinite or NaN, which no range of click refuses."""
    if not math.isfinite(value):
        raise click.BadParameter(f"{value} is not a number of pixels")
    return value


TOLERANCE: dict[str, Any] = {"type": click.FloatRange(min=0), "default": 0.0, "callback": _finite, "metavar": "PX"}
tolerance_option = click.option(
    "--tolerance",
    **TOLERANCE,
    help="Truth up to PX outside an interval counts as inside; for quantised truth, give half a step.",
)


@dataclass(frozen=True)
class Judging:
    """How pairs with known truth are matched, compared with it and printed."""

    settings: SettingsArguments
    tolerance: float
    as_json: bool
    quiet: bool

    def load(self, pair: "Pair", **sections: Any) -> "Config":
        """Load the settings to match a pair with."""
        search = {"minimum": pair.minimum, "maximum": pair.maximum}
        config: Config = self.settings.load(disparity=search, **sections)
        return config


def judging_options(command: Command) -> Command:
    """Add the options of commands that evaluate pairs with known truth; the command gets ``judging``, a `Judging`."""
    quiet_option = click.option("--quiet", "-q", is_flag=True, help="Print figures and errors only.")
    with_judging = gathered("judging", Judging, tolerance_option, json_option, quiet_option)
    return settings_options(with_judging(log_options(command)))


@dataclass(frozen=True)
class Source:
    """A finished run, or a pair to match first; with the truth and the mask that are given for it."""

    name: str
    pair: "Pair | None"
    truth: Path | None
    mask: Path | None


def find_sources(paths: Sequence[Path], truths: Sequence[Path], masks: Sequence[Path] = ()) -> list[Source]:
    """Return the runs and pairs named by the arguments, in their order."""
    from sat_intervals.config.pairs import check_names, find_pairs, is_pair
    from sat_intervals.errors import SatIntervalsError

    found: list[tuple[str, Pair | None]] = []
    for path in paths:
        if (path / "run.json").exists():
            found.append((str(path), None))
        elif is_pair(path):
            found += [(pair.name, pair) for pair in find_pairs([path])]
        else:
            raise SatIntervalsError(
                f"{path} is neither a pair nor a finished run: give a folder with left.tif, right.tif, truth.tif and "
                "meta.json, a CSV, YAML or JSON file of pairs, or the folder of a run"
            )
    check_names(name for name, _ in found)
    for option, given in (("--truth", truths), ("--mask", masks)):
        if len(given) not in (0, len(found)):
            raise SatIntervalsError(
                f"{option} is given {len(given)} times for {len(found)} runs and pairs: give it once for each"
            )
    absent = (None,) * len(found)
    return [
        Source(*one, truth, mask) for one, truth, mask in zip(found, truths or absent, masks or absent, strict=True)
    ]


def say_scenes(scenes: "list[SceneMetrics]") -> None:
    """Print reports of scenes as JSON: the report of one scene, or reports by name of several."""
    reports = {scene.name: scene.report for scene in scenes}
    say_json(scenes[0].report if len(scenes) == 1 else reports)
