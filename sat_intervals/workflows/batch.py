"""Match many pairs on one cluster, with tiles of several pairs in flight, and make surface models of pairs or more."""

import logging
import resource
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from sat_intervals.config import Config, load_config, load_height_calibration, named_files, read_yaml, resolved
from sat_intervals.config.batch import REPORT, PairOfBatch
from sat_intervals.config.presets import merged
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.heights.choices import SurfaceChoices
from sat_intervals.heights.dsm import check_sensors
from sat_intervals.heights.rectify import raw_inputs
from sat_intervals.progress import Progress
from sat_intervals.raster import Image, OutputError, files_of, open_image
from sat_intervals.raster.identity import check_not_replaced
from sat_intervals.raster.publishing import write_record
from sat_intervals.results import open_run
from sat_intervals.run.assemble import end_tiles
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers, pool_of
from sat_intervals.run.job import Job, open_job
from sat_intervals.run.pair import Matched, check_failures, compile_for, complete_before, match_and_assemble, match_jobs
from sat_intervals.run.state import OUTPUTS
from sat_intervals.run.status import read_report
from sat_intervals.run.workers import Workers
from sat_intervals.store.lock import locked
from sat_intervals.tiling import Window
from sat_intervals.workflows.many import FIGURES, Wanted, asked_of, complete_sweep, sweep_job, write_ortho
from sat_intervals.workflows.surface import FILES, Rectified, check_cells, epipolar_pair, has_grids, surface_of

_LOG = logging.getLogger(__name__)
_KEPT = "finished", "counts", "seconds", "warnings"  # of a run's report, in `batch.json`


def match_batch(
    pairs: Sequence[PairOfBatch],
    out: Path,
    config: Mapping[str, Any] | Path | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    keep_tiles: bool = False,
    progress: Progress = lambda stage, done, total: None,
    on_rectified: Rectified = lambda record: None,
) -> dict[str, dict[str, Any]]:
    """Match many pairs on one cluster; a failed pair does not stop the others.

    Each pair has a folder in ``out``. ``config`` and ``overrides`` are for all pairs; a pair's own settings win. One
    with a resolution also gets a surface model, its raw images are rectified as by `surface`; of more images the
    surface is made as by `surface`. Returns, as ``batch.json`` has it, by name: ``state`` ("waiting", "done", "done
    before", "failed"), and ``error`` or ``finished``, ``counts``, ``seconds``, ``warnings`` and ``surface``, what
    `make_surface` returns, of more images grid, heights and shifts.
    """
    file = Path(config) if isinstance(config, (str, Path)) else None
    sections = read_yaml(Path(config)) if isinstance(config, (str, Path)) else config  # once for all pairs
    common = load_config(sections, overrides, file=file)
    _check_not_replaced(pairs, [file, *named_files(sections), *named_files(overrides)], out)
    surfaces = _Surfaces(pairs, out, on_rectified, overwrite=overwrite)
    _raise_file_limit()
    with locked(out), ExitStack() as stack:
        report = _Report(out, pairs)
        with Connection(common.cluster, out) as connection:
            each, pool = EachOnWorkers(connection, progress), pool_of(connection, out, progress)
            jobs: list[Job] = []
            for number, pair in enumerate(pairs):
                progress("pairs", number, len(pairs))
                try:
                    own, count = merged(overrides or {}, pair.settings), len(pair.images)
                    settings = load_config(sections, own, preset_wins=True, file=file, images=count)
                    if (job := surfaces.job(pair, settings, each, pool, keep_tiles=keep_tiles)) is None:
                        report.note({pair.name: _ended("done before", open_run(out / pair.name).report)})
                        continue
                    stack.enter_context(locked(job.out))
                    if job.begin():
                        jobs.append(job)
                    else:
                        report.note({pair.name: _done_before(job, keep_tiles=keep_tiles)})
                except Exception as error:  # one pair's failure must not stop the others
                    report.note({pair.name: _failed(error)})
            progress("pairs", len(pairs), len(pairs))
            for name, state in _matched(jobs, connection, progress, keep_tiles=keep_tiles):
                report.note({name: state})
            for pair in pairs:
                state = report.states[pair.name]
                if pair.resolution and state["state"] != "failed":
                    report.note({pair.name: state | surfaces.made(pair, pool)})
    return report.states


