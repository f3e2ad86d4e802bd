"""The files of a run's steps: one `.npz` for each tile and step, whose existence says that the step is done."""

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sat_intervals.errors import RunError
from sat_intervals.products import IMPOSSIBLE_COST, NO_DISPARITY
from sat_intervals.store.arrays import Archive, DamagedFileError, packed, unpacked
from sat_intervals.store.folder import Folder
from sat_intervals.tiling import Grid, Tile, Window

# Increase when files change: older tiles cannot be resumed.
LAYOUT = 14
NO_TILES = Grid(Window(0, 0, 0, 0), 1)
# Subfolders: path states on borders, pixels and costs for later steps, tiles, parts of final files, failures, and
# what is measured once a run.
KINDS = BORDERS, PIXELS, COSTS, TILES, PARTS, FAILURES, ONCE = (
    "borders", "pixels", "costs", "tiles", "parts", "failures", "once"
)  # fmt: skip
# Rows in one member of a tile: a strip reads only what it needs.
_ROWS = 64
# Rank of a right pixel without candidates, see `_rank`.
_UNSEEN = np.uint32(0xFFFFFFFF)
# Bytes of a pixel of a tile, and of each sub-pixel level.
PIXEL_BYTES, COVERAGE_BYTES = 20, 8


class DamagedTilesError(RunError):
    """Files that are missing or damaged; they are deleted, and made again by the same command."""


class Tables(NamedTuple):
    """What is summed over all tiles, or kept of each."""

    histogram: np.ndarray  # int64 (ambiguities + 1,): pixels by ambiguity
    records: dict[str, dict[str, Any]]  # ``meta`` of the tiles, by name


