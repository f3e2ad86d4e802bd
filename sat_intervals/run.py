"""All tiles of a pair, on this machine's cores, then the final bands. The only home of dask."""

import json
import logging
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from distributed import Client, LocalCluster, as_completed

from sat_intervals.config import Config, load_config
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.finish import Rows, Scale, confidence_scale, finish_strips
from sat_intervals.inputs import identity
from sat_intervals.kernels.confidence import ambiguity_histogram
from sat_intervals.patch import Patch, match_patch
from sat_intervals.products import FLAGS, NO_DISPARITY
from sat_intervals.raster import Image, OutputWriter, check_pair, check_space, open_image, read_window
from sat_intervals.seams import seam_lines, seam_report
from sat_intervals.store import Store
from sat_intervals.summary import Tally
from sat_intervals.tiling import Grid, Tile, Window

Item = TypeVar("Item")

STRIP_ROWS = 256
OUTPUTS = ("intervals.tif", "validity.tif", "run.json")

Progress = Callable[[str, int, int], None]
"""Called with a stage ("kernels", "tiles", "bands", "files"), how much of it is done, and how much there is."""


@dataclass(frozen=True)
class Job:
    """What a worker needs to know to match any tile of a pair."""

    left: Image
    right: Image
    config: Config
    store: Store


