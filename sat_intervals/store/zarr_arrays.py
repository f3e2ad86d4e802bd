"""The arrays of the tiles of a run, in files that each tile writes for itself. The only home of zarr."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import zarr
from zarr.codecs import BloscCodec
from zarr.errors import ContainsArrayError

from sat_intervals.products import IMPOSSIBLE_COST, NO_DISPARITY
from sat_intervals.store.folder import Folder
from sat_intervals.tiling import Grid, Tile

# Raw products of the pixels of a core, in two arrays by their size, whose planes are read and written in one piece.
_PLANES: dict[str, dict[str, type[np.generic]]] = {
    "int16": {"winner": np.int16, "lower": np.int16, "upper": np.int16, "validity": np.uint16},
    "uint32": {"disparity": np.float32, "ambiguity": np.uint32},
}
# What a core has seen from the right, see `_rank`.
_RIGHT = "right"
# The rank of a right pixel that no candidate was seen from.
_UNSEEN = np.uint32(0xFFFFFFFF)
SIDES = ("top", "bottom", "left", "right")
# The raw products that neighbours compare along a seam.
SEAM_PRODUCTS = ("winner", "lower", "upper")

# Rows of a shard that are compressed together, so that strips read no more than they need.
_ROWS_TOGETHER = 128
# What zarr and its codecs raise of files that were cut short or changed.
_DAMAGED = ValueError, RuntimeError
_COMPRESSOR = BloscCodec(cname="lz4", clevel=1, shuffle="shuffle")


class DamagedTilesError(Exception):
    """Tiles whose files cannot be read."""

    def __init__(self, tiles: Sequence[Tile], reason: str) -> None:
        super().__init__(reason)
        self.tiles = tuple(tiles)


@dataclass(frozen=True)
class TileArrays:
    """Raw products of all tiles, and what the whole image needs of each; picklable.

    Attributes
    ----------
    folder
        Where they lie.
    grid
        The tiles.
    count
        Number of disparities of the search range.
    ambiguities
        Largest ambiguity a pixel can have.
    """

    folder: Folder
    grid: Grid
    count: int
    ambiguities: int

    @property
    def _reach(self) -> int:
        """Columns of the right view that a core sees."""
        return self.grid.size + self.count - 1

    def create(self) -> None:
        """Make those that are not there, empty; of several that do so at once, each makes the same."""
        size, height = self.grid.size, self.grid.rows * self.grid.size
        width = self.grid.columns * size
        together = math.gcd(size, _ROWS_TOGETHER)
        group = zarr.open_group(self.folder.place(""), mode="a", zarr_format=3)
        for dtype, planes in _PLANES.items():
            count = len(planes)
            _create(group, dtype, (count, height, width), (count, size, size), (count, together, size), dtype)
        right = height, self.grid.columns * self._reach
        _create(group, _RIGHT, right, (size, self._reach), (together, self._reach), np.uint32, _UNSEEN)
        lines = len(SIDES), 2, len(SEAM_PRODUCTS), size
        tiles, counts = (self.grid.rows, self.grid.columns), self.ambiguities + 1
        _create(group, "seams", (*tiles, *lines), None, (1, 1, *lines), np.int16, NO_DISPARITY)
        _create(group, "histogram", (*tiles, counts), None, (1, 1, counts), np.uint32)

    def _array(self, name: str, mode: Literal["r", "r+"] = "r") -> zarr.Array[Any]:
        # Blocks that hold nothing but fill values are written too: files that are missing tell of tiles that are.
        array = zarr.open_array(self.folder.place(name), mode=mode, zarr_format=3)
        return array.with_config({"write_empty_chunks": True})

    def files(self) -> set[str]:
        """Names of all files."""
        return self.folder.files("")

    def files_of(self, tile: Tile) -> set[str]:
        """The files that hold what a tile leaves behind."""
        place = f"{tile.grid_row}/{tile.grid_column}"
        return {
            *(f"{dtype}/c/0/{place}" for dtype in _PLANES),
            f"{_RIGHT}/c/{place}", f"seams/c/{place}/0/0/0/0", f"histogram/c/{place}/0",
        }  # fmt: skip

    def bytes_of(self, tile: Tile) -> int:
        """What a tile leaves behind, before compression."""
        pixel = sum(np.dtype(dtype).itemsize for planes in _PLANES.values() for dtype in planes.values())
        return tile.core.height * (tile.core.width * pixel + self._reach * np.dtype(np.uint32).itemsize)

    def write(self, tile: Tile, arrays: Mapping[str, np.ndarray]) -> None:
        """Write what a tile leaves behind.

        Parameters
        ----------
        tile
            Which tile.
        arrays
            ``winner``, ``lower``, ``upper``, ``disparity``, ``ambiguity`` and ``validity`` of the core's shape;
            ``right_cost`` and ``right_winner``, which may be missing; ``seams`` (SIDES, own line or ring,
            SEAM_PRODUCTS, size); ``histogram``.
        """
        try:
            self._write(tile, arrays)
        except _DAMAGED:  # zarr reads what is there before it writes over it
            self.drop(tile)
            self._write(tile, arrays)

    def _write(self, tile: Tile, arrays: Mapping[str, np.ndarray]) -> None:
        size, row, column = self.grid.size, tile.grid_row, tile.grid_column
        height, width = arrays["winner"].shape
        rows = slice(row * size, row * size + height)
        for dtype, planes in _PLANES.items():
            made = np.stack([arrays[name].view(dtype) for name in planes])
            self._array(dtype, "r+")[:, rows, column * size : column * size + width] = made
        rank = np.full((height, self._reach), _UNSEEN)
        if "right_cost" in arrays:
            rank[:, : arrays["right_cost"].shape[1]] = _rank(arrays["right_cost"], arrays["right_winner"])
        self._array(_RIGHT, "r+")[rows, column * self._reach : (column + 1) * self._reach] = rank
        for name in ("seams", "histogram"):
            self._array(name, "r+")[row, column] = arrays[name]

    def drop(self, tile: Tile) -> None:
        """Delete what a tile left behind."""
        for name in self.files_of(tile):
            self.folder.delete(name)

    def histogram(self) -> np.ndarray:
        """Ambiguities of the whole region: int64 ``(ambiguities + 1,)``."""
        stored = self._array("histogram")
        rows = (np.asarray(stored[row]).sum(axis=0, dtype=np.int64) for row in range(self.grid.rows))
        return sum(rows, np.zeros(self.ambiguities + 1, np.int64))

    def seams(self) -> np.ndarray:
        """The lines along the tiles' borders: int16 (grid rows, grid columns, SIDES, own or ring, products, size)."""
        return np.asarray(self._array("seams")[:])

    def strips(self, rows: int) -> Iterator[dict[str, np.ndarray]]:
        """Raw products of the region in full-width strips of about ``rows`` rows, from the top.

        The shares of the right view are merged: smallest cost, the largest disparity at ties.

        Raises
        ------
        DamagedTilesError
            Those that cannot be read.
        """
        step = max(_ROWS_TOGETHER, rows // _ROWS_TOGETHER * _ROWS_TOGETHER)
        for first in range(0, self.grid.region.height, step):
            last = min(first + step, self.grid.region.height)
            try:
                strip, right = self._read(slice(first, last), slice(None, self.grid.region.width), slice(None))
            except _DAMAGED as error:
                raise DamagedTilesError(list(self._damaged(first, last)), " ".join(str(error).split())) from error
            yield strip | {"right_winner": self._merged(right)}

    def _read(self, rows: slice, columns: slice, right_columns: slice) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Raw products of some pixels by name, and ranks of right ones."""
        strip: dict[str, np.ndarray] = {}
        for dtype, planes in _PLANES.items():
            read = np.asarray(self._array(dtype)[:, rows, columns])
            strip |= {name: plane.view(of) for (name, of), plane in zip(planes.items(), read, strict=True)}
        return strip, np.asarray(self._array(_RIGHT)[rows, right_columns])

    def _damaged(self, first: int, last: int) -> Iterator[Tile]:
        """The tiles of some rows that cannot be read."""
        size = self.grid.size
        for tile in self.grid:
            row, column = tile.grid_row * size, tile.grid_column * size
            share = slice(tile.grid_column * self._reach, (tile.grid_column + 1) * self._reach)
            if row < last and first < row + size:
                try:
                    self._read(slice(row, row + tile.core.height), slice(column, column + tile.core.width), share)
                except _DAMAGED:
                    yield tile

    def _merged(self, ranks: np.ndarray) -> np.ndarray:
        """One right view ``(rows, width + count - 1)`` from the shares of all cores of the rows."""
        best = np.full((ranks.shape[0], self.grid.region.width + self.count - 1), _UNSEEN)
        for column in range(self.grid.columns):
            seen = best[:, column * self.grid.size : column * self.grid.size + self._reach]
            share = ranks[:, column * self._reach : column * self._reach + seen.shape[1]]
            np.minimum(seen, share, out=seen)
        return _winner(best)


def _create(
    group: zarr.Group,
    name: str,
    shape: tuple[int, ...],
    shard: tuple[int, ...] | None,
    chunk: tuple[int, ...],
    dtype: npt.DTypeLike,
    fill: Any = 0,
) -> None:
    with suppress(ContainsArrayError):
        group.create_array(
            name, shape=shape, shards=shard, chunks=chunk, dtype=dtype, compressors=_COMPRESSOR, fill_value=fill
        )  # fmt: skip


def _rank(cost: np.ndarray, winner: np.ndarray) -> np.ndarray:
    """Costs and winners of right pixels as one number, smaller the better: cost, and the larger disparity at ties."""
    rank = cost.astype(np.uint32) << 16 | (np.iinfo(np.int16).max - winner.astype(np.int32)).astype(np.uint32)
    return np.where(cost == IMPOSSIBLE_COST, _UNSEEN, rank)


def _winner(rank: np.ndarray) -> np.ndarray:
    """The winners in what `_rank` made."""
    winner = (np.iinfo(np.int16).max - (rank & 0xFFFF).astype(np.int32)).astype(np.int16)
    return np.where(rank == _UNSEEN, np.int16(NO_DISPARITY), winner)
