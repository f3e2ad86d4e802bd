"""How far a run or a batch is, from its folder alone."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sat_intervals.config.pairs import REPORT
from sat_intervals.errors import SatIntervalsError
from sat_intervals.store.folder import LocalFolder
from sat_intervals.store.place import ElsewhereError
from sat_intervals.store.tiles import is_replacing, store_of

__all__ = ["ElsewhereError", "Status", "is_replacing", "read_report", "read_status"]


@dataclass(frozen=True)
class Status:
    """How far the tiles of a run are.

    Attributes
    ----------
    total, done
        Numbers of tiles.
    failed
        Why tiles failed that are not done since, by name.
    running
        Whether a run is at work on them.
    """

    total: int
    done: int
    failed: dict[str, str]
    running: bool


def read_status(home: Path, store: str | None = None) -> Status:
    """How far a run is, from its store alone.

    Parameters
    ----------
    home
        Folder of the tiles in that of the run, wherever they lie.
    store
        The store that the user names; without it none but ``home`` is looked at.

    Raises
    ------
    StoreError
        Where there is no store, or it is said to be in another than the user names.
    """
    there = store_of(home, store)
    return Status(len(there.grid), len(there.done()), there.failures(), LocalFolder(home).is_locked())


def read_report(out: Path) -> dict[str, dict[str, Any]] | None:
    """What `match_batch` said last of the pairs in a folder; None where there is no batch."""
    text = LocalFolder(out).read(REPORT)
    if text is None:
        return None
    try:
        return {
            str(name): {"error": "", **ended, "state": str(ended["state"])} for name, ended in json.loads(text).items()
        }
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise SatIntervalsError(f"{out / REPORT} is not the report of a batch: run the batch again") from error
