"""Options and output shared by the commands that evaluate pairs with known truth."""

import math
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.options import FILE, Command, json_option, log_options, preset_option, say_json, with_options

if TYPE_CHECKING:
    from sat_intervals.config import Config
    from sat_intervals.config.pairs import Pair
    from sat_intervals.evaluate.paper import SceneMetrics


def finite(context: click.Context, parameter: click.Parameter, value: float) -> float:
    """Raise if a number of pixels is infinite or NaN."""
    if not math.isfinite(value):
        raise click.BadParameter(f"{value} is not a number of pixels")
    return value


tolerance_option = click.option(
    "--tolerance",
    type=click.FloatRange(min=0),
    default=0.0,
    callback=finite,
    metavar="PX",
    help="Truth up to PX outside an interval counts as inside; for quantised truth, give half a step.",
)


@dataclass(frozen=True)
class Judging:
    """How pairs with known truth are matched, compared with it and printed."""

    config_file: Path | None
    preset: str | None
    accurate: bool
    tolerance: float
    as_json: bool
    quiet: bool

    def load(self, pair: "Pair", **sections: Any) -> "Config":
        """Load the settings to match a pair with."""
        from sat_intervals.config import load_config

        sections["disparity"] = {"minimum": pair.minimum, "maximum": pair.maximum}
        if self.preset is not None:
            sections["preset"] = self.preset
        if self.accurate:
            sections["cross_check"] = {"method": "accurate"}
        return load_config(self.config_file, sections)


def judging_options(command: Command) -> Command:
    """Add the options of commands that evaluate pairs with known truth; the command gets ``judging``, a `Judging`."""

    @wraps(command)
    def with_judging(
        *,
        config_file: Path | None,
        preset: str | None,
        accurate: bool,
        tolerance: float,
        as_json: bool,
        quiet: bool,
        **others: Any,
    ) -> Any:
        return command(judging=Judging(config_file, preset, accurate, tolerance, as_json, quiet), **others)

    return with_options(
        with_judging,
        click.option("--config", "config_file", type=FILE, help="Settings to match pairs with (YAML)."),
        preset_option,
        click.option(
            "--accurate",
            is_flag=True,
            help="Cross-check against a right view that is matched on its own, as in the paper's implementation.",
        ),
        tolerance_option,
        json_option,
        click.option("--quiet", "-q", is_flag=True, help="Print figures and errors only."),
        log_options,
    )


def say_scenes(scenes: "list[SceneMetrics]") -> None:
    """Print reports of scenes as JSON: the report of one scene, or reports by name of several."""
    reports = {scene.name: scene.report for scene in scenes}
    say_json(scenes[0].report if len(scenes) == 1 else reports)