class _Report:
    """The states of the pairs, here and in ``batch.json``; one that is not of a batch is refused."""

    def __init__(self, folder: Path, pairs: Sequence[PairOfBatch]) -> None:
        self.states: dict[str, dict[str, Any]] = {}
        self._file = folder / REPORT
        read_report(folder)
        self.note({pair.name: {"state": "waiting"} for pair in pairs})

    def note(self, states: Mapping[str, dict[str, Any]]) -> None:
        """Add states and write the file."""
        for name, how in states.items():
            _LOG.info("pair %s: %s", name, how.get("error", how["state"]))
        self.states.update(states)
        try:
            write_record(self._file, self.states)
        except OutputError as error:
            raise RunError(f"{error}, and rerun the batch: it resumes") from error


def _check_not_replaced(pairs: Sequence[PairOfBatch], others: Sequence[str | Path | None], out: Path) -> None:
    """Raise if an input of any pair, or another file that is read, is an output of any pair."""
    folders = [out / pair.name for pair in pairs]
    images = [name for pair in pairs for name in (*pair.images, pair.left_mask, pair.right_mask)]
    options = "geoid", "dem", "height_calibration", "flatten", "mask"
    files = [pair.options.get(option) for pair in pairs for option in options]
    named = [name for pair in pairs for name in (*(pair.sensors or ()), *named_files(pair.settings))]
    names = {str(name) for name in (*others, *images, *named, *files) if name}
    read = [file for name in names for file in _files(name)]
    surfaces = [out / pair.name / name for pair in pairs if pair.resolution for name in FILES]
    outputs = [out / REPORT, *(folder / name for folder in folders for name in OUTPUTS), *surfaces]
    check_not_replaced(read, outputs, [folder / "tiles" for folder in folders])


def _files(name: str) -> list[str]:
    """Return a file and, of a raster, all others that it is read from."""
    with suppress(OSError, SatIntervalsError):  # no raster, or its pair will fail
        return files_of(name)
    return [name]


class _Surfaces:
    """The surface models of the pairs with a resolution."""

    def __init__(self, pairs: Sequence[PairOfBatch], out: Path, on_rectified: Rectified, *, overwrite: bool) -> None:
        """Read models and grids, before hours of matching; those that cannot be used fail their pair at its end."""
        self._out, self._on_rectified, self._overwrite = out, on_rectified, overwrite
        self._sensors: dict[str, Sequence[Path]] = {}
        self._errors: dict[str, SatIntervalsError] = {}
        self._orthos: dict[str, Job] = {}
        of_surfaces = [pair for pair in pairs if pair.resolution]
        if of_surfaces:
            import sat_intervals.heights.sensors  # noqa: F401 (without its extra it raises, for all pairs)
        for pair in (one for one in of_surfaces if not one.more):
            try:
                cells = _cells(pair)
                check_cells(None, **cells | {"choices": replace(cells["choices"], calibration=None)})
                if has_grids(pair.sensors):
                    check_sensors(pair.sensors or (), cells["resolution"], cells["crs"], cells["choices"])
            except SatIntervalsError as error:
                self._errors[pair.name] = error
                _LOG.warning("%s: there will be no surface: %s", pair.name, error)

    def job(
        self, pair: PairOfBatch, settings: Config, each: EachOnWorkers, pool: EachOnWorkers, *, keep_tiles: bool
    ) -> Job | None:
        """Return what is to be matched of a row, rectified by a pool; None of more images whose surface is there."""
        out, cells, (left, right, *more) = self._out / pair.name, _cells(pair), _opened(pair)
        how: dict[str, Any] = {"overwrite": self._overwrite, "pair": pair.name}
        if more:
            asked = asked_of([left, right, *more], out, settings, Wanted(**cells), overwrite=self._overwrite)
            if not self._overwrite and complete_sweep(asked, out, keep_tiles=keep_tiles):
                return None
            job = sweep_job(asked, out, each, **how)
            if asked.wanted.choices.ortho:
                self._orthos[pair.name] = job
            return job
        window = Window(*pair.window) if pair.window else None
        if cells["choices"].calibration:
            check_cells(resolved(settings).interval, **cells)
        if pair.resolution:
            raw = _given(pair, "dem", "altitude", "resolution_of") | {"overwrite": self._overwrite}
            raw["geoid"] = cells["geoid"] if raw["dem"] else None
            made = epipolar_pair((left, right), out, pool, pair.sensors or (), window, self._on_rectified, **raw)
            left, right = made.left, made.right
            if cells["choices"].ortho:
                raw_inputs(left.path, right.path)
            if not has_grids(pair.sensors):
                check_sensors(made.sensors, pair.resolution, cells["crs"], cells["choices"])
            self._sensors[pair.name] = made.sensors
        return open_job(left, right, out, settings, window=window, each=each, **how)

    def made(self, pair: PairOfBatch, pool: EachOnWorkers) -> dict[str, Any]:
        """Make the surface of a matched pair, or the ortho-image of more; return what it adds to the pair's state."""
        try:
            if pair.name in self._errors:
                raise self._errors[pair.name]
            if pair.name in self._sensors:
                made = surface_of(self._out / pair.name, self._sensors[pair.name], pool, **_cells(pair))
                return {"surface": made}
            if pair.name in self._orthos:
                write_ortho(self._orthos[pair.name], pool.progress)
            return {}
        except Exception as error:  # one pair's failure must not stop the others
            return _failed(error)