@dataclass(frozen=True)
class Store:
    """The intermediate files of one run; picklable, so that workers write their own."""

    folder: Folder
    grid: Grid
    run: str  # digest of the manifest: a file of another run counts as missing

    def write(
        self, kind: str, name: str, arrays: Iterable[tuple[str, np.ndarray]] = (), *, of: str = "", **meta: Any
    ) -> None:
        """Write a file as a whole; ``of`` says what it belongs to, by default the run."""
        self.folder.write(f"{kind}/{name}.npz", packed(arrays, {"of": of or self.run} | meta))

    def opened(self, kind: str, name: str, of: str = "") -> AbstractContextManager[Archive]:
        """Open a file for reading; see `unpacked`."""
        return unpacked(self.folder, f"{kind}/{name}.npz", of or self.run)

    def read(self, kind: str, name: str, wanted: Collection[str] = (), of: str = "") -> list[np.ndarray] | None:
        """Read all arrays of a file, or the ``wanted`` ones if any; None if it is missing or damaged."""
        with suppress(DamagedFileError), self.opened(kind, name, of) as archive:
            return [archive[key].copy() for key in wanted or archive.names()]
        return None

    def meta(self, kind: str, name: str, of: str = "") -> dict[str, Any] | None:
        """Read what a file has beside arrays; None if it is missing or damaged."""
        with suppress(DamagedFileError), self.opened(kind, name, of) as archive:
            return archive.meta
        return None

    def names(self, kind: str) -> set[str]:
        """Return the names of the files of a kind."""
        return {name.removesuffix(".npz") for name in self.folder.sizes(kind)}

    def delete(self, kind: str, names: Iterable[str]) -> None:
        """Delete files, if they exist."""
        self.folder.delete(f"{kind}/{name}.npz" for name in names)

    def remove(self, kinds: Iterable[str] = KINDS) -> None:
        """Delete all files of some kinds."""
        for kind in kinds:
            self.folder.remove(kind)
        self.folder.remove_if_empty()

    def is_intact(self, kind: str, name: str, of: str = "") -> bool:
        """Return whether a file is there and all of it agrees with its checksums."""
        with suppress(DamagedFileError), self.opened(kind, name, of) as archive:
            return archive.is_intact()
        return False

    def failures(self) -> dict[str, str]:
        """Return why tiles failed, by name, without those done since."""
        found = {name: self.meta(FAILURES, name) for name in sorted(self.names(FAILURES) - self.names(TILES))}
        return {name: meta["reason"] if meta else "the reason cannot be read" for name, meta in found.items()}

    # ---- Tiles ---------------------------------------------------------------------------------------------
    def write_tile(self, tile: Tile, arrays: Mapping[str, np.ndarray], **meta: Any) -> None:
        """Write the products of a tile: fields of `Raw` of the core's shape, those of the right view, ``histogram``."""
        rows = {name: arrays[name] for name in arrays if not name.startswith("right_")}
        histogram = rows.pop("histogram")
        if "right_cost" in arrays:
            rows["right"] = _rank(arrays["right_cost"], arrays["right_winner"])
        starts = range(0, tile.core.height, _ROWS)
        of_rows = ((f"{start:05}/{name}", rows[name][start : start + _ROWS]) for start in starts for name in rows)
        self.write(TILES, tile.name, [("histogram", histogram), *of_rows], **meta)

    def tables(self) -> Tables:
        """Read what is summed over all tiles; raise DamagedTilesError if one is missing or damaged."""
        histogram: np.ndarray = np.zeros(1, np.int64)
        records = {}
        try:
            for tile in self.grid:
                with self.opened(TILES, tile.name) as archive:
                    records[tile.name] = archive.meta
                    histogram = histogram + archive["histogram"].astype(np.int64)
        except DamagedFileError as error:
            raise self.damaged(TILES, (tile.name for tile in self.grid)) from error
        return Tables(histogram, records)

    def strips(self, rows: int, count: int, first: int = 0, last: int | None = None) -> Iterator[dict[str, np.ndarray]]:
        """Yield products of full-width strips of about ``rows`` rows, as fields of `RawRows`, of ``count`` disparities.

        They have the rows ``[first, last)`` of the region, by default all. The right views of the tiles are merged:
        smallest cost, largest disparity at ties. DamagedTilesError names damaged tiles.
        """
        step, last = max(_ROWS, rows // _ROWS * _ROWS), self.grid.region.height if last is None else last
        for start in range(first // step * step, last, step):
            top, bottom = max(start, first), min(start + step, last)
            try:
                yield self._strip(top, bottom, count)
            except DamagedFileError as error:
                raise self.damaged(TILES, (tile.name for tile in self._tiles(top, bottom))) from error

    def _tiles(self, top: int, bottom: int) -> list[Tile]:
        """Return the tiles of some rows of the region."""
        of_rows = range(top // self.grid.size, -(-bottom // self.grid.size))
        return [self.grid.tile(row, column) for row in of_rows for column in range(self.grid.columns)]

    def _strip(self, top: int, bottom: int, count: int) -> dict[str, np.ndarray]:
        region, strip = self.grid.region, dict[str, np.ndarray]()
        best = np.full((bottom - top, region.width + count - 1), _UNSEEN)
        for tile in self._tiles(top, bottom):
            place = tile.core.relative_to(region)
            first, last = max(top - place.row, 0), min(bottom - place.row, place.height)
            with self.opened(TILES, tile.name) as archive:
                for member in archive.names():
                    group, _, name = member.partition("/")
                    if not name or not first // _ROWS * _ROWS <= int(group) < last:
                        continue
                    start = max(first - int(group), 0)
                    rows = archive[member][start : last - int(group)]
                    row = place.row + int(group) + start - top
                    target = best
                    if name != "right":
                        target = strip.setdefault(name, np.empty((bottom - top, region.width), rows.dtype))
                    here = target[row : row + len(rows), place.column : place.column + rows.shape[1]]
                    here[...] = np.minimum(here, rows) if name == "right" else rows
        return strip | {"right_winner": _winner(best)}

    def damaged(self, kind: str, names: Iterable[str], of: str = "") -> DamagedTilesError:
        """Delete those of some files that are damaged; return the error that names them."""
        names = [name for name in names if not self.is_intact(kind, name, of)]
        self.delete(kind, names)
        verb = "matches" if kind == TILES else "makes"
        return DamagedTilesError(
            f"{kind} {', '.join(names)} in {self.folder} are damaged or missing: rerun the same command: it {verb} "
            "them again"
        )


def store_bytes(grid: Grid, *, has_coverage: bool) -> int:
    """Return the size of all tiles, at most."""
    return (PIXEL_BYTES + COVERAGE_BYTES * has_coverage) * grid.region.height * grid.region.width


def home_of(out: Path) -> Path:
    """Return the folder of a run's manifest and, without a store, of its tiles."""
    return out / "tiles"


def _rank(cost: np.ndarray, winner: np.ndarray) -> np.ndarray:
    """Combine cost and winner of right pixels in one number, smallest for the best: cost, then larger disparity."""
    rank = cost.astype(np.uint32) << 16 | (np.iinfo(np.int16).max - winner.astype(np.int32)).astype(np.uint32)
    return np.where(cost == IMPOSSIBLE_COST, _UNSEEN, rank)


def _winner(rank: np.ndarray) -> np.ndarray:
    """Return the winners of ranks, see `_rank`."""
    winner = (np.iinfo(np.int16).max - (rank & 0xFFFF).astype(np.int32)).astype(np.int16)
    return np.where(rank == _UNSEEN, np.int16(NO_DISPARITY), winner)
