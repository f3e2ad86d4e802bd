"""``sat-intervals status``: show the progress of a run or a batch."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from sat_intervals.cli.options import FILE, json_option, say_json


@click.command(short_help="Show the progress of a run or a batch.")
@click.argument("out", type=FILE)
@json_option
def status(out: Path, as_json: bool) -> None:
    """Show how many tiles and strips of the run in OUT are done, during the run or after it ended.

    Of the folder of a batch, the progress of each pair, and why pairs failed.
    """
    from sat_intervals.results import open_run
    from sat_intervals.run.state import is_complete
    from sat_intervals.run.status import read_report

    pairs = read_report(out)
    if pairs is None:
        if is_complete(out):
            open_run(out)  # raises if a file is missing
        found = {str(out): _state(out)}
    else:
        found = {str(out / name): _state_of_pair(out / name, ended) for name, ended in pairs.items()}
    if as_json:
        say_json(found)
        return
    for name, state in found.items():
        for line in _lines(name, state):
            click.echo(line)


def _state_of_pair(out: Path, ended: dict[str, Any]) -> dict[str, Any]:
    from sat_intervals.errors import SatIntervalsError

    if ended["state"] == "failed":
        return {"state": "failed", "error": ended["error"]}
    try:
        return _state(out)
    except SatIntervalsError:  # no run yet, or already removed
        return {"state": ended["state"]}


def _state(out: Path) -> dict[str, Any]:
    """Return the state of a run: complete, or how many tiles are done."""
    from sat_intervals.run.state import is_complete
    from sat_intervals.run.status import read_status

    return {"state": "complete"} if is_complete(out) else {"state": "tiles", **asdict(read_status(out))}


def _lines(name: str, state: dict[str, Any]) -> Iterator[str]:
    if state["state"] != "tiles":
        separator = ": " if state["state"] == "failed" else "; "
        yield f"{name}: {state['state']}" + (f"{separator}{state['error']}" if "error" in state else "")
        return
    left = state["total"] - state["done"] - len(state["failed"])
    what = "a run is active" if state["running"] else "no run is active, the same command resumes it"
    if state["handed_on"]:
        what += f"; {state['handed_on']} path states are handed on"
    strips = f", {state['strips_done']} of {state['strips']} strips done" if state["strips_done"] else ""
    tiles = f"{state['done']} of {state['total']} tiles done, {len(state['failed'])} failed, {left} left"
    yield f"{name}: {tiles}{strips}; {what}"
    for tile, reason in state["failed"].items():
        yield f"  tile {tile}: {reason}"
