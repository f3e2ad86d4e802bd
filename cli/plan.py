"""``sat-intervals plan``: estimate tiles, memory, disk and time of a run."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.dsm import grid_options, side_of
from sat_intervals.cli.images import PairArguments, ground_options, many_options
from sat_intervals.cli.matching import SettingsArguments, search_options
from sat_intervals.cli.options import Grouped, json_option, log_options, say_json
from sat_intervals.cli.rectify import raw_pair_options

if TYPE_CHECKING:
    from sat_intervals.config import Config
    from sat_intervals.run.plan import Plan


@click.command(cls=Grouped, short_help="Estimate tiles, memory, disk and time of a run.")
@search_options
@many_options
@raw_pair_options
@grid_options
@ground_options
@click.option(
    "--memory", metavar="SIZE", help="Memory of a worker, such as 4GB: tiles are made smaller until one fits."
)
@json_option
@log_options
def plan(
    pair: PairArguments,
    settings: SettingsArguments,
    ground: dict[str, Any],
    raw: dict[str, Any],
    grid: dict[str, Any],
    memory: str | None,
    as_json: bool,
) -> None:
    """Estimate tiles, memory, disk and time of matching LEFT and RIGHT, or of a surface of two raw images or more.

    The time comes from a sample matched at the centre, or elsewhere if there is no data. Options are those of match;
    with --resolution or --grid-like the images are raw: of two the middle is resampled, and its search range found; of
    more shifts, grid and heights. Memory is that of matching.
    """
    from sat_intervals.cli.console import Console, lines_of_grid
    from sat_intervals.run.workers import parse_memory

    config = settings.load(2 + len(pair.more))
    limit = parse_memory(memory) if memory else None
    with Console(quiet=as_json) as console:
        made = _planned(pair, config, grid, ground, raw, memory=limit, progress=console.progress)
        if made.sweep:
            console.say_images(made.sweep)
    if as_json:
        say_json(asdict(made))
        return
    is_smaller = made.tile_size < config.tiles.size
    smaller = f" (smaller than set, to fit: give --tile-size {made.tile_size})" if is_smaller else ""
    one, together = _verdicts(made, limit, config.cluster.kind)
    is_exact = config.tiles.overlap == "exact"
    seams = "exact seams" if is_exact else f"overlap {config.tiles.overlap} px"
    at_once = "1 tile" if made.workers == 1 else f"{made.workers} tiles"
    lines = lines_of_grid(made.sweep) if made.sweep else {"search range": "{} to {} px".format(*made.search_range)}
    lines |= {
        "tiles": f"{made.tiles} of {made.tile_size} px{smaller}, {seams}",
        f"extra work of the {'seams' if is_exact else 'overlap'}": f"{100 * made.extra_work:.0f} %",
        "memory of a worker": f"{made.worker_bytes / 1e6:.0f} MB{one}",
        f"  with {made.together} tiles at once": f"{made.together_bytes / 1e6:.0f} MB{together}",
        "disk in the folder of the run": f"{made.disk_bytes / 1e9:.1f} GB at most",
        f"expected time, {at_once} at once": f"{_duration(made.seconds)}, on cores like this machine's",
    }
    if made.together == 1:
        del lines["  with 1 tiles at once"]
    for name, value in lines.items():
        click.echo(f"{name + ':':<36}{value}")


def _planned(
    pair: PairArguments, config: "Config", grid: dict[str, Any], ground: dict[str, Any], raw: dict[str, Any], **how: Any
) -> "Plan":
    """Plan the match of two images, or the surface of two raw images or more on a grid."""
    from sat_intervals.errors import check_absent
    from sat_intervals.run.plan import plan as of_pair
    from sat_intervals.workflows.many import Wanted
    from sat_intervals.workflows.plan import plan_of_many, plan_of_raw

    images = pair.open()
    is_surface = pair.more or grid["resolution"] is not None or grid["grid_like"]
    if not pair.more:
        check_absent(_options(ground), "three images or more")
    if not is_surface:
        check_absent(_options(grid | raw), "surfaces, with --resolution or --grid-like")
        return of_pair(images[0], images[1], config, window=pair.window, **how)
    check_absent({"--window": pair.region}, "epipolar images")
    side = side_of(grid.pop("resolution"), grid.pop("grid_like"))
    if pair.more:
        check_absent(_options(raw), "two images")
        return plan_of_many(images, config, Wanted(side, **grid, **ground), **how)
    return plan_of_raw(images, config, grid | {"resolution": side, "radius": None}, raw, **how)


def _options(given: dict[str, Any]) -> dict[str, Any]:
    return {f"--{name.replace('_', '-')}": value for name, value in given.items()}


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
    remedy = f"--workers {most}" if kind == "threads" else f"cluster.cores {most}"
    return fits, f", does not fit in {memory}: give {remedy}"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
