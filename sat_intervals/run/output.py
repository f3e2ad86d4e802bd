"""Check the folder of a run: whether it can be used, is complete, and has the published files."""

import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sat_intervals.errors import RunError, SatIntervalsError, check_regular, open_regular
from sat_intervals.raster import RUN_FILES, examined, restore, stamps
from sat_intervals.raster.beside import check_place
from sat_intervals.raster.identity import checksum_of
from sat_intervals.raster.seal import is_as_made
from sat_intervals.store.manifest import SEAL, unsealed
from sat_intervals.store.marks import finished_run, is_replacing
from sat_intervals.store.removal import has_begun

OUTPUTS = (*(file.name for file in RUN_FILES), "run.json")


def check_output(out: Path, overwrite: bool, *, has_transform: bool = True) -> None:
    """Create the folder of a run, or raise if it cannot be used; see `check_place`."""
    if os.path.lexists(out) and not out.is_dir():
        raise SatIntervalsError(f"{out} is not a folder: choose another")
    home = out / "tiles"
    try:
        if home.is_symlink():
            raise SatIntervalsError(f"{home} is a symbolic link: move it away, and give its folder with --store")
        if home.exists() and not home.is_dir():
            raise SatIntervalsError(f"{home} is not a folder: move it away")
        there = [name for name in OUTPUTS if (out / name).exists()]
        if folders := [name for name in there if (out / name).is_dir()]:
            raise SatIntervalsError(f"{out / folders[0]} is a folder: move it away or choose another folder")
        # run.json is renamed last: tiles without it are from a run that was killed before
        is_unfinished = is_replacing(home) or finished_run(home) is not None
        is_under_way = is_unfinished or ("run.json" not in there and has_begun(home))
        if there and not overwrite and not is_under_way:
            check_replaceable(out)
            raise holds_run(out, there)
        for file in RUN_FILES:
            check_place(out / file.name, has_transform=has_transform)
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise SatIntervalsError(f"{out} cannot be written: {error.strerror}: choose another folder") from error


def replaceable(out: Path, *, overwrite: bool) -> dict[str, str]:
    """Return the `stamps` of a run's files, after those that a killed process put aside are restored.

    With ``overwrite`` it does what `check_replaceable` does: files may have appeared or been restored since.
    """
    restore(out, RUN_FILES)
    with examined(out, OUTPUTS) as there:
        if overwrite:
            check_replaceable(out)
    return there


def check_replaceable(out: Path) -> None:
    """Check a folder before its files are overwritten.

    Raises
    ------
    SatIntervalsError
        A file with the name of a run's file was not made by a run, or was changed since.
    """
    published = _published(out / "run.json")
    is_mixed = is_replacing(out / "tiles")  # a killed run has perhaps replaced some of the files
    for file in (out / name for name in OUTPUTS):
        check_regular(file, "move it away or choose another folder")
        if file.exists() and not _is_of_run(file, published, is_mixed=is_mixed):
            raise SatIntervalsError(
                f"{file} exists and was not made by sat-intervals, or was changed since: move it away or choose "
                "another folder"
            )


def _is_of_run(file: Path, published: dict[str, Any] | None, *, is_mixed: bool) -> bool:
    if file.name == "run.json":
        return published is not None
    if published and checksum_of(file) == published.get(file.name):
        return True
    return (is_mixed or not published) and is_as_made(file)


def _published(file: Path) -> dict[str, Any] | None:
    """Return sizes and checksums of rasters from a run's report; empty if there is no report, None if it is none."""
    try:
        with open_regular(file) as stream:
            text = stream.read().decode()
        report = (unsealed(text) if SEAL in json.loads(text) else json.loads(text)) or {}
        return dict(report.get("files", {})) if {"settings", "inputs", "tiles"} <= report.keys() else None
    except FileNotFoundError:
        return {}
    except PermissionError as error:
        raise SatIntervalsError(f"{file} cannot be read: {error.strerror}: change its rights") from error
    except (OSError, ValueError, AttributeError, TypeError, RecursionError):
        return None


def holds_run(out: Path, there: Sequence[str]) -> SatIntervalsError:
    """Return the error for a folder with a run that must not be replaced."""
    return SatIntervalsError(f"{out} already holds a run ({', '.join(there)}): choose another folder or --overwrite")


def is_complete(out: Path) -> bool:
    """Return whether a folder has all files of a run, and no unfinished run is to replace them."""
    return all((out / name).exists() for name in OUTPUTS) and not is_replacing(out / "tiles")


def check_as_published(out: Path) -> None:
    """Raise if a published file of a run was changed; call it before removing the tiles.

    Raises
    ------
    SatIntervalsError
        Names the first changed file.
    """
    _, noted = finished_run(out / "tiles") or ("", [])
    before = dict(zip(OUTPUTS, noted, strict=False))  # a damaged mark has fewer, which is no reason to trust a file
    if name := _changed(out, before):
        raise SatIntervalsError(
            f"{out / name} was changed after the run, but the tiles still exist: delete it and rerun the same "
            "command to make it again"
        )


def check_still_published(out: Path, published: Mapping[str, str], *, has_tiles: bool) -> None:
    """Raise if a file of a run is not the one that it has just published, with the way out with or without tiles.

    Raises
    ------
    RunError
        Names the first file that no longer has its one of these `stamps`.
    """
    if name := _changed(out, published):
        way_out = "delete it and rerun the same command" if has_tiles else "move it away and rerun with --overwrite"
        raise RunError(f"{out / name} was changed or moved away before the run ended: {way_out}")


def _changed(out: Path, before: Mapping[str, str]) -> str | None:
    now = stamps(out, OUTPUTS)
    return next((name for name in OUTPUTS if now.get(name) != before.get(name)), None)
