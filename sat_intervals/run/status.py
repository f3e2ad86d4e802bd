"""Read the progress of a run or a batch from its folder."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sat_intervals.config.batch import REPORT
from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import BLOCK
from sat_intervals.store.lock import is_locked
from sat_intervals.store.manifest import StoreError, digest, grid_of, place_of, read_manifest
from sat_intervals.store.tiles import BORDERS, PARTS, TILES, Store, home_of

_STATES = "waiting", "done", "done before", "failed"  # of the pairs of a batch


@dataclass(frozen=True)
class Status:
    """Progress of a run: numbers of tiles, of path states handed on before them, and of strips after them; failures."""

    total: int
    done: int
    handed_on: int
    strips: int
    strips_done: int
    failed: dict[str, str]
    running: bool


def read_status(out: Path) -> Status:
    """Read the progress of a run from its tiles; raise StoreError if there are none."""
    manifest = read_manifest(home_of(out))
    if manifest is None:
        raise StoreError(f"{out} has no run: give the folder that match was given")
    grid = grid_of(manifest)
    store = Store(place_of(home_of(out), manifest), grid, digest(manifest))
    return Status(
        total=len(grid),
        done=len(store.names(TILES)),
        handed_on=len(store.names(BORDERS)),
        strips=-(-grid.region.height // BLOCK),
        strips_done=sum(name.startswith("0_") for name in store.names(PARTS)),
        failed=store.failures(),
        running=is_locked(out),
    )


def read_report(out: Path) -> dict[str, dict[str, Any]] | None:
    """Read the report of `match_batch` in a folder, None without one."""
    try:
        text = (out / REPORT).read_text(errors="replace")
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        states = {str(name): {"error": "", **ended} for name, ended in json.loads(text).items()}
        if not states or not all(ended["state"] in _STATES for ended in states.values()):
            raise ValueError("it has other states")
        return states
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise SatIntervalsError(
            f"{out / REPORT} is not the report of a batch: move it away and rerun the batch"
        ) from error


def runs_of(out: Path) -> list[Path]:
    """Return the folder of a run or, of a batch, those of its pairs that are done; raise if none is."""
    if (pairs := read_report(out)) is None:
        return [out]
    if runs := [out / name for name, ended in pairs.items() if ended["state"].startswith("done")]:
        return runs
    raise SatIntervalsError(f"{out} is a batch, and none of its pairs is done: {', '.join(pairs)}: see status {out}")
