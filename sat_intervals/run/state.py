"""The state of a run's folder: what its manifest and its ``run.json`` say, and what a command does then."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from sat_intervals.config import Cluster, Config
from sat_intervals.errors import ChangedInputError, SatIntervalsError
from sat_intervals.products import plain
from sat_intervals.raster import RUN_FILES, File, RemotePath, run_files
from sat_intervals.store.manifest import MANIFEST, StoreError, differences, read_manifest
from sat_intervals.store.remote import is_there
from sat_intervals.store.tiles import home_of

RUN_REPORT = "run.json"
OUTPUTS = (*(file.name for file in RUN_FILES), RUN_REPORT)
OUTPUTS_OF_SWEEP = ("dsm.tif", *OUTPUTS[1:])
# What every report of a run has.
_SECTIONS = {"settings", "inputs", "tiles"}

NextStep = Literal["start", "resume", "start anew", "complete"]


def files_of_run(config: Config) -> tuple[File, File]:
    """Return the files that a run writes."""
    return run_files(config.products.compression, config.extra_bands, of_heights=not config.cost.compares_two)


def outputs_of(config: Config) -> tuple[str, ...]:
    """Return the names of all files that a run writes."""
    return *(file.name for file in files_of_run(config)), RUN_REPORT


def with_store(settings: Cluster, out: Path) -> Cluster:
    """Return settings that keep tiles in the folder of a run, if that is in a bucket and no store is given."""
    is_kept = settings.store is None and isinstance(out, RemotePath)
    return settings.model_copy(update={"store": str(home_of(out))}) if is_kept else settings


def read_report(out: Path) -> dict[str, Any] | None:
    """Read the ``run.json`` of a complete run; None if there is none, or another file of this name."""
    try:
        report = json.loads((out / RUN_REPORT).read_bytes())
        return report if report.keys() >= _SECTIONS else None
    except (FileNotFoundError, NotADirectoryError, ValueError, AttributeError):
        return None
    except OSError as error:
        raise SatIntervalsError(
            f"{out / RUN_REPORT} cannot be read: {error.strerror}: choose another folder"
        ) from error


def is_complete(out: Path) -> bool:
    """Return whether a folder has all files of a complete run."""
    report = read_report(out)
    names = OUTPUTS if report is None or "sweep" not in report else OUTPUTS_OF_SWEEP
    return report is not None and all((out / name).exists() for name in names)


def check_folder(out: Path, *, overwrite: bool, names: Sequence[str] = OUTPUTS) -> None:
    """Raise if a folder cannot be that of a run, or has files of its names that no run has made."""
    if is_there(out) and not out.is_dir():
        raise SatIntervalsError(f"{out} is not a folder: choose another")
    there = [name for name in names if is_there(out / name)]
    if folders := [name for name in there if (out / name).is_dir()]:
        raise SatIntervalsError(f"{out / folders[0]} is a folder: move it away or choose another folder")
    if overwrite or read_report(out) is not None:
        return
    is_begun = is_there(home_of(out) / MANIFEST)  # a death may have left rasters, but no report
    if foreign := [name for name in there if not is_begun or name == RUN_REPORT]:
        raise SatIntervalsError(
            f"{out / foreign[0]} exists and is of no complete run: move it away, choose another folder or "
            "--overwrite (overwrite=True)"
        )


def next_step(
    out: Path,
    manifest: Mapping[str, Any],
    run: str,
    settings: Mapping[str, Any],
    *,
    overwrite: bool,
    names: Sequence[str] = OUTPUTS,
) -> NextStep:
    """Return what to do in the folder of a run with this manifest, name and settings; raise if it must be refused."""
    report, home = read_report(out), home_of(out)
    if report is not None and report.get("run") == run and not overwrite:
        return "complete"
    try:
        there = read_manifest(home)
    except StoreError:
        if overwrite:
            return "start anew"
        raise
    changes = list(differences(there, plain(manifest))) if there else []
    if overwrite:
        return "start anew" if changes else "resume" if there else "start"
    if changes:
        kind = ChangedInputError if any(change.startswith("inputs.") for change in changes) else StoreError
        raise kind(
            f"{home} holds the tiles of another run: {'; '.join(changes)} "
            "(use the same settings and inputs to resume, or --overwrite, in Python overwrite=True, to start again)"
        )
    if report is not None:
        raise SatIntervalsError(
            f"{out} already holds {_other_run(report, manifest, settings)}: choose another folder or "
            "--overwrite (overwrite=True)"
        )
    check_folder(out, overwrite=False, names=names)
    return "resume" if there else "start"


def _other_run(report: Mapping[str, Any], manifest: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """Return in what the run of a report differs from the one that is wanted."""
    kept = {name: report["settings"].get(name) for name in settings}
    before = {"settings": kept, "inputs": report["inputs"], "region": report["tiles"].get("region")}
    now = {"settings": settings, "inputs": manifest["inputs"], "region": manifest["region"]}
    changes = list(differences(before, plain(now)))
    return f"another run: {'; '.join(changes)}" if changes else "a run of other local ranges or of another version"
