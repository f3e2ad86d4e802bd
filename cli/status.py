"""``sat-intervals status``: how far a run is, from its folder alone."""

from pathlib import Path

import click

from sat_intervals.cli.options import store_option


@click.command(short_help="Say how far a run or a batch is.")
@click.argument("out", type=click.Path(path_type=Path))
@store_option
def status(out: Path, store: str | None) -> None:
    """Say how many tiles of the run in OUT are done, failed and left, while it goes on anywhere or after it died.

    Of the folder of a batch: the same of each of its pairs, and why pairs failed.
    """
    from sat_intervals.errors import SatIntervalsError
    from sat_intervals.run.status import ElsewhereError, read_report

    pairs = read_report(out)
    if pairs is None:
        _tell(out, store)
        return
    for name, ended in pairs.items():
        if ended["state"] == "failed":
            click.echo(f"{out / name}: failed: {ended['error']}")
            continue
        try:
            _tell(out / name, store)
        except ElsewhereError as error:
            click.echo(f"{out / name}: {ended['state']}; {error}")
        except SatIntervalsError:  # there is no run yet, or no more
            click.echo(f"{out / name}: {ended['state']}")


def _tell(out: Path, store: str | None) -> None:
    from sat_intervals.run.output import is_complete
    from sat_intervals.run.status import read_status

    if is_complete(out):
        click.echo(f"{out}: complete")
        return
    now = read_status(out / "tiles", store)
    left = now.total - now.done - len(now.failed)
    state = "a run is at work" if now.running else "no run is at work: the same command goes on from here"
    click.echo(f"{out}: {now.done} of {now.total} tiles done, {len(now.failed)} failed, {left} left; {state}")
    for name, reason in now.failed.items():
        click.echo(f"  tile {name}: {reason}")
