"""Match pairs with truth at a sweep of thresholds, tile by tile, and measure their intervals."""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.config import Config
from sat_intervals.config.sections import Refinement
from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.gauge import OF_FITS, Gauge, at_levels, block_numbers, pairs_of
from sat_intervals.match.histogram import bias_histogram
from sat_intervals.match.measurement import QUANTILES, Measured, ThresholdSweep, threshold_sweep
from sat_intervals.match.postprocess import ConfidenceScale, RawRows, filter_rows, halo, with_halo
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.prepare.pair import FilePair
from sat_intervals.prepare.prepared import Prepared, prepare
from sat_intervals.products import INVALID
from sat_intervals.progress import Progress
from sat_intervals.raster import BLOCK, Image, Layer, open_image
from sat_intervals.raster.images import check_size
from sat_intervals.run.assemble import scale_of
from sat_intervals.run.checks import checked_pair, checked_region
from sat_intervals.run.connection import Connection
from sat_intervals.run.each import EachOnWorkers
from sat_intervals.run.inputs import check_unchanged, describe_inputs
from sat_intervals.run.job import Job, job_of
from sat_intervals.run.pair import check_failures, match_jobs
from sat_intervals.run.strips import raw_rows
from sat_intervals.store.lock import locked
from sat_intervals.tiling import Window

FEWEST = 1000  # pixels with truth, of all pairs


@dataclass(frozen=True)
class CalibrationScene:
    """A pair with truth to calibrate with; those of one ``group`` are left out together.

    ``tolerance``: distance in pixels up to which a truth outside an interval counts as inside. ``remove_bias``: whether
    the median of disparity - truth is added to the truth. ``window``: region of the left image, by default all.
    """

    name: str
    group: str
    left: Image
    right: Image
    truth: Layer
    config: Config
    window: Window | None = None
    tolerance: float = 0.0
    remove_bias: bool = False


def truth_of(left: Image, path: str | Path) -> Layer:
    """Open the truth of a whole left image; raise if it has another size."""
    truth = open_image(path)
    check_size(truth.path, (truth.height, truth.width), left, "give the truth of the left image")
    return Layer(truth, 0, 0)


def check_enough(pixels: int, scenes: Sequence[CalibrationScene], what: str) -> None:
    """Raise if there are too few pixels with truth."""
    if pixels < FEWEST:
        files = ", ".join(scene.truth.image.path for scene in scenes[:3])
        raise SatIntervalsError(
            f"{files}: {pixels} {what}, at least {FEWEST} are needed: give more pairs, or check truth and masks"
        )


def measure_scenes(scenes: Sequence[CalibrationScene], folder: Path, progress: Progress) -> list[Measured]:
    """Match scenes at every level of the sweep, in ``folder``, and measure them."""
    found: list[Measured] = []
    thresholds = threshold_sweep(scenes[0].config)
    compile_kernels(at_levels(scenes[0].config, 0.0, 0.0, QUANTILES[-1]))
    with _scratch(folder) as scratch, Connection(scenes[0].config.cluster, scratch) as workers:
        for number, scene in enumerate(scenes):
            one = progress if len(scenes) == 1 else partial(_of_all, progress, "scenes", number, len(scenes))
            one("scenes", 0, 1)
            found += _of_scene(workers, scene, thresholds, scratch / str(number), len(scenes) == 1, one)
    progress("scenes", len(scenes), len(scenes))
    check_enough(sum(part.kept for part in found), scenes, "kept pixels have a truth")
    return found


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """Yield a hidden folder for tiles, without what a killed calibration left there; delete it at the end."""
    scratch = folder / ".calibrate"
    with locked(scratch):
        for left in (file for file in scratch.iterdir() if file.is_dir()):
            shutil.rmtree(left)
        try:
            yield scratch
        finally:
            shutil.rmtree(scratch)


def _of_all(progress: Progress, stage: str, number: int, total: int, *_: object) -> None:
    """Report any progress of one of several scenes or batches of levels as theirs."""
    progress(stage, number, total)


