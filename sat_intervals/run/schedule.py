"""Order of the steps of a job: tiles and, with exact seams, the borders that they take over from their neighbours."""

from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

from sat_intervals.kernels.sgm import LAST, WAVEFRONTS
from sat_intervals.match.borders import sources
from sat_intervals.tiling import Grid, Tile


class Step(NamedTuple):
    """A tile to match or, with a wavefront, the path states that it hands on in the left or right view."""

    tile: Tile
    wavefront: int | None = None
    mirrored: bool = False

    @property
    def name(self) -> str:
        """Name of the tile, followed by view and wavefront."""
        view = "_right" if self.mirrored else ""
        return self.tile.name if self.wavefront is None else f"{self.tile.name}{view}_{self.wavefront}"


def needs(grid: Grid, step: Step, views: int = 1) -> list[Step]:
    """Steps whose results a step takes over: borders of neighbours, in one wavefront or, for a tile, in all of them.

    ``views`` is the number of views that are matched, of which a tile needs all.
    """
    of_views = [step.mirrored] if step.wavefront is not None else [False, True][:views]
    wavefronts = range(len(WAVEFRONTS)) if step.wavefront is None else (step.wavefront,)
    found = []
    for wavefront in wavefronts:
        for rows, columns in sources(wavefront):
            row, column = step.tile.grid_row + rows, step.tile.grid_column + columns
            if 0 <= row < grid.rows and 0 <= column < grid.columns:
                found += [Step(grid.tile(row, column), wavefront, mirrored) for mirrored in of_views]
    return found


class Schedule:
    """Steps in an order in which each comes after those that it needs.

    Matching a tile also gives its borders of the last wavefront. So these are traced only if few tiles are ready: one
    worker hardly ever traces them, many workers need not wait.
    """

    def __init__(
        self, grid: Grid, tiles: Iterable[Tile], is_done: Callable[[str], bool] | None, views: int = 1
    ) -> None:
        """``is_done`` tells by their names which borders are done; None: tiles are independent of each other."""
        self._views = views
        self._open: dict[Step, int] = {}  # number of unfinished steps that each needs
        self._dependents: dict[Step, list[Step]] = {}
        waiting = [Step(tile) for tile in tiles]
        while waiting:
            step = waiting.pop()
            if step in self._open:
                continue
            others = needs(grid, step, views) if is_done else []
            needed = [other for other in others if not (is_done and is_done(other.name))]
            self._open[step] = len(needed)
            for other in needed:
                self._dependents.setdefault(other, []).append(step)
            waiting += needed
        self._taken: set[Step] = set()  # started, or given by a tile that is
        self._also_done: dict[Step, list[Step]] = {}
        self._under_way = 0
        self._traces, self._tiles, self._last = deque[Step](), deque[Step](), deque[Step]()
        for step in sorted((step for step, count in self._open.items() if not count), key=_order):
            self._queue(step).append(step)

    def _queue(self, step: Step) -> deque[Step]:
        if step.wavefront is None:
            return self._tiles
        return self._last if step.wavefront == LAST else self._traces

    def __len__(self) -> int:
        """Number of steps that have not ended."""
        return len(self._open)

    def next(self) -> Step | None:
        """A step to start, None while all others wait for those under way."""
        # Two steps per worker are under way, and few tiles wait: tiles alone would not unlock enough others.
        is_short = len(self._tiles) <= self._under_way // 2
        for queue in (self._traces, *((self._last, self._tiles) if is_short else (self._tiles, self._last))):
            while queue:
                step = queue.popleft()
                if step in self._open and step not in self._taken:
                    self._start(step)
                    return step
        return None

    def _start(self, step: Step) -> None:
        self._taken.add(step)
        self._under_way += 1
        if step.wavefront is None:
            borders = (Step(step.tile, LAST, mirrored) for mirrored in [False, True][: self._views])
            self._also_done[step] = [border for border in borders if border in self._open and border not in self._taken]
            self._taken.update(self._also_done[step])

    def ended(self, step: Step) -> None:
        """Note that a step has been done."""
        self._under_way -= 1
        for done in (*self._also_done.pop(step, ()), step):
            del self._open[done]
            for other in self._dependents.pop(done, ()):
                if other in self._open:  # else another step that it needs has failed
                    self._open[other] -= 1
                    if not self._open[other]:
                        self._queue(other).append(other)

    def failed(self, step: Step) -> None:
        """Note that a step cannot be done, nor those that need it; what a tile would have given is traced."""
        self._under_way -= 1
        for border in self._also_done.pop(step, ()):
            self._taken.discard(border)
            self._last.append(border)
        lost = [step]
        while lost:
            step = lost.pop()
            if self._open.pop(step, None) is not None:
                lost += self._dependents.pop(step, ())


def _order(step: Step) -> tuple[int, int, int]:
    return step.tile.grid_row, step.tile.grid_column, -1 if step.wavefront is None else step.wavefront