def _given(pair: PairOfBatch, *options: str) -> dict[str, Any]:
    return {name: pair.options.get(name) for name in options}


def _cells(pair: PairOfBatch) -> dict[str, Any]:
    """Return arguments of `surface_of`, of more images the fields of `Wanted`."""
    file = pair.options.get("height_calibration")
    margins = load_height_calibration(file) if file else None
    ortho = pair.options.get("ortho", False)
    choices = SurfaceChoices(calibration=margins, ortho=ortho, **_given(pair, "fill", "flatten", "mask"))
    given = _given(pair, "crs", "geoid", *(("extent", "heights") if pair.more else ("radius",)))
    return given | {"resolution": pair.resolution, "choices": choices}


def _opened(pair: PairOfBatch) -> list[Image]:
    reading, sides = pair.reading, [("left_", pair.left_mask), ("right_", pair.right_mask)]

    def opened(path: str, side: str, mask: str | None) -> Image:
        options: dict[str, Any] = {one: reading.get(f"{side}{one}", reading.get(one)) for one in ("band", "nodata")}
        return open_image(path, **options, mask=mask)

    return [opened(path, *side) for path, side in zip(pair.images, sides + [("", None)] * len(pair.more), strict=True)]


def _done_before(job: Job, *, keep_tiles: bool) -> dict[str, Any]:
    before = complete_before(job)
    end_tiles(job, keep_tiles=keep_tiles)
    return _ended("done before", before)


def _ended(state: str, report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state of a finished run, of a sweep with figures of its surface."""
    ended = {"state": state} | {name: report[name] for name in _KEPT}
    if swept := report.get("sweep"):
        counts, width = report["counts"], report["counts"]["median_interval_width"]
        half = None if width is None else width * swept["step"] / 2
        figures = {"filled": counts["valid"] / counts["pixels"], "median_half_width": half}
        ended["surface"] = {name: swept[name] for name in FIGURES} | figures
    return ended


def _failed(error: Exception) -> dict[str, Any]:
    return {"state": "failed", "error": str(error) or type(error).__name__}


def _raise_file_limit() -> None:
    """Raise the limit of open files to the maximum: every pair has a lock file."""
    least, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if least != most:
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def _matched(
    jobs: Sequence[Job], workers: Workers, progress: Progress, *, keep_tiles: bool
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Match the tiles of all jobs; assemble finished jobs in a thread meanwhile."""
    if not jobs:
        return
    for job in jobs:
        compile_for(job)
    assembling: dict[Future[dict[str, Any]], str] = {}
    with _thread() as (thread, check):
        assembled = partial(_assembled, workers, check, keep_tiles=keep_tiles)
        for matched in match_jobs(workers, jobs, progress):
            assembling[thread.submit(assembled, matched)] = matched.job.out.name
            for future in [future for future in assembling if future.done()]:
                yield assembling.pop(future), future.result()
        total = len(assembling)
        while assembling:
            progress("pairs.files", total - len(assembling), total)
            for future in wait(assembling, timeout=0.5, return_when="FIRST_COMPLETED").done:
                yield assembling.pop(future), future.result()


@contextmanager
def _thread() -> Iterator[tuple[ThreadPoolExecutor, Progress]]:
    """Yield a thread, and a progress callback that stops its work if the block raises."""
    is_stopped = threading.Event()

    def check(stage: str, done: int, total: int) -> None:
        if is_stopped.is_set():
            raise RunError("the batch was stopped")

    with ThreadPoolExecutor(1) as thread:
        try:
            yield thread, check
        except BaseException:
            is_stopped.set()
            thread.shutdown(wait=False, cancel_futures=True)
            raise


def _assembled(workers: Workers, progress: Progress, matched: Matched, *, keep_tiles: bool) -> dict[str, Any]:
    job, failures, seconds = matched
    try:
        check_failures(job, failures)
        report = match_and_assemble(job, workers, seconds, progress)
        end_tiles(job, keep_tiles=keep_tiles)
    except Exception as error:  # one pair's failure must not stop the others
        return _failed(error)
    return _ended("done", report)
