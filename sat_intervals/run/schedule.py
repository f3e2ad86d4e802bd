"""Order of the steps of a job: tiles and, with exact seams, the borders that they take over from their neighbours."""

from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

from sat_intervals.kernels.sgm import WAVEFRONTS
from sat_intervals.match.borders import sources
from sat_intervals.tiling import Grid, Tile


class Step(NamedTuple):
    """A tile to match or, with a wavefront, the path states that it hands on."""

    tile: Tile
    wavefront: int | None = None

    @property
    def name(self) -> str:
        """Name of the tile, followed by the wavefront."""
        return self.tile.name if self.wavefront is None else f"{self.tile.name}_{self.wavefront}"


def needs(grid: Grid, step: Step) -> list[Step]:
    """Steps whose results a step takes over: the borders of neighbours, in one wavefront or, for a tile, in all."""
    wavefronts = range(len(WAVEFRONTS)) if step.wavefront is None else (step.wavefront,)
    found = []
    for wavefront in wavefronts:
        for rows, columns in sources(wavefront):
            row, column = step.tile.grid_row + rows, step.tile.grid_column + columns
            if 0 <= row < grid.rows and 0 <= column < grid.columns:
                found.append(Step(grid.tile(row, column), wavefront))
    return found


class Schedule:
    """Steps in an order in which each comes after those that it needs."""

    def __init__(self, grid: Grid, tiles: Iterable[Tile], borders: set[str] | None) -> None:
        """``borders`` are the names of those that are done; None: tiles are independent of each other."""
        self._open: dict[Step, int] = {}  # number of unfinished steps that each needs
        self._dependents: dict[Step, list[Step]] = {}
        waiting = [Step(tile) for tile in tiles]
        while waiting:
            step = waiting.pop()
            if step in self._open:
                continue
            needed = [] if borders is None else [other for other in needs(grid, step) if other.name not in borders]
            self._open[step] = len(needed)
            for other in needed:
                self._dependents.setdefault(other, []).append(step)
            waiting += needed
        self._ready = deque(sorted((step for step, count in self._open.items() if not count), key=_order))

    def __len__(self) -> int:
        """Number of steps that have not ended."""
        return len(self._open)

    def next(self) -> Step | None:
        """A step to start, None while all others wait for those under way."""
        return self._ready.popleft() if self._ready else None

    def ended(self, step: Step) -> None:
        """Note that a step has been done."""
        del self._open[step]
        for other in self._dependents.pop(step, ()):
            if other in self._open:  # else another step that it needs has failed
                self._open[other] -= 1
                if not self._open[other]:
                    self._ready.append(other)

    def failed(self, step: Step) -> None:
        """Note that a step cannot be done, nor those that need it."""
        lost = [step]
        while lost:
            step = lost.pop()
            if self._open.pop(step, None) is not None:
                lost += self._dependents.pop(step, ())


def _order(step: Step) -> tuple[int, int, int]:
    return step.tile.grid_row, step.tile.grid_column, -1 if step.wavefront is None else step.wavefront