def match_pair(
    left: str | Path | Image,
    right: str | Path | Image,
    out: str | Path,
    config: Any,
    *,
    window: Window | None = None,
    workers: int | None = None,
    processes: bool = False,
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
        Folder for ``intervals.tif``, ``validity.tif`` and ``run.json``; tiles that are done are kept there until the
        run is complete, and an interrupted call goes on from them.
    config
        Settings, or what `load_config` makes them from.
    window
        Region of the left image; by default all of it.
    workers
        Tiles in work at once; by default one a core.
    processes
        Whether workers are processes instead of threads (the kernels release the GIL).
    keep_tiles
        Whether the raw products of the tiles stay in ``out``.
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
    started = time.perf_counter()
    config = load_config(config)
    left, right = _opened(left), _opened(right)
    check_pair(left, right, config.disparity.minimum, config.disparity.maximum)
    region = _region(left, window)
    out = Path(out)
    check_output(out, overwrite)
    check_space(out, region.height, region.width)
    grid = Grid(region, config.tiles.size)
    store = Store(out / "tiles", grid, config.disparity.count, config.largest_ambiguity)
    inputs = {"left": _described(left), "right": _described(right)}
    if overwrite:
        store.remove()
    store.open(_manifest(config, inputs, region))
    seconds = {"start": time.perf_counter() - started}
    with _timed(seconds, "kernels"):
        progress("kernels", 0, 1)
        compile_kernels(config)
        progress("kernels", 1, 1)
    job = Job(left, right, config, store)
    with _timed(seconds, "tiles"):
        _match_tiles(job, workers or _cores(), processes, progress)
    report = _finish(job, out, inputs, seconds, progress)
    if not keep_tiles:
        store.remove()
    return report


def _opened(image: str | Path | Image) -> Image:
    return image if isinstance(image, Image) else open_image(image)


def _region(left: Image, window: Window | None) -> Window:
    whole = Window(0, 0, left.height, left.width)
    if window is None:
        return whole
    if window.height < 1 or window.width < 1 or window.clipped(whole) != window:
        raise SatIntervalsError(
            f"window at row {window.row}, column {window.column}, {window.height} x {window.width} pixels: "
            f"must lie inside {left.path}, {left.height} x {left.width} pixels"
        )
    return window


def check_output(out: Path, overwrite: bool) -> None:
    """Make the folder of a run, or tell why it cannot be used."""
    there = [name for name in OUTPUTS if (out / name).exists()]
    if there and not overwrite:
        raise SatIntervalsError(f"{out} already holds a run ({', '.join(there)}): choose another folder or --overwrite")
    try:
        out.mkdir(parents=True, exist_ok=True)
        os.utime(out)
    except OSError as error:
        raise SatIntervalsError(f"{out} cannot be written: {error.strerror}") from error


def _manifest(config: Config, inputs: dict[str, Any], region: Window) -> dict[str, Any]:
    """All that decides the bytes of a tile."""
    return {
        "version": version("sat-intervals"),
        "settings": config.model_dump(mode="json"),
        "inputs": inputs,
        "region": region.__dict__,
    }


def compile_kernels(config: Config) -> None:
    """Match a few random pixels, so that every kernel is compiled, or read from numba's cache, once and first."""
    random = np.random.default_rng(0)

    def read(window: Window) -> tuple[np.ndarray, np.ndarray]:
        pixels = random.random((window.height, window.width), np.float32)
        return pixels, np.zeros(pixels.shape, np.uint8)

    spot = Window(0, 0, 4, 4)
    patch = match_patch(read, read, spot, spot, spot, config)
    raw = patch.raw
    rows = Rows(raw.winner, raw.lower, raw.upper, raw.disparity, raw.ambiguity, raw.validity, patch.right.winner)
    list(finish_strips([rows], Scale(0.0, 1.0), config))


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - started


def _match_tiles(job: Job, workers: int, processes: bool, progress: Progress) -> None:
    """Match the tiles that are not done, a bounded number of them in flight."""
    total = len(job.store.grid)
    waiting = (tile for tile in job.store.grid if not job.store.is_done(tile))
    done = total - sum(not job.store.is_done(tile) for tile in job.store.grid)
    progress("tiles", done, total)
    if done == total:
        return
    failed: dict[str, BaseException] = {}
    with _client(workers, processes) as client:
        futures = as_completed()
        names = {}

        def submit(tile: Tile) -> None:
            future = client.submit(match_tile, job, tile, key=f"match-{tile.name}", pure=False)
            names[future.key] = tile.name
            futures.add(future)

        for tile in islice(waiting, 2 * workers):
            submit(tile)
        for future in futures:
            error = future.exception()
            name = names.pop(future.key)
            future.release()
            if error:
                failed[name] = error
            done += 1
            progress("tiles", done, total)
            for tile in islice(waiting, 1):
                submit(tile)
    if failed:
        lines = "\n".join(f"  tile {name}: {error}" for name, error in sorted(failed.items()))
        raise RunError(
            f"{len(failed)} of {total} tiles failed, the others are kept; mend the cause and run the same command "
            f"again:\n{lines}"
        )


@contextmanager
def _client(workers: int, processes: bool) -> Iterator[Client]:
    shape = (workers, 1) if processes else (1, workers)
    cluster = LocalCluster(
        n_workers=shape[0],
        threads_per_worker=shape[1],
        processes=processes,
        host="127.0.0.1" if processes else None,
        dashboard_address="127.0.0.1:0",
        worker_dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    )
    with cluster, Client(cluster) as client:
        yield client


def match_tile(job: Job, tile: Tile) -> None:
    """Match one tile and write what it leaves behind; runs on a worker."""
    seconds: dict[str, float] = {}
    usable = {"left": 0, "right": 0}

    def reader(image: Image, side: str) -> Any:
        def read(window: Window) -> tuple[np.ndarray, np.ndarray]:
            with _timed(seconds, "read"):
                pixels, state = read_window(image, window)
            usable[side] += int((state == 0).sum())
            return pixels, state

        return read

    grid, config = job.store.grid, job.config
    image = Window(0, 0, job.left.height, job.left.width)
    started = time.perf_counter()
    patch = match_patch(reader(job.left, "left"), reader(job.right, "right"), tile.core, grid.region, image, config)
    seconds["match"] = time.perf_counter() - started - seconds["read"]
    with _timed(seconds, "write"):
        job.store.write_arrays(tile, _left_behind(patch, tile, job))
    job.store.write_record(tile, {"usable_pixels": usable, "seconds": seconds})


def _left_behind(patch: Patch, tile: Tile, job: Job) -> dict[str, np.ndarray]:
    """What the tile's core adds to the store."""
    raw = patch.raw
    inner = tile.core.relative_to(patch.output).slices
    arrays = {name: getattr(raw, name)[inner] for name in ("winner", "lower", "upper", "disparity", "validity")}
    ambiguity = raw.ambiguity[inner]
    histogram = ambiguity_histogram(ambiguity, arrays["winner"] != NO_DISPARITY, job.store.ambiguities)
    if job.config.cross_check:
        arrays |= {"right_cost": patch.right.cost, "right_winner": patch.right.winner}
    seams = seam_lines(raw, patch.output, tile.core, job.store.grid.size)
    return arrays | {"ambiguity": ambiguity, "histogram": histogram, "seams": seams}


def _finish(
    job: Job, out: Path, inputs: dict[str, Any], seconds: dict[str, float], progress: Progress
) -> dict[str, Any]:
    """Final bands from the store to files, and the report of the run."""
    config, store, region = job.config, job.store, job.store.grid.region
    histogram = store.histogram()
    records = store.records()
    _check_matched(job, records, int(histogram.sum()))
    scale = confidence_scale(config.ambiguity, histogram) if config.ambiguity else Scale(np.nan, np.nan)
    tally = Tally(config.disparity.count)
    where = job.left.georeferencing.shifted(region)
    with OutputWriter(out, region.height, region.width, where, _tags(config)) as writer:
        with _timed(seconds, "bands"):
            strips = (Rows(**strip) for strip in store.strips(STRIP_ROWS))
            row = 0
            for final in _ahead(finish_strips(_ahead(strips), scale, config)):
                writer.write(row, final.intervals, final.validity)
                tally.add(final.intervals, final.validity)
                row += final.validity.shape[0]
                progress("bands", row, region.height)
        with _timed(seconds, "files"):
            progress("files", 0, 1)
            writer.build()
        for stage in ("read", "match", "write"):
            seconds[f"tiles.{stage}"] = sum(record["seconds"][stage] for record in records.values())
        seconds["total"] = sum(value for stage, value in seconds.items() if "." not in stage)
        report = _report(job, inputs, scale, tally, seconds)
        writer.publish({"run.json": json.dumps(report, indent=1) + "\n"})
        progress("files", 1, 1)
    return report


def _ahead(items: Iterable[Item]) -> Iterator[Item]:
    """The same items, each made in a thread of its own while the one before is used."""
    with ThreadPoolExecutor(1) as thread:
        iterator = iter(items)
        following = thread.submit(next, iterator, None)
        while (item := following.result()) is not None:
            following = thread.submit(next, iterator, None)
            yield item


def _check_matched(job: Job, records: dict[str, dict[str, Any]], searched: int) -> None:
    """An image without data is the user's mistake, and is told so."""
    missing = [tile.name for tile in job.store.grid if tile.name not in records]
    if missing:
        raise RunError(f"tiles {', '.join(missing)} are missing in {job.store.path}: run the same command again")
    if searched:
        return
    usable = {side: sum(record["usable_pixels"][side] for record in records.values()) for side in ("left", "right")}
    empty = [image.path for image, side in ((job.left, "left"), (job.right, "right")) if not usable[side]]
    reason = f"{' and '.join(empty)} hold no data" if empty else "their data do not meet over the search range"
    search = job.config.disparity
    raise SatIntervalsError(
        f"{job.left.path}, {job.right.path}: no pixel can be matched in [{search.minimum}, {search.maximum}], "
        f"{reason}: check no-data values, masks, window and search range"
    )


def _tags(config: Config) -> dict[str, str]:
    """What the files say of themselves."""
    tags = {
        "SOFTWARE": f"sat-intervals {version('sat-intervals')}",
        "SEARCH_RANGE": f"{config.disparity.minimum} {config.disparity.maximum}",
    }
    if config.interval:
        tags["ALPHA"] = f"{config.interval.alpha} (level of possibility; coverage on reference scenes .91 to .99)"
    return tags


def _report(job: Job, inputs: dict[str, Any], scale: Scale, tally: Tally, seconds: dict[str, float]) -> dict[str, Any]:
    """The content of run.json."""
    grid, config = job.store.grid, job.config
    packages = ("sat-intervals", "numpy", "numba", "dask", "distributed", "xarray", "zarr", "rasterio", "pyproj")
    return {
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "settings": config.model_dump(mode="json"),
        "inputs": inputs,
        "tiles": {
            "region": grid.region.__dict__,
            "rows": grid.rows,
            "columns": grid.columns,
            "size": grid.size,
            "overlap": config.tiles.overlap,
        },
        "cost_span": config.cost_span,
        "ambiguity_percentiles": None if config.ambiguity is None else {"p1": scale.p1, "p99": scale.p99},
        "counts": tally.report(),
        "validity_bits": {
            flag.name: {"bit": flag.bit, "meaning": flag.meaning, "invalid": flag.invalid} for flag in FLAGS
        },
        "overlap_left": seam_report(job.store.seams(), grid),
        "seconds": {stage: round(value, 3) for stage, value in seconds.items()},
        "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
    }


def _described(image: Image) -> dict[str, Any]:
    """What run.json and the manifest say of an input."""
    crs = image.georeferencing.crs
    return {
        **identity(image.path),
        "height": image.height,
        "width": image.width,
        "band": image.band,
        "dtype": image.dtype,
        "nodata": None if image.nodata is None else repr(image.nodata),
        "crs": crs.to_string() if crs else None,
        "mask": identity(image.mask) if image.mask else None,
    }
