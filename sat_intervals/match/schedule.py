"""Order of the steps of a job: blocks of tiles and, with exact seams, the path states that they hand to each other.

A block is a tile, or several small ones: reading, opening files and submitting take time for each step.
"""

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.config import Config
from sat_intervals.kernels.cost import padded_to_lanes
from sat_intervals.kernels.sgm import LAST, WAVEFRONTS
from sat_intervals.match.borders import sources
from sat_intervals.match.local_ranges import LocalRanges, narrowed
from sat_intervals.match.memory import tiles_together
from sat_intervals.tiling import Grid, Tile

# Blocks along each side of the grid, at least, if there are as many tiles: for several workers.
_BLOCKS = 4


def blocks_of(grid: Grid, config: Config) -> Grid:
    """Return the blocks of a grid of tiles; it depends only on what a run must not change when it resumes."""
    tiles = min(tiles_together(config, grid.size), grid.rows // _BLOCKS, grid.columns // _BLOCKS)
    return Grid(grid.region, grid.size * max(1, tiles))


class Step(NamedTuple):
    """A block to match or, with a wavefront, the path states that it hands on in all views."""

    block: Tile
    wavefront: int | None = None

    @property
    def name(self) -> str:
        """Name of the block, followed by the wavefront."""
        return self.block.name if self.wavefront is None else f"{self.block.name}_{self.wavefront}"


def needs(blocks: Grid, step: Step, together: int = 1) -> list[Step]:
    """Return the steps whose results a step takes over; of several tiles ``together`` also those inside the block."""
    inside = LAST if together > 1 and step.wavefront is None else 0
    found = [Step(step.block, wavefront) for wavefront in range(inside)]
    for wavefront in range(len(WAVEFRONTS)) if step.wavefront is None else (step.wavefront,):
        for rows, columns in sources(wavefront):
            row, column = step.block.grid_row + rows, step.block.grid_column + columns
            if 0 <= row < blocks.rows and 0 <= column < blocks.columns:
                found.append(Step(blocks.tile(row, column), wavefront))
    return found


class Schedule:
    """Steps in an order in which each comes after those that it needs.

    Matching a block also gives its borders of the last wavefront. So these are traced only if few blocks are ready: one
    worker hardly ever traces them, many workers need not wait.
    """

    def __init__(
        self, blocks: Grid, waiting: Iterable[Tile], is_done: Callable[[str], bool] | None, together: int = 1
    ) -> None:
        """Order the steps of ``waiting`` blocks; ``is_done`` tells borders that are done (None: no borders)."""
        self._open: dict[Step, int] = {}  # number of unfinished steps that each needs
        self._dependents: dict[Step, list[Step]] = {}
        steps = [Step(block) for block in waiting]
        while steps:
            step = steps.pop()
            if step in self._open:
                continue
            others = needs(blocks, step, together) if is_done else []
            needed = [other for other in others if not (is_done and is_done(other.name))]
            self._open[step] = len(needed)
            for other in needed:
                self._dependents.setdefault(other, []).append(step)
            steps += needed
        self._under_way: set[Step] = set()
        self._traces, self._blocks, self._last = deque[Step](), deque[Step](), deque[Step]()
        for step in sorted((step for step, count in self._open.items() if not count), key=_order):
            self._queue(step).append(step)

    def _queue(self, step: Step) -> deque[Step]:
        if step.wavefront is None:
            return self._blocks
        return self._last if step.wavefront == LAST else self._traces

    def __len__(self) -> int:
        """Number of steps that have not ended; also those under way whose block has given the same meanwhile."""
        return len(self._open) + sum(step not in self._open for step in self._under_way)

    def next(self) -> Step | None:
        """A step to start, None while all others wait for those under way."""
        # Two steps per worker are under way, and few blocks wait: blocks alone would not unlock enough others.
        is_short = len(self._blocks) <= len(self._under_way) // 2
        for queue in (self._traces, *((self._last, self._blocks) if is_short else (self._blocks, self._last))):
            while queue:
                step = queue.popleft()
                is_given = step.wavefront == LAST and Step(step.block) in self._under_way
                if step in self._open and step not in self._under_way and not is_given:
                    self._under_way.add(step)
                    return step
        return None

    def ended(self, step: Step) -> None:
        """Note that a step has been done."""
        self._under_way.discard(step)
        for done in (step, Step(step.block, LAST)) if step.wavefront is None else (step,):
            if self._open.pop(done, None) is None:  # borders that its block has given meanwhile
                continue
            for other in self._dependents.pop(done, ()):
                if other in self._open:  # else another step that it needs has failed
                    self._open[other] -= 1
                    if not self._open[other]:
                        self._queue(other).append(other)

    def failed(self, step: Step) -> bool:
        """Note that a step failed, and those that need it; return False if its block gives the same result."""
        self._under_way.discard(step)
        last = Step(step.block, LAST)
        if step == last and (step not in self._open or Step(step.block) in self._under_way):
            return False
        if step.wavefront is None and last not in self._under_way and self._open.get(last) == 0:
            self._last.append(last)
        lost = [step]
        while lost:
            step = lost.pop()
            if self._open.pop(step, None) is not None:
                lost += self._dependents.pop(step, ())
        return True


def _order(step: Step) -> tuple[int, int, int]:
    return step.block.grid_row, step.block.grid_column, -1 if step.wavefront is None else step.wavefront


def handed_bytes(grid: Grid, config: Config, images: Iterable[Any], ranges: LocalRanges | None = None) -> int:
    """Return the bytes, at most, that steps hand to each other: path states, pixels of ``images``, costs."""
    if not config.hands_states_on or len(grid) == 1:
        return 0
    height, width, views = grid.region.height, grid.region.width, 1 + config.matches_right_view
    handed = 0
    for tile in grid:
        core, count = tile.core, narrowed(ranges, tile.core.grown(1, 1).clipped(grid.region), config).disparity.count
        states = (
            2 * len(WAVEFRONTS) * (core.height + core.width) * padded_to_lanes(count) * np.dtype(np.uint16).itemsize
        )
        handed += views * (states + config.cost.precomputed * core.height * core.width * count)
    if not config.cost.compares_two:  # costs hold all that steps need of the images
        return handed
    blocks, support = blocks_of(grid, config), 2 * config.tiles.support
    around = 2 * (config.cost.window // 2 + 1)
    for side, image in enumerate(images):
        size = np.dtype(image.dtype).itemsize
        if side and config.rows == "auto":
            size = max(size, np.dtype(np.float32).itemsize)  # of rows that were taken out
        rows = min(image.height, height + support) + blocks.rows * around
        columns = min(image.width, width + support) + blocks.columns * (around + views * config.disparity.count)
        handed += rows * columns * (size + 1)  # with its state
    return handed