def _of_scene(
    workers: Connection,
    scene: CalibrationScene,
    thresholds: ThresholdSweep,
    folder: Path,
    in_blocks: bool,
    progress: Progress,
) -> list[Measured]:
    """Match a scene, with two levels of the sweep at a time, and measure it."""
    gauge = Gauge(thresholds, scene.group, scene.tolerance, in_blocks=in_blocks)
    bias = None if scene.remove_bias else 0.0
    with ExitStack() as stack:
        pairs = pairs_of(thresholds)
        images = checked_pair(scene.left, scene.right, scene.config)
        each = EachOnWorkers(workers, progress)
        without_cuts = at_levels(scene.config, 0.0, 0.0, None)  # and without local ranges
        inputs = describe_inputs(dict(zip(("left", "right"), images, strict=True)), without_cuts, {})
        prepared = prepare(FilePair(*images), without_cuts, each, region=scene.window)
        jobs = [_begun(prepared, inputs, scene, thresholds, pair, folder / str(pair[1]), stack) for pair in pairs]
        # several tiles of one job keep all workers busy; stores of all jobs at once would fill the disk
        batches = [jobs] if len(jobs[0].store.grid) == 1 else [[job] for job in jobs]
        for number, batch in enumerate(batches):
            step = progress
            if in_blocks and len(batches) > 1:  # stages of each batch would begin again
                step = partial(_of_all, progress, "levels", number, len(batches))
            for matched in match_jobs(workers, batch, step):
                check_failures(matched.job, matched.failures)
                config = matched.job.config.model_copy(update={"refinement": scene.config.refinement})
                job = replace(matched.job, prepared=replace(prepared, config=config))
                bias = _found_bias(job, scene) if bias is None else bias
                pair = pairs[jobs.index(matched.job)]
                for strip, inner, scale, truth, blocks in _strips(job, scene):
                    gauge.add(strip, inner, scale, (truth + bias, blocks * in_blocks), pair, config)
                job.store.remove()
        check_unchanged(jobs[0].inputs, jobs[0].images, jobs[0].config)
    return gauge.measured()


def _begun(
    prepared: Prepared[FilePair],
    inputs: dict[str, Any],
    scene: CalibrationScene,
    thresholds: ThresholdSweep,
    pair: tuple[int, int],
    out: Path,
    stack: ExitStack,
) -> Job:
    """Make the job that matches a scene at two thresholds; open its store."""
    high, low = (
        scene.config.fit_cut if threshold == OF_FITS else float(thresholds.low[threshold]) for threshold in pair
    )
    config = prepared.config
    if config.fits:  # its tiles are those of V-fit, at any levels
        config = config.model_copy(update={"refinement": Refinement(method="vfit")})
    config = at_levels(config, high, low, None)
    prepared, region = replace(prepared, config=config), checked_region(prepared.pair.left, scene.window)
    job = job_of(prepared, out, inputs, {}, region, pair=out.parent.name)
    job = replace(job, has_files=False)
    job.begin()
    stack.callback(job.store.remove)
    return job


def _found_bias(job: Job, scene: CalibrationScene) -> float:
    """Return the median of disparity - truth of a matched scene."""
    histogram = bias_histogram()
    for strip, inner, scale, truth, _ in _strips(job, scene):
        rows = filter_rows(strip, scale, job.config)
        chosen = (rows.validity[inner] & INVALID == 0) & np.isfinite(truth)
        histogram.add(rows.disparity[inner][chosen].astype(np.float64) - truth[chosen])
    return histogram.median() or 0.0


def _strips(
    job: Job, scene: CalibrationScene
) -> Iterator[tuple[RawRows, slice, ConfidenceScale, np.ndarray, np.ndarray]]:
    """Yield raw rows with their halo, which of them are inside, the scale, and truth and blocks of those inside."""
    height, width = shape = job.store.grid.region.height, job.store.grid.region.width
    scale = scale_of(job, job.store.tables())
    row = 0
    starts = range(0, height, BLOCK)
    raw = (rows for start in starts for rows in raw_rows(job, start, min(height, start + BLOCK)))
    for rows, first, last in with_halo(raw, halo(job.config)):
        truth = scene.truth.read(Window(row, 0, last - first, width))
        yield rows, slice(first, last), scale, truth, block_numbers(row, last - first, shape)
        row += last - first
