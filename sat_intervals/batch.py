"""Many pairs in one go: one cluster for all, tiles of several pairs in flight, a folder for each."""

import csv
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from sat_intervals.cluster import connected
from sat_intervals.conclude import Progress, conclude
from sat_intervals.config import Cluster, Config, load_config
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.job import OUTPUTS, Job, compile_kernels, prepare
from sat_intervals.raster import open_image
from sat_intervals.run import check_failures, held, matched, measure_images

_IMAGES = ("left", "right", "left_mask", "right_mask")
# Completes settings whose search range the pairs bring.
_ANY_RANGE = {"disparity": {"minimum": 0, "maximum": 0}}


@dataclass(frozen=True)
class PairOfBatch:
    """One row of a batch: a name, its images, and the settings that are its own, as nested sections."""

    name: str
    left: str
    right: str
    left_mask: str | None = None
    right_mask: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)


def read_batch(file: Path) -> list[PairOfBatch]:
    """Pairs of a CSV, YAML or JSON file.

    A row has ``name``, ``left`` and ``right``; ``minimum`` and ``maximum``, the search range; ``left_mask`` and
    ``right_mask``; and any setting under its dotted name, such as ``sgm.p2``. YAML and JSON hold a list of such rows,
    in which a setting may also be a section. Paths are relative to the file.

    Raises
    ------
    SatIntervalsError
        With file, row and what is wrong there.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
        rows = list(csv.DictReader(text.splitlines())) if file.suffix == ".csv" else yaml.safe_load(text)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, csv.Error) as error:
        raise SatIntervalsError(f"{file} cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(rows, list) or not rows or not all(isinstance(row, Mapping) for row in rows):
        raise SatIntervalsError(f"{file} holds no pairs: needed is a row a pair, with name, left and right")
    pairs = [_pair(row, file, number) for number, row in enumerate(rows, start=1)]
    for name, count in Counter(pair.name for pair in pairs).items():
        if count > 1:
            raise SatIntervalsError(f"{file}: {count} pairs are called {name}: give each its own name")
    return pairs


def _pair(row: Mapping[str, Any], file: Path, number: int) -> PairOfBatch:
    values = {key: value for key, value in row.items() if value not in ("", None)}
    missing = [key for key in ("name", "left", "right") if key not in values]
    name = str(values.pop("name", ""))
    if missing or None in row:
        what = f"lacks {' and '.join(missing)}" if missing else f"has more values than columns: {row[None]}"  # type: ignore[index]
        raise SatIntervalsError(f"{file}, row {number} {what}")
    if name in (".", "..") or os.sep in name:
        raise SatIntervalsError(f"{file}, row {number}: name {name!r} is no name of a folder")
    images = {key: _path(str(values.pop(key)), file) for key in _IMAGES if key in values}
    settings: dict[str, Any] = {}
    for key, value in values.items():
        path = f"disparity.{key}" if key in ("minimum", "maximum") else str(key)
        *sections, last = path.split(".")
        target = settings
        for section in sections:
            target = target.setdefault(section, {})
        target[last] = yaml.safe_load(value) if isinstance(value, str) else value
    return PairOfBatch(name, settings=settings, **images)


def _path(path: str, file: Path) -> str:
    return path if "://" in path or path.startswith("/vsi") else str(file.parent / path)


def match_batch(
    pairs: Sequence[PairOfBatch],
    out: Path,
    config: Mapping[str, Any] | Path | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    keep_tiles: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, dict[str, Any]]:
    """Match many pairs; one that fails does not stop the others.

    Parameters
    ----------
    pairs
        See `read_batch`.
    out
        Each pair has the folder of its name here; ``batch.json`` says how each ended.
    config, overrides
        Settings of all pairs, as of `load_config`; a pair's own win over them. ``cluster`` is that of the batch.
    overwrite, keep_tiles, progress
        As of `match_pair`.

    Returns
    -------
    By name: ``state`` ("done", "done before", "failed"), and ``error`` or ``counts`` and ``seconds``.
    """
    ended: dict[str, dict[str, Any]] = {}
    jobs: list[Job] = []
    names: dict[int, str] = {}
    out.mkdir(parents=True, exist_ok=True)
    cluster = load_config(config, {**(overrides or {}), **_ANY_RANGE}).cluster
    with ExitStack() as stack:
        progress = stack.enter_context(held(cluster.store, progress))
        for pair in pairs:
            try:
                settings = _settings(pair, config, overrides, cluster)
                job = _begun(pair, out, settings, overwrite, stack)
            except (SatIntervalsError, OSError) as error:
                ended[pair.name] = {"state": "failed", "error": str(error)}
                continue
            if job is None:
                ended[pair.name] = {"state": "done before"}
            else:
                names[id(job)] = pair.name
                jobs.append(job)
        for name, end in _matched(jobs, names, out, cluster, keep_tiles, progress):
            ended[name] = end
    report = {pair.name: ended[pair.name] for pair in pairs}
    (out / "batch.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return report


def _settings(pair: PairOfBatch, config: Any, overrides: Mapping[str, Any] | None, cluster: Cluster) -> Config:
    """The settings of a pair, its tiles in a folder of its name where those of the batch lie elsewhere."""
    settings = load_config(config, {**(overrides or {}), **_merged(overrides or {}, pair.settings)})
    store = cluster.store and f"{cluster.store.rstrip('/')}/{pair.name}"
    return settings.model_copy(update={"cluster": settings.cluster.model_copy(update={"store": store})})


def _begun(pair: PairOfBatch, out: Path, settings: Config, overwrite: bool, stack: ExitStack) -> Job | None:
    """The job of a pair, its store open and locked; None where the pair was matched before with the same settings."""
    folder = out / pair.name
    if not overwrite and all((folder / name).exists() for name in OUTPUTS):
        before = json.loads((folder / "run.json").read_text())["settings"]
        if load_config(before).model_copy(update={"cluster": settings.cluster}) == settings:
            return None
    left, right = open_image(pair.left, mask=pair.left_mask), open_image(pair.right, mask=pair.right_mask)
    job = prepare(left, right, folder, settings, overwrite=overwrite)
    stack.enter_context(held(job.store.home, lambda stage, done, total: None))
    job.begin(overwrite=overwrite)
    return job


def _merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Sections of both, the second winning key by key."""
    return {
        name: {**first[name], **section} if name in first and isinstance(section, Mapping) else section
        for name, section in second.items()
    }


