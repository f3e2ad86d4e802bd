"""``sat-intervals plan``: estimate tiles, memory, disk and time of a run."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.options import (
    disparity_option,
    grid_option,
    image_options,
    local_option,
    log_options,
    named,
    settings_options,
    with_range,
)

if TYPE_CHECKING:
    from pathlib import Path

    from sat_intervals.raster import Image
    from sat_intervals.run.plan import Plan
    from sat_intervals.tiling import Window


@click.command(short_help="Estimate tiles, memory, disk and time of a run.")
@click.argument("left", callback=named)
@click.argument("right", callback=named)
@disparity_option
@local_option
@grid_option
@image_options
@click.option(
    "--memory", metavar="SIZE", help="Memory of a worker, such as 4GB: tiles are made smaller until one fits."
)
@settings_options
@log_options
def plan(
    left: str,
    right: str,
    disparity: tuple[int, int] | None,
    local_range: bool,
    range_grid: str | None,
    open_images: "Callable[[str, str], tuple[Image, Image]]",
    window: "Window | None",
    memory: str | None,
    config_file: "Path | None",
    given: dict[str, Any],
) -> None:
    """Estimate tiles, memory, disk and time of matching LEFT and RIGHT, from a small window matched at the centre.

    Options and settings are those of match.
    """
    from sat_intervals.cli.console import Console
    from sat_intervals.config import load_config
    from sat_intervals.run.plan import plan as make_plan
    from sat_intervals.run.workers import parse_memory

    config = load_config(config_file, with_range(given, disparity, local_range, range_grid))
    limit = parse_memory(memory) if memory else None
    with Console(quiet=False) as console:
        made = make_plan(*open_images(left, right), config, window=window, memory=limit, progress=console.progress)
    smaller = " (smaller than set, to fit)" if made.tile_size < config.tiles.size else ""
    one, together = _verdicts(made, limit, config.cluster.kind)
    is_exact = config.tiles.overlap == "exact"
    seams = "exact seams" if is_exact else f"overlap {config.tiles.overlap} px"
    at_once = "1 tile" if made.workers == 1 else f"{made.workers} tiles"
    lines = {
        "tiles": f"{made.tiles} of {made.tile_size} px{smaller}, {seams}",
        f"extra work of the {'seams' if is_exact else 'overlap'}": f"{100 * made.extra_work:.0f} %",
        "memory of a worker": f"{made.worker_bytes / 1e6:.0f} MB{one}",
        f"  with {made.together} tiles at once": f"{made.together_bytes / 1e6:.0f} MB{together}",
        "disk in the folder of the run": f"{made.disk_bytes / 1e9:.1f} GB at most",
        f"expected time, {at_once} at once": f"{_duration(made.seconds)}, with cores such as this machine's",
    }
    if made.together == 1:
        del lines["  with 1 tiles at once"]
    for name, value in lines.items():
        click.echo(f"{name + ':':<36}{value}")


def _verdicts(plan: "Plan", limit: int | None, kind: str) -> tuple[str, str]:
    """Say whether one tile at once, and all tiles of a process at once, fit in the memory given, if any."""
    if limit is None:
        return "", ""
    memory = f"{limit / 1e6:.0f} MB"
    fits = f", fits in {memory}"
    if plan.together_bytes <= limit:
        return fits, fits
    tile = (plan.together_bytes - plan.worker_bytes) / (plan.together - 1)
    most = 1 + int((limit - plan.worker_bytes) / tile)
    way_out = f"--workers {most}" if kind == "threads" else f"cluster.cores {most}"
    return fits, f", does not fit in {memory}: give {way_out}"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
