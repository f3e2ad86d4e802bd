"""Match a pair, files to files, with steps shared with batches: measure images, match tiles, repair damaged ones."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from sat_intervals.config import Config, ConfigError, Volume, load_config
from sat_intervals.errors import RunError
from sat_intervals.match.matching_cost import VolumeOf
from sat_intervals.match.schedule import Schedule
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.progress import Progress, add_seconds, logged_stage
from sat_intervals.raster import Image, path_of
from sat_intervals.results import open_run
from sat_intervals.run.assemble import assemble, end_tiles
from sat_intervals.run.beside import compiled_beside
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers
from sat_intervals.run.job import Job, open_job
from sat_intervals.run.tile import match_or_trace
from sat_intervals.run.workers import Task, Workers, check_not_full, reason
from sat_intervals.store.lock import locked
from sat_intervals.store.tiles import BORDERS, COSTS, FAILURES, PIXELS, DamagedTilesError
from sat_intervals.tiling import Tile, Window

_TRIES = 2  # matches of damaged tiles; more damage means a broken disk

_LOG = logging.getLogger(__name__)


def match_pair(
    left: str | Path | Image,
    right: str | Path | Image,
    out: str | Path,
    config: Any = None,
    *,
    window: Window | None = None,
    keep_tiles: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
    volume_of: VolumeOf | None = None,
) -> dict[str, Any]:
    """Match two epipolar GeoTIFFs, files to files.

    Parameters
    ----------
    left, right
        Paths, or images opened by `open_image` with a band, a no-data value or a mask.
    out
        Folder for ``intervals.tif``, ``validity.tif`` and ``run.json``, which may be in a bucket: ``s3://bucket/run``.
        Finished tiles are kept there, or in ``cluster.store``, until the run is complete; after an interruption the
        same call resumes from them.
    config
        Settings, or a source for `load_config`, by default those of satellite images; ``cluster`` says where tiles are
        matched. A search range that is auto is found from the whole images first, see `search_range`.
    window
        Region of the left image; by default all of it.
    keep_tiles
        Whether to keep the raw products of the tiles.
    overwrite
        Whether another run in ``out`` may be replaced; its tiles are deleted, equal ones are used again.
    progress
        Called regularly with stage, done and total.
    volume_of
        Makes the cost volumes of a matcher of one's own, tile by tile, with ``cost`` ``{method: volume, kind: cost,
        span: 24, margin: 3}`` in the settings, see `intervals_of`. Called as ``volume_of(left, right, first)`` with
        masked float arrays: the pixels of a tile with ``margin`` on all sides, those of the right image that face them,
        ``disparities - 1`` more columns, and the first disparity. Returns ``(rows, columns, disparities)`` without the
        margin, not finite where impossible: candidate k of pixel ``(r, c)``, at ``left[r + margin, c + margin]``, is
        ``right[r + margin, c + k + margin]``. Where workers are processes it must be picklable; its module and name,
        not its code, identify the run. With ``sgm`` tiles join without seams; without it volumes are taken as they are.

    Returns
    -------
    The content of ``run.json``.

    Raises
    ------
    SatIntervalsError
        Inputs, settings or output cannot be used.
    RunError
        Tiles failed; no output was published.
    """
    config, out = _named(load_config(config), volume_of), path_of(out)
    with compiled_beside(config), Connection(config.cluster, out) as connection:
        each, how = EachOnWorkers(connection, progress), {"overwrite": overwrite, "keep_tiles": keep_tiles}
        return matched_on(each, (left, right), out, config, window=window, volume_of=volume_of, **how)


def matched_on(
    each: EachOnWorkers,
    images: tuple[str | Path | Image, str | Path | Image],
    out: Path,
    config: Config,
    *,
    window: Window | None = None,
    keep_tiles: bool = False,
    overwrite: bool = False,
    volume_of: VolumeOf | None = None,
) -> dict[str, Any]:
    """Match two epipolar GeoTIFFs on workers, see `match_pair`."""
    seconds, progress = dict[str, float](), each.progress
    with logged_stage(seconds, "start"):
        job = open_job(*images, out, config, window=window, overwrite=overwrite, each=each)
        job = replace(job, volume_of=volume_of)
    with locked(out):
        if not job.begin():
            report = complete_before(job)
        else:
            with logged_stage(seconds, "kernels"):
                progress("kernels", 0, 1)
                compile_for(job)
                progress("kernels", 1, 1)
            report = match_and_assemble(job, each.workers, seconds, progress)
        end_tiles(job, keep_tiles=keep_tiles)
        return report


def _named(config: Config, volume_of: VolumeOf | None) -> Config:
    """Return settings with the name of the function that makes volumes; raise if they ask for another cost."""
    if volume_of is None:
        return config
    if not isinstance(config.cost, Volume):
        raise ConfigError(f"volume_of is given, but cost.method is {config.cost.method}: give cost.method volume")
    if not callable(volume_of):
        raise ConfigError(f"volume_of is {volume_of!r}: give the function that makes the volume of a tile")
    named = getattr(volume_of, "__qualname__", "<")  # neither an object nor what it holds has a name
    name = config.cost.name or f"{volume_of.__module__}.{named}"
    if "<" in name:
        raise ConfigError(
            f"volume_of is {volume_of!r}: name it and its version in cost.name, by which a run knows what to resume"
        )
    return config.model_copy(update={"cost": config.cost.model_copy(update={"name": name})})


def compile_for(job: Job) -> None:
    """Compile or load the kernels of a run, before its tiles; those of a sweep were needed before."""
    if job.swept is None:
        compile_kernels(job.config, hands_states_on=job.hands_states_on)


def complete_before(job: Job) -> dict[str, Any]:
    """Return the report of a run that was already complete."""
    report = open_run(job.out).report
    _LOG.warning("the run in %s was already complete", job.out)
    return report


def match_and_assemble(job: Job, workers: Workers, seconds: dict[str, float], progress: Progress) -> dict[str, Any]:
    """Match the tiles of a run that are not done, and write its files, see `assemble`; damaged tiles are made again."""
    for attempt in range(_TRIES + 1):
        try:
            with logged_stage(seconds, "tiles"):
                for matched in match_jobs(workers, [job], progress) if job.waiting() else ():
                    check_failures(job, matched.failures)
                    add_seconds(seconds, matched.seconds)
            return assemble(job, workers, seconds, progress)
        except DamagedTilesError as error:
            if attempt == _TRIES:
                raise
            _LOG.warning("%s; trying this now", error)
        except OSError as error:
            raise RunError(f"{reason(error)}: rerun the same command: it resumes") from error
    raise AssertionError  # not reached


def check_failures(job: Job, failures: dict[str, BaseException]) -> None:
    """Raise if tiles failed, with their names and reasons."""
    if failures:
        lines = "\n".join(f"  tile {name}: {reason(error)}" for name, error in sorted(failures.items()))
        waiting = " or wait for their path states" if job.hands_states_on else ""
        raise RunError(
            f"{len(failures)} of {len(job.store.grid)} tiles failed, the others are kept{waiting}; fix the cause and "
            f"rerun the same command: it resumes; add --overwrite (overwrite=True) if an input changed:\n{lines}"
        ) from min(failures.items())[1]


class Matched(NamedTuple):
    """A job whose last tile has ended, its failures by tile, and seconds by stage, those of its tiles apart."""

    job: Job
    failures: dict[str, BaseException]
    seconds: dict[str, float]


def match_jobs(workers: Workers, jobs: Sequence[Job], progress: Progress) -> Iterator[Matched]:
    """Match the unfinished tiles of jobs, a bounded number at a time; yield each job after its last tile."""
    waiting = [job.waiting() for job in jobs]
    schedules = [_schedule(job, tiles) for job, tiles in zip(jobs, waiting, strict=True)]
    matched = [Matched(job, {}, {}) for job in jobs]
    total = sum(len(job.store.grid) for job in jobs) - sum(map(len, waiting)) + sum(map(len, schedules))
    yield from (ended for ended, schedule in zip(matched, schedules, strict=True) if not schedule)
    done = total - sum(map(len, schedules))
    progress("tiles", done, total)
    for outcome in workers.outcomes(_tasks(jobs, schedules)):
        if outcome is None:
            progress("tiles", done, total)
            continue
        (i, step), seconds, error = outcome
        if error is not None:
            check_not_full(error, jobs[i].store.folder)
        if error is None:
            schedules[i].ended(step)
            add_seconds(matched[i].seconds, seconds or {})  # of tracing; a tile keeps its own in its record
        elif schedules[i].failed(step):
            if step.wavefront is not None:
                error = RunError(f"tracing its path states, wavefront {step.wavefront}: {reason(error)}")
            for tile in jobs[i].store.grid.within(step.block.core):
                matched[i].failures.setdefault(tile.name, error)
                _note_failure(jobs[i], tile, error)
        _LOG.debug("%s: tile %s %s", jobs[i].out, step.name, f"failed: {reason(error)}" if error else "done")
        done = total - sum(map(len, schedules))
        progress("tiles", done, total)
        if not schedules[i]:
            if not matched[i].failures:  # nothing needs them any more
                jobs[i].store.remove([PIXELS, COSTS])
            yield matched[i]
    assert not any(schedules)  # else steps would wait for each other


def _note_failure(job: Job, tile: Tile, error: BaseException) -> None:
    """Note why a tile failed, where a full disk must not end the run, but a server that is away must."""
    try:
        job.store.write(FAILURES, tile.name, reason=reason(error))
    except OSError as failed:
        if not job.store.folder.is_local:
            raise RunError(f"{reason(failed)}: rerun the same command: it resumes") from failed


def _schedule(job: Job, tiles: Sequence[Tile]) -> Schedule:
    store, blocks = job.store, job.blocks
    there = store.names(BORDERS) if tiles and job.hands_states_on else set[str]()
    is_done = (lambda name: name in there and store.is_intact(BORDERS, name)) if job.hands_states_on else None
    together = blocks.size // store.grid.size
    places = {(tile.grid_row // together, tile.grid_column // together) for tile in tiles}
    return Schedule(blocks, [blocks.tile(*place) for place in sorted(places)], is_done, together)


def _tasks(jobs: Sequence[Job], schedules: Sequence[Schedule]) -> Iterator[Task | None]:
    """Tasks of all jobs as they become ready, those of the first jobs first; None while none is."""
    while any(schedules):
        ready = ((i, step) for i, schedule in enumerate(schedules) if (step := schedule.next()))
        i, step = next(ready, (0, None))
        if step is None:
            yield None
        else:
            yield Task((i, step), match_or_trace, (jobs[i], *step), jobs[i].config.cluster.retries)
