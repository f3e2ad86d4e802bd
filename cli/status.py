"""``sat-intervals status``: show the progress of a run or a batch."""

from pathlib import Path

import click

from sat_intervals.cli.options import store_option


@click.command(short_help="Show the progress of a run or a batch.")
@click.argument("out", type=click.Path(path_type=Path))
@store_option
def status(out: Path, store: str | None) -> None:
    """Show how many tiles of the run in OUT are done, failed and left, during the run or after it ended.

    The files of a complete run are compared with their checksums. For the folder of a batch, show the progress of each
    pair, and why pairs failed, without reading the files.
    """
    from sat_intervals.errors import SatIntervalsError
    from sat_intervals.results import open_run
    from sat_intervals.run.output import is_complete
    from sat_intervals.run.status import ElsewhereError, read_report

    pairs = read_report(out)
    if pairs is None:
        if is_complete(out):
            open_run(out)  # raises if a file was damaged since
        _show(out, store)
        return
    for name, ended in pairs.items():
        if ended["state"] == "failed":
            click.echo(f"{out / name}: failed: {ended['error']}")
            continue
        try:
            _show(out / name, store)
        except ElsewhereError as error:
            click.echo(f"{out / name}: {ended['state']}; {error}")
        except SatIntervalsError:  # no run yet, or already removed
            click.echo(f"{out / name}: {ended['state']}")


def _show(out: Path, store: str | None) -> None:
    from sat_intervals.run.output import is_complete
    from sat_intervals.run.status import read_status

    if is_complete(out):
        click.echo(f"{out}: complete")
        return
    now = read_status(out / "tiles", store)
    left = now.total - now.done - len(now.failed)
    state = "a run is active" if now.running else "no run is active, the same command resumes it"
    if now.handed_on:
        state += f"; {now.handed_on} path states are handed on"
    click.echo(f"{out}: {now.done} of {now.total} tiles done, {len(now.failed)} failed, {left} left; {state}")
    for name, reason in now.failed.items():
        click.echo(f"  tile {name}: {reason}")
