"""Find the search range of a pair on a cluster: workers reduce the images block by block and look at samples."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from sat_intervals.config import Cluster
from sat_intervals.errors import RunError
from sat_intervals.match.memory import check_memory
from sat_intervals.match.normalization import BLOCK, blocks
from sat_intervals.match.sampling import Look, Sample, coarse_rows, look, samples, summary
from sat_intervals.match.search_range import (
    Found,
    NoRangeError,
    Step,
    collar,
    find_range,
    finest_step,
    reduced,
    settings,
)
from sat_intervals.match.warm_up import compile_kernels
from sat_intervals.progress import Progress
from sat_intervals.raster import Image, read_window
from sat_intervals.run.connection import Connection
from sat_intervals.run.quality import COLLAR, is_plain
from sat_intervals.run.workers import Task, Workers, picklable_errors, reason, results
from sat_intervals.tiling import Grid, Window

_RETRIES = 2
_TASK = 500  # bytes of the window and the task of a block


def reduce_block(image: Image, block: Window, step: Step) -> tuple[np.ndarray, float]:
    """Return a block of an image at the finest level, and its smallest usable pixel; runs on a worker."""
    with picklable_errors():
        pixels, state = read_window(image, block)
        smallest = pixels.min(where=state == 0, initial=np.inf)
        return reduced(pixels, state, step), float(smallest)


def look_at(left: Image, right: Image, sample: Sample) -> Look | None:
    """Match a sample; runs on a worker."""
    with picklable_errors():
        views = (read_window(image, window) for image, window in zip((left, right), sample.views, strict=True))
        return look(sample, *views)


def search_range(workers: Workers, left: Image, right: Image, progress: Progress) -> Found:
    """Find the search range of a pair from the whole images, with its evidence; NoRangeError without enough matches."""
    for image in (left, right):
        size, number = f"{image.height} x {image.width}", len(Grid(Window(0, 0, image.height, image.width), BLOCK))
        check_memory(_TASK * number, f"{image.path}: {size} pixels in {number} blocks", "is it the right file?")
    progress("kernels", 0, 1)
    compile_kernels(settings(0, 3))
    step = finest_step(left.height, max(left.width, right.width))
    small, collars = [], {}
    for side, image in (("left", left), ("right", right)):
        pixels, smallest = _reduced(workers, image, step, progress)
        found = collar(pixels, smallest)
        if is_plain(image) and found.mean() > COLLAR:
            collars[side] = {"value": smallest, "share": round(float(found.mean()), 4)}
            pixels[found] = np.nan
        small.append(pixels)
    try:
        searched, matches = find_range(small[0], small[1], step, (left.height, left.width))
    except NoRangeError as error:
        raise NoRangeError(
            f"{left.path} and {right.path}: {error}: give the search range with --disparity MIN MAX, or check that the "
            "images are an epipolar pair"
        ) from None
    chosen = [(left, right, sample) for sample in samples(matches, coarse_rows(*matches.images, matches))]
    looks = [found for _, found in _results(workers, look_at, chosen, lambda stage, done, total: None)]
    return replace(searched, quality=summary(looks) | {"collars": collars})


def find_here(left: Image, right: Image, progress: Progress) -> Found:
    """Find the search range of a pair with the cores of this machine; see `search_range`."""
    with Connection(Cluster(), Path()) as connection:
        return search_range(connection, left, right, progress)


def _reduced(workers: Workers, image: Image, step: Step, progress: Progress) -> tuple[np.ndarray, float]:
    """An image at the finest level, and its smallest usable value."""
    windows = [
        block
        for block in blocks(image.height, image.width)
        if block.height >= step.rows and block.width >= step.columns
    ]
    small = np.full((image.height // step.rows, image.width // step.columns), np.nan, np.float32)
    smallest = np.inf
    for number, (pixels, least) in _results(workers, reduce_block, [(image, each, step) for each in windows], progress):
        row, column = windows[number].row // step.rows, windows[number].column // step.columns
        small[row : row + pixels.shape[0], column : column + pixels.shape[1]] = pixels
        smallest = min(smallest, least)
    return small, smallest


def _results(
    workers: Workers, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], progress: Progress
) -> Iterator[tuple[int, Any]]:
    """Yield results of a function on workers, by the number of its arguments."""
    tasks = (Task(i, function, each, _RETRIES) for i, each in enumerate(arguments))
    return results(workers, tasks, _failed, lambda done: progress("range", done, len(arguments)))


def _failed(_: int, error: BaseException) -> NoReturn:
    raise RunError(f"the search range could not be found: {reason(error)}") from error
