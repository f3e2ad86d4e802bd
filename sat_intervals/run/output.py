"""The folder of a run: whether it can be used, is complete, and holds what was published."""

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from sat_intervals.errors import SatIntervalsError
from sat_intervals.store.tiles import finished_run, has_begun, is_replacing

OUTPUTS = ("intervals.tif", "validity.tif", "run.json")


def check_output(out: Path, overwrite: bool) -> None:
    """Make the folder of a run, or tell why it cannot be used."""
    if os.path.lexists(out) and not out.is_dir():
        raise SatIntervalsError(f"{out} is no folder: choose another")
    try:
        there = [name for name in OUTPUTS if (out / name).exists()]
        # run.json is the last: without it, but with tiles, a run was killed between the names of its files
        home = out / "tiles"
        is_unfinished = is_replacing(home) or finished_run(home) is not None
        is_under_way = is_unfinished or ("run.json" not in there and has_begun(home))
        if there and not overwrite and not is_under_way:
            raise holds_run(out, there)
        if home.is_symlink():
            raise SatIntervalsError(f"{home} is a symbolic link: name the place of the tiles with --store")
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise SatIntervalsError(f"{out} cannot be written: {error.strerror}: choose another folder") from error


def holds_run(out: Path, there: Sequence[str]) -> SatIntervalsError:
    """The error for a folder that is not to be replaced."""
    return SatIntervalsError(f"{out} already holds a run ({', '.join(there)}): choose another folder or --overwrite")


def is_complete(out: Path) -> bool:
    """Whether a folder holds all files of a run, and none has begun that is to replace them."""
    return all((out / name).exists() for name in OUTPUTS) and not is_replacing(out / "tiles")


def stamps(out: Path) -> list[str]:
    """Sizes and times of the files of a run, which a copy of the folder that keeps times has too."""
    found = [(out / name).stat() for name in OUTPUTS]
    return [f"{status.st_size:x}-{status.st_mtime_ns:x}" for status in found]


def check_as_published(out: Path) -> None:
    """Hold that a complete run whose tiles are still there has the files that it published, before the tiles go.

    Raises
    ------
    SatIntervalsError
        With the first that is another.
    """
    _, noted = finished_run(out / "tiles") or ("", [])
    for name, before, now in zip(OUTPUTS, noted, stamps(out), strict=False):
        if now != before:
            raise SatIntervalsError(
                f"{out / name} was changed after the run, whose tiles are still there: delete it, and the same command "
                "makes it again, or start afresh with --overwrite"
            )
