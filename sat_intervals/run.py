"""All tiles of a pair, all pairs of a batch, a bounded number of them in flight."""

import errno
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from distributed import Client, Future, KilledWorker
from distributed.client import ClosedClientError

from sat_intervals.cluster import Jobs, connected
from sat_intervals.conclude import Progress, conclude
from sat_intervals.config import Mccnn
from sat_intervals.errors import RunError
from sat_intervals.folders import folder_at
from sat_intervals.job import Job, compile_kernels, prepare
from sat_intervals.normalization import Scale, Scales, blocks, scale_of
from sat_intervals.raster import Image
from sat_intervals.tile import match_tile, measure_block, timed
from sat_intervals.tiling import Tile, Window

# Seconds after which the size of a cluster, which may grow and shrink, is asked for again.
_LOOK_AGAIN = 2.0
# Errors of a disk, or of a user's share of it.
_FULL = errno.ENOSPC, errno.EDQUOT
# Ends the key of a tile that is tried with no other in flight.
_ALONE = "-alone"


def match_pair(
    left: str | Path | Image,
    right: str | Path | Image,
    out: str | Path,
    config: Any,
    *,
    window: Window | None = None,
    keep_tiles: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Match two epipolar GeoTIFFs, files to files.

    Parameters
    ----------
    left, right
        Paths, or images opened by `open_image` with a band, a no-data value or a mask.
    out
        Folder for ``intervals.tif``, ``validity.tif`` and ``run.json``; tiles that are done are kept there, or in
        ``cluster.store``, until the run is complete, and an interrupted call goes on from them.
    config
        Settings, or what `load_config` makes them from; ``cluster`` says where tiles are matched.
    window
        Region of the left image; by default all of it.
    keep_tiles
        Whether the raw products of the tiles stay.
    overwrite
        Whether a run in ``out`` is replaced and tiles there are dropped.
    progress
        Called from time to time.

    Returns
    -------
    The content of ``run.json``.

    Raises
    ------
    SatIntervalsError
        Input, settings or output that cannot be used.
    RunError
        Tiles that failed; no output has its final name.
    """
    seconds: dict[str, float] = {}
    with timed(seconds, "start"):
        job = prepare(left, right, out, config, window=window, overwrite=overwrite)
    with held(job.store.home, progress), held(job.config.cluster.store, progress) as progress:
        job.begin(overwrite=overwrite)
        with timed(seconds, "kernels"):
            progress("kernels", 0, 1)
            compile_kernels(job.config)
            progress("kernels", 1, 1)
        with timed(seconds, "tiles"):
            if job.waiting:
                with connected(job.config.cluster, job.out) as client:
                    with timed(seconds, "tiles.images"):
                        measure_images(client, job, progress)
                    progress("tiles", len(job.store.grid) - job.waiting, len(job.store.grid))
                    for _, failures in matched(client, [job], progress):
                        check_failures(job, failures)
        report = conclude(job, seconds, progress)
        if not keep_tiles:
            job.store.remove()
    return report


def measure_images(client: Client, job: Job, progress: Progress) -> None:
    """Keep mean and standard deviation of both images in the store, where MC-CNN needs them and they are not there.

    Raises
    ------
    RunError
        An image that cannot be read.
    """
    if not isinstance(job.config.cost, Mccnn) or job.store.normalization() is not None:
        return
    job.store.write_normalization(
        Scales(*(_measured(client, image, job, progress) for image in (job.left, job.right))).report()
    )


def _measured(client: Client, image: Image, job: Job, progress: Progress) -> Scale:
    windows = blocks(image.height, image.width)
    with _scheduler_needed():
        futures = client.map(
            measure_block, [image] * len(windows), windows, pure=False, retries=job.config.cluster.retries
        )
    landing = _Landing(client)
    for future in futures:
        landing.expect(future)
    done = 0
    while done < len(windows):
        if (landed := landing.next()) is not None:
            error = _ended_with(landed)
            if error is not None:
                raise RunError(f"{image.path} could not be measured: {_reason(error)}") from error
            done += 1
        progress("images", done, len(windows))
    with _scheduler_needed():
        return scale_of(client.gather(futures))


@contextmanager
def held(place: str | Path | None, progress: Progress) -> Iterator[Progress]:
    """Keep every other run out of a folder or fsspec URL; the progress that it yields raises where that was in vain.

    Raises
    ------
    SatIntervalsError
        When another run is at work there, or the place cannot be used.
    """
    if place is None:
        yield progress
        return
    with folder_at(place).locked(lambda: progress("lease", 0, 1)) as check:

        def checked(stage: str, done: int, total: int) -> None:
            check()
            progress(stage, done, total)

        yield checked


def check_failures(job: Job, failures: dict[str, BaseException]) -> None:
    """Raise a RunError that names every tile that failed, if there are any."""
    if failures:
        lines = "\n".join(f"  tile {name}: {_reason(error)}" for name, error in sorted(failures.items()))
        raise RunError(
            f"{len(failures)} of {len(job.store.grid)} tiles failed, the others are kept; mend the cause and run the "
            f"same command again:\n{lines}"
        )


def _reason(error: BaseException) -> str:
    """Why a tile failed, in one line."""
    if isinstance(error, KilledWorker):
        return (
            f"every worker that matched it died, the last at {error.last_worker.address}, as they do out of memory: "
            "give workers more, or choose smaller tiles"
        )
    return " ".join(str(error).split()) or type(error).__name__


def matched(client: Client, jobs: Sequence[Job], progress: Progress) -> Iterator[tuple[Job, dict[str, BaseException]]]:
    """Match the tiles of jobs that are not done; yields each job as its last tile is through, with what failed.

    Tiles of several jobs are in flight at once, two a core and no more, so that the scheduler's memory does not grow
    with the number of tiles. Workers write what they make to the store; only their word comes back.
    """
    left = [job.waiting for job in jobs]
    failures: list[dict[str, BaseException]] = [{} for _ in jobs]
    total = sum(len(job.store.grid) for job in jobs)
    done = total - sum(left)
    yield from ((job, {}) for job, count in zip(jobs, left, strict=True) if count == 0)
    waiting = ((i, tile) for i, job in enumerate(jobs) for tile in _waiting(job))
    flight = _Flight(client, jobs, waiting)
    for landed in flight:
        if landed is None:
            progress("tiles", done, total)
            continue
        i, tile, error = landed
        if isinstance(error, OSError) and error.errno in _FULL:  # no other tile would fare better
            raise RunError(
                f"{error.filename or jobs[i].store.folder}: {error.strerror}: make room and run the same command "
                "again, it goes on from the tiles that are done"
            )
        if error is not None:
            failures[i][tile.name] = error
            jobs[i].store.write_failure(tile.name, _reason(error))
        left[i] -= 1
        done += 1
        progress("tiles", done, total)
        if left[i] == 0:
            yield jobs[i], failures[i]


def _waiting(job: Job) -> Iterator[Tile]:
    done = job.store.done()
    return (tile for tile in job.store.grid if tile.name not in done)


class _Landing:
    """Futures as they end."""

    def __init__(self, client: Client) -> None:
        self._ended: SimpleQueue[Future[Any]] = SimpleQueue()
        self._jobs = Jobs(client)

    def expect(self, future: Future[Any]) -> None:
        """Wait for one more, which whoever calls keeps alive."""
        future.add_done_callback(self._ended.put)

    def next(self) -> Future[Any] | None:
        """The next that ends; None where none does for a while, so that whoever waits can look around."""
        try:
            return self._ended.get(timeout=_LOOK_AGAIN)
        except Empty:
            self._jobs.check()
            return None


class _Flight:
    """Tiles on their way through a cluster; iterates over those that land: job number, tile, error or None.

    None in place of all where none lands for a while.

    dask blames a worker's death on every tile that it held. Those blamed too often are tried again at the end, one at a
    time, so that no tile fails for another.
    """

    def __init__(self, client: Client, jobs: Sequence[Job], waiting: Iterator[tuple[int, Tile]]) -> None:
        self._client, self._jobs, self._waiting = client, jobs, waiting
        self._landing = _Landing(client)
        self._tiles: dict[str, tuple[int, Tile, Future[None]]] = {}
        self._suspects: list[tuple[int, Tile]] = []
        self._width, self._looked = 2, float("-inf")

    def __iter__(self) -> Iterator[tuple[int, Tile, BaseException | None] | None]:
        self._fill()
        while self._tiles:
            future = self._landing.next()
            if future is None:
                self._fill()
                yield None
                continue
            error, key = _ended_with(future), str(future.key)
            i, tile, _ = self._tiles.pop(key)
            future.release()
            blamed = isinstance(error, KilledWorker) and not key.endswith(_ALONE)
            if blamed:
                self._suspects.append((i, tile))
            self._fill()
            if not self._tiles and self._suspects:
                self._submit(*self._suspects.pop(), _ALONE)
            if not blamed:
                yield i, tile, error

    def _fill(self) -> None:
        """Submit tiles until two are in flight for every core that there is now."""
        if time.monotonic() - self._looked > _LOOK_AGAIN:
            with _scheduler_needed():
                self._width = 2 * max(1, sum(self._client.nthreads().values()))
            self._looked = time.monotonic()
        while len(self._tiles) < self._width:
            following = next(self._waiting, None)
            if following is None:
                return
            self._submit(*following)

    def _submit(self, i: int, tile: Tile, suffix: str = "") -> None:
        job, key = self._jobs[i], f"match-{i}-{tile.name}{suffix}"
        with _scheduler_needed():
            future = self._client.submit(match_tile, job, tile, key=key, retries=job.config.cluster.retries, pure=False)
        self._tiles[key] = i, tile, future
        self._landing.expect(future)


def _ended_with(future: Future[None]) -> BaseException | None:
    """What a future ended with."""
    with _scheduler_needed():
        error: BaseException | None = future.exception()
        if future.cancelled():
            raise ClosedClientError(f"{future.key} is lost")
    return error


@contextmanager
def _scheduler_needed() -> Iterator[None]:
    try:
        yield
    except (OSError, ClosedClientError) as error:
        raise RunError("the dask scheduler is gone; the same command goes on from the tiles that are done") from error
