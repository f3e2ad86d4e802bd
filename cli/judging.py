"""Options and output shared by the commands that evaluate pairs with known truth."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.options import log_options, preset_option

if TYPE_CHECKING:
    from sat_intervals.evaluate.paper import SceneMetrics


def finite(context: click.Context, parameter: click.Parameter, value: float) -> float:
    """Raise if a number of pixels is infinite or NaN."""
    if not math.isfinite(value):
        raise click.BadParameter(f"{value} is not a number of pixels")
    return value


def judging_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of commands that evaluate pairs with known truth."""
    options = [
        click.option(
            "--config", "config_file", type=click.Path(path_type=Path), help="Settings to match pairs with (YAML)."
        ),
        preset_option,
        click.option(
            "--accurate",
            is_flag=True,
            help="Cross-check against a right view that is matched on its own, as in the paper's implementation.",
        ),
        click.option(
            "--tolerance",
            type=click.FloatRange(min=0),
            default=0.0,
            callback=finite,
            metavar="PX",
            help="Truth up to PX outside an interval counts as inside; for quantised truth, give half a step.",
        ),
        click.option("--json", "as_json", is_flag=True, help="Print all figures as JSON."),
        click.option("--quiet", "-q", is_flag=True, help="Print figures and errors only."),
        log_options,
    ]
    for option in reversed(options):
        command = option(command)
    return command


def overrides(
    minimum: int, maximum: int, accurate: bool, preset: str | None, cost: str | None = None
) -> dict[str, Any]:
    """Return the settings of a pair and of the command line as sections."""
    sections: dict[str, Any] = {"disparity": {"minimum": minimum, "maximum": maximum}}
    if preset is not None:
        sections["preset"] = preset
    if cost is not None:
        sections["cost"] = {"method": cost}
    return sections | ({"cross_check": {"method": "accurate"}} if accurate else {})


def say_json(scenes: "list[SceneMetrics]") -> None:
    """Print reports of scenes as JSON: the report of one scene, or reports by name of several."""
    reports = {scene.name: scene.report for scene in scenes}
    click.echo(json.dumps(scenes[0].report if len(scenes) == 1 else reports, indent=1))
