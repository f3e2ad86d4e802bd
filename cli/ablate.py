"""``sat-intervals ablate``: compare parts of the method on pairs with known truth."""

from functools import partial
from pathlib import Path

import click

from sat_intervals.cli.judging import Judging, judging_options, say_scenes
from sat_intervals.cli.options import FILE


@click.command(short_help="Compare parts of the method on pairs with known truth.")
@click.argument("pairs", nargs=-1, required=True, type=FILE)
@partial(judging_options, levels=False)
def ablate(pairs: tuple[Path, ...], judging: Judging) -> None:
    """Compare the paper's baseline, alpha-cuts at several levels, and the whole method on PAIRS.

    Every pair is matched once, in memory. The table shows the accuracy (share of valid pixels whose interval contains
    the truth), averaged over the scenes of each group. The last column is the whole method, with regularisation. With
    --preset paper it is the paper's table 2.

    A pair is a folder with left.tif, right.tif, truth.tif and meta.json (`disparity`: [minimum, maximum], optionally
    `group`), or a row of a CSV file with the columns left, right, truth, minimum, maximum and optionally name and
    group. Paths in the file are relative to it.
    """
    from sat_intervals.cli.tables import show_groups
    from sat_intervals.config.pairs import find_pairs
    from sat_intervals.evaluate.ablation import ablate_pair
    from sat_intervals.evaluate.paper import SceneMetrics, table_2

    found = find_pairs(pairs)
    configs = [judging.load(pair) for pair in found]
    scenes = []
    for pair, config in zip(found, configs, strict=True):
        if not judging.quiet:
            click.echo(f"matching {pair.name}", err=True)
        scenes.append(SceneMetrics(pair.name, pair.group, ablate_pair(pair, config, tolerance=judging.tolerance)))
    if judging.as_json:
        say_scenes(scenes)
    else:
        show_groups(table_2(scenes), "accuracy, means over scenes, valid pixels")
