"""Find the search range of a pair on a cluster: workers reduce the images block by block and look at samples."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from sat_intervals.config import Cluster
from sat_intervals.errors import InputError, RunError
from sat_intervals.match.memory import check_memory
from sat_intervals.match.normalization import BLOCK, blocks
from sat_intervals.match.rows import Survey
from sat_intervals.match.sampling import Look, Spot, look, spots
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
from sat_intervals.progress import Progress, logged_stage
from sat_intervals.raster import Image, read_views, read_window
from sat_intervals.run.connection import Connection
from sat_intervals.run.quality import COLLAR, collar_lines, is_plain
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


def look_at(left: Image, right: Image, spot: Spot) -> Look | None:
    """Look at a block, None where it cannot be read: its tiles will say so; runs on a worker."""
    with picklable_errors():
        try:
            views = read_views((left, right), spot.views)
        except InputError:
            return None
        return look(spot, *views)


@dataclass(frozen=True)
class Finder:
    """Finds with workers what a pair needs before its tiles; ``seconds`` gets the time that it takes."""

    workers: Workers
    progress: Progress
    seconds: dict[str, float] = field(default_factory=dict)

    def search_range(self, left: Image, right: Image) -> Found:
        """Find the search range, see `search_range`."""
        with logged_stage(self.seconds, "start.range"):
            return search_range(self.workers, left, right, self.progress)

    def survey(self, left: Image, right: Image, region: Window, search: tuple[int, int]) -> Survey:
        """Look at blocks of a region of the left image over a search range: noise and row offsets."""
        with logged_stage(self.seconds, "start.rows"):
            compile_kernels(settings(0, 3), hands_states_on=False)
            chosen = [(left, right, spot) for spot in spots(region, *search)]
            found = sorted(_results(self.workers, look_at, chosen, self.progress, "rows"), key=itemgetter(0))
            looks = [one for _, one in found if one is not None]
            return Survey.of_looks(region, search, looks, (right.height, right.width))


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
        found_range = find_range(small[0], small[1], step, (left.height, left.width))[0].fitted(right.width)
    except NoRangeError as error:
        hints = "".join(f"; {line}" for line in collar_lines(collars, (left.path, right.path)))
        raise NoRangeError(
            f"{left.path} and {right.path}: {error}{hints}: give the search range with --disparity MIN MAX, or check "
            "that the images are an epipolar pair: raw ones go to sat-intervals surface, or to rectify first"
        ) from None
    return replace(found_range, collars=collars)


@contextmanager
def finder_here(progress: Progress) -> Iterator[Finder]:
    """Yield a finder that uses the cores of this machine."""
    with Connection(Cluster(), Path()) as connection:
        yield Finder(connection, progress)


def find_here(left: Image, right: Image, progress: Progress) -> Found:
    """Find the search range of a pair with the cores of this machine."""
    with finder_here(progress) as finder:
        return finder.search_range(left, right)


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
    workers: Workers,
    function: Callable[..., Any],
    arguments: Sequence[tuple[Any, ...]],
    progress: Progress,
    stage: str = "range",
) -> Iterator[tuple[int, Any]]:
    """Yield results of a function on workers, by the number of its arguments."""
    tasks = (Task(i, function, each, _RETRIES) for i, each in enumerate(arguments))
    return results(workers, tasks, _failed, lambda done: progress(stage, done, len(arguments)))


def _failed(_: int, error: BaseException) -> NoReturn:
    raise RunError(f"search range and rows could not be found: {reason(error)}") from error
