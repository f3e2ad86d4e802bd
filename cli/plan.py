"""``sat-intervals plan``: what a run will take, before it is run."""

from pathlib import Path

import click

from sat_intervals.cli.match import COSTS


@click.command(short_help="Say what a run will take: tiles, memory, disk, time.")
@click.argument("left")
@click.argument("right")
@click.option("--disparity", type=int, nargs=2, metavar="MIN MAX", help="Search range in pixels.")
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="Settings (YAML).")
@click.option("--cost", type=click.Choice(COSTS), help="Matching cost; its penalties come with it.")
@click.option("--memory", metavar="SIZE", help="What a worker may take, such as 4GB: tiles get smaller until they fit.")
@click.option("--workers", type=click.IntRange(min=1), help="Tiles in work at once; default one a core.")
def plan(
    left: str,
    right: str,
    disparity: tuple[int, int] | None,
    config_file: Path | None,
    cost: str | None,
    memory: str | None,
    workers: int | None,
) -> None:
    """Say what matching LEFT and RIGHT will take; a small window at the centre is matched to tell the time."""
    from sat_intervals.cli.match import overrides
    from sat_intervals.config import load_config
    from sat_intervals.memory import parse_bytes
    from sat_intervals.plan import plan as make_plan

    config = load_config(config_file, overrides(disparity, cost=cost))
    made = make_plan(left, right, config, memory=parse_bytes(memory) if memory else None, workers=workers)
    smaller = " (smaller than set, to fit)" if made.tile_size < config.tiles.size else ""
    for name, value in (
        ("tiles", f"{made.tiles} of {made.tile_size} px{smaller}, overlap {config.tiles.overlap} px"),
        ("extra work of the overlap", f"{100 * made.extra_work:.0f} %"),
        ("memory of a worker", f"{made.worker_bytes / 1e6:.0f} MB"),
        (f"memory of {made.workers} workers in threads", f"{made.total_bytes / 1e6:.0f} MB"),
        ("disk in the folder of the run", f"{made.disk_bytes / 1e9:.1f} GB at most"),
        (f"expected time with {made.workers} workers", _duration(made.seconds)),
    ):
        click.echo(f"{name + ':':<36}{value}")


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
