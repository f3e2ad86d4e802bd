"""``sat-intervals plan``: what a run will take, before it is run."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.options import (
    disparity_option,
    image_options,
    log_options,
    named,
    settings_options,
    with_range,
)

if TYPE_CHECKING:
    from pathlib import Path

    from sat_intervals.raster import Image
    from sat_intervals.tiling import Window


@click.command(short_help="Say what a run will take: tiles, memory, disk, time.")
@click.argument("left", callback=named)
@click.argument("right", callback=named)
@disparity_option
@image_options
@click.option("--memory", metavar="SIZE", help="What a worker may take, such as 4GB: tiles get smaller until they fit.")
@settings_options
@log_options
def plan(
    left: str,
    right: str,
    disparity: tuple[int, int] | None,
    images: "Callable[[str, str], tuple[Image, Image]]",
    window: "Window | None",
    memory: str | None,
    config_file: "Path | None",
    given: dict[str, Any],
) -> None:
    """Say what matching LEFT and RIGHT will take; a small window at the centre is matched to tell the time.

    Takes the options of match, and those of its settings that matter, such as the jobs of a batch system.
    """
    from sat_intervals.config import load_config
    from sat_intervals.run.cluster import parse_memory
    from sat_intervals.run.plan import plan as make_plan

    config = load_config(config_file, with_range(given, disparity))
    made = make_plan(*images(left, right), config, window=window, memory=parse_memory(memory) if memory else None)
    smaller = " (smaller than set, to fit)" if made.tile_size < config.tiles.size else ""
    lines = {
        "tiles": f"{made.tiles} of {made.tile_size} px{smaller}, overlap {config.tiles.overlap} px",
        "extra work of the overlap": f"{100 * made.extra_work:.0f} %",
        "memory of a worker": f"{made.worker_bytes / 1e6:.0f} MB",
        f"  with {made.together} tiles at once": f"{made.together_bytes / 1e6:.0f} MB",
        "disk in the folder of the run": f"{made.disk_bytes / 1e9:.1f} GB at most",
        f"expected time, {made.workers} tiles at once": f"{_duration(made.seconds)}, with cores such as this machine's",
    }
    if made.together == 1:
        del lines["  with 1 tiles at once"]
    for name, value in lines.items():
        click.echo(f"{name + ':':<36}{value}")


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
