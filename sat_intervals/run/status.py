"""Read the progress of a run or a batch from its folder."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sat_intervals.config.pairs import REPORT
from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import BLOCK
from sat_intervals.store.folder import LocalFolder
from sat_intervals.store.marks import is_replacing
from sat_intervals.store.parts import parts_in
from sat_intervals.store.place import ElsewhereError
from sat_intervals.store.removal import BORDERS
from sat_intervals.store.tiles import store_of

__all__ = ["ElsewhereError", "Status", "is_replacing", "read_report", "read_status"]

# States of the pairs of a batch.
_STATES = "waiting", "done", "done before", "failed"


@dataclass(frozen=True)
class Status:
    """Progress of the tiles and strips of a run.

    Attributes
    ----------
    total, done
        Numbers of tiles.
    handed_on
        Number of path states that tiles handed to their neighbours, which come before the tiles.
    strips, strips_done
        Numbers of strips, which come after the tiles.
    failed
        Why tiles failed, by name, without those done since.
    running
        Whether a run is active.
    """

    total: int
    done: int
    handed_on: int
    strips: int
    strips_done: int
    failed: dict[str, str]
    running: bool


def read_status(home: Path, store: str | None = None) -> Status:
    """Read the progress of a run from its store.

    Parameters
    ----------
    home
        Folder of the tiles in the folder of the run, even if they are elsewhere.
    store
        The store that the user names; without it only ``home`` is read.

    Raises
    ------
    StoreError
        There is no store, or it is not the one that the user names.
    """
    there = store_of(home, store)
    handed_on = len(there.folder.inside(BORDERS).sizes())
    return Status(
        total=len(there.grid),
        done=len(there.done()),
        handed_on=handed_on,
        strips=-(-there.grid.region.height // BLOCK),
        strips_done=parts_in(there).strips_done(),
        failed=there.failures(),
        running=LocalFolder(home).is_locked(),
    )


def read_report(out: Path) -> dict[str, dict[str, Any]] | None:
    """Read the report of `match_batch` in a folder, None without one."""
    text = LocalFolder(out).read(REPORT)
    if text is None:
        return None
    try:
        states = {str(name): {"error": "", **ended} for name, ended in json.loads(text).items()}
        if not states or not all(ended["state"] in _STATES for ended in states.values()):
            raise ValueError("it has other states")
        return states
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise SatIntervalsError(
            f"{out / REPORT} is not the report of a batch: move it away and rerun the batch"
        ) from error