def _matched(
    jobs: list[Job], names: dict[int, str], out: Path, cluster: Cluster, keep_tiles: bool, progress: Progress
) -> list[tuple[str, Any]]:
    """Match the tiles of all jobs and conclude each, in a thread of its own, while others are being matched."""
    if not jobs:
        return []
    for config in {_kernels(job.config): job.config for job in jobs}.values():
        compile_kernels(config)
    waiting: list[tuple[Job, Future[dict[str, Any]]]] = []
    ended: list[tuple[str, Any]] = []
    with ThreadPoolExecutor(1) as thread, connected(cluster, out) as client:
        measured = []
        for job in jobs:
            try:
                measure_images(client, job, progress)
                measured.append(job)
            except RunError as error:
                ended.append((names[id(job)], {"state": "failed", "error": str(error)}))
        for job, failures in matched(client, measured, progress):
            waiting.append((job, thread.submit(_concluded, job, failures, keep_tiles)))
    return ended + [(names[id(job)], future.result()) for job, future in waiting]


def _kernels(config: Config) -> str:
    """What distinguishes the kernels that a configuration needs."""
    return config.model_dump_json(include={"cost": True, "sgm": {"penalty"}, "cross_check": {"method"}})


def _concluded(job: Job, failures: dict[str, BaseException], keep_tiles: bool) -> dict[str, Any]:
    try:
        check_failures(job, failures)
        report = conclude(job, {}, lambda stage, done, total: None)
    except (SatIntervalsError, RuntimeError, OSError) as error:
        return {"state": "failed", "error": str(error)}
    if not keep_tiles:
        job.store.remove()
    return {"state": "done", "counts": report["counts"], "seconds": report["seconds"]}
