"""Zarr arrays of the tiles of a run; each tile writes its own files. Only this module imports zarr.

zarr describes the arrays, for other tools. Chunks are written and read here: every byte is checked on its way in, on
which zarr's stores cannot be relied (3.4 reads around the methods of a wrapped store), and zarr takes milliseconds for
each file.
"""

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import google_crc32c
import numpy as np
import numpy.typing as npt
import zarr
from numcodecs import blosc
from zarr.codecs import BloscCodec
from zarr.storage import MemoryStore

from sat_intervals.products import IMPOSSIBLE_COST, NO_DISPARITY
from sat_intervals.store.folder import Folder
from sat_intervals.tiling import Grid, Tile

# Raw products of a core's pixels, in one array per type; its planes are read and written together.
_WORDS: dict[str, type[np.generic]] = {"winner": np.int16, "lower": np.int16, "upper": np.int16, "validity": np.uint16}
_SUBPIXEL: dict[str, type[np.generic]] = dict.fromkeys(("lower", "upper", "lower_low", "upper_low"), np.uint16)
_LONG_WORDS: dict[str, type[np.generic]] = {"disparity": np.float32, "ambiguity": np.uint32}
# Right view of each core, see `_rank`.
_RIGHT = "right"
# Rank of a right pixel without candidates.
_UNSEEN = np.uint32(0xFFFFFFFF)
SIDES = ("top", "bottom", "left", "right")
# Arrays with one chunk a tile.
_TABLES: dict[str, type[np.generic]] = {"seams": np.int16, "histogram": np.uint32}

# Rows of a shard that are compressed together. Writing a tile of 1024 x 1024 pixels and reading it by strips of 512
# rows with a halo takes 0.26 s of processor time with 64 rows, as with 128, and 0.34 s with 32: each piece has a price.
_ROWS_TOGETHER = 64
# A tile takes 0.13 s and 12 MB, without compression 0.11 s and 21 MB.
_COMPRESSOR = BloscCodec(cname="lz4", clevel=1, shuffle="shuffle")
# Bytes per pixel of raw products: 8 to 12 compressed, 2 more for each sub-pixel level.
STORED_BYTES = 12

Checksums = Mapping[str, Sequence[int]]
"""Size in bytes and CRC-32 of files, by name; of shards, then those of their pieces and of the index after them."""


class DamagedFileError(Exception):
    """A file that is missing or damaged."""


@dataclass(frozen=True)
class TileArrays:
    """Arrays of raw products, right view, seams and histograms of all tiles; picklable.

    Attributes
    ----------
    folder
        Folder of the arrays.
    grid
        The tiles.
    count
        Number of disparities of the search range.
    ambiguities
        Largest possible ambiguity of a pixel.
    levels
        Levels of sub-pixel bounds, each with a lower and an upper one; 0 for bounds in whole pixels.
    has_seams
        Whether there are lines along the tiles' borders.
    """

    folder: Folder
    grid: Grid
    count: int
    ambiguities: int
    levels: int
    has_seams: bool

    @property
    def _reach(self) -> int:
        return _reach(self.grid, self.count)

    def create(self) -> None:
        """Write missing or damaged metadata of the arrays; every run writes the same."""
        texts = _descriptions(self.grid, self.count, self.ambiguities, self.levels, self.has_seams)
        for name, text in texts.items():
            if self.folder.read(name) != text:
                self.folder.make(name.rpartition("/")[0])
                self.folder.write(name, text)

    def files_of(self, tile: Tile) -> set[str]:
        """Return the names of a tile's files."""
        return {self._file(name, tile) for name in (*_planes(self.levels), _RIGHT, *self._tables)}

    @property
    def _tables(self) -> tuple[str, ...]:
        """Return the names of the arrays with one chunk a tile."""
        return tuple(_TABLES) if self.has_seams else ("histogram",)

    def _file(self, name: str, tile: Tile) -> str:
        """Return the name of a tile's file of an array."""
        before, after = {"seams": ("", "/0/0/0/0"), "histogram": ("", "/0"), _RIGHT: ("", "")}.get(name, ("/0", ""))
        return f"{name}/c{before}/{tile.grid_row}/{tile.grid_column}{after}"

    def bytes_of(self, tile: Tile) -> int:
        """Return the size of a tile's products before compression."""
        pixel = sum(np.dtype(dtype).itemsize for planes in _planes(self.levels).values() for dtype in planes.values())
        return tile.core.height * (tile.core.width * pixel + self._reach * np.dtype(np.uint32).itemsize)

    def write(self, tile: Tile, arrays: Mapping[str, np.ndarray]) -> Checksums:
        """Write the products of a tile; return the checksums of its files.

        Parameters
        ----------
        tile
            The tile.
        arrays
            ``winner``, ``lower``, ``upper``, ``disparity``, ``ambiguity`` and ``validity`` of the core's shape;
            with two levels ``lower_low`` and ``upper_low``; optionally ``right_cost`` and ``right_winner``; ``seams``
            (SIDES, own line or ring, winner and bounds, size); ``histogram``.
        """
        height = arrays["winner"].shape[0]
        shards = {}
        for dtype, planes in _planes(self.levels).items():
            shards[dtype] = self._pieces(np.stack([arrays[name].view(dtype) for name in planes]), self.grid.size)
        rank = np.full((height, self._reach), _UNSEEN)
        if "right_cost" in arrays:
            rank[:, : arrays["right_cost"].shape[1]] = _rank(arrays["right_cost"], arrays["right_winner"])
        shards[_RIGHT] = self._pieces(rank, self._reach)
        checksums = {}
        for name, pieces in shards.items():
            of_pieces = (number for piece in pieces for number in _checksum(piece))
            checksums[self._file(name, tile)] = [*self._write(self._file(name, tile), b"".join(pieces)), *of_pieces]
        for name in self._tables:
            file = self._file(name, tile)
            checksums[file] = self._write(file, _compressed(arrays[name].astype(_TABLES[name])))
        return checksums

    def _write(self, file: str, content: bytes) -> list[int]:
        try:
            self.folder.write_bytes(file, content)
        except FileNotFoundError:
            self.folder.make(file.rpartition("/")[0])
            self.folder.write_bytes(file, content)
        return _checksum(content)

    def _pieces(self, array: np.ndarray, width: int) -> list[bytes]:
        """Encode an array ``(..., rows, columns)`` as zarr's codec ``sharding_indexed`` does: pieces of rows, index.

        zarr itself takes some ms for each file, which is more than matching a small tile.
        """
        together = _together(self.grid)
        pieces: list[bytes] = []
        index: list[int] = []
        place = 0
        height = array.shape[-2]
        for row in range(0, self.grid.size, together):
            rows = array[..., row : row + together, :]
            more = [(0, 0)] * (array.ndim - 2) + [(0, together - rows.shape[-2]), (0, width - array.shape[-1])]
            is_again = row - together >= height  # rows beyond the image, as in the piece before
            pieces.append(pieces[-1] if is_again else _compressed(np.pad(rows, more)))
            index += [place, len(pieces[-1])]
            place += len(pieces[-1])
        table = struct.pack(f"<{len(index)}Q", *index)
        return [*pieces, table + struct.pack("<I", google_crc32c.value(table))]

    def drop(self, tile: Tile) -> None:
        """Delete the files of a tile."""
        self.folder.delete_all(self.files_of(tile))

    def are_intact(self, checksums: Checksums) -> bool:
        """Return whether files have these checksums."""
        return all(_checksum(self.folder.read_bytes(name) or b"") == list(file[:2]) for name, file in checksums.items())

    def histogram(self, checksums: Checksums) -> np.ndarray:
        """Return the ambiguity histogram of the region, int64 ``(ambiguities + 1,)``; errors as in `strips`."""
        total = np.zeros(self.ambiguities + 1, np.int64)
        for row in range(self.grid.rows):
            total += np.sum(self._row_of_tables("histogram", row, checksums), 0, np.int64)
        return total

    def seams(self, checksums: Checksums) -> np.ndarray:
        """Return the lines along tile borders: int16 (grid rows, grid columns, SIDES, own or ring, products, size).

        Errors as in `strips`.
        """
        shape = len(SIDES), 2, _lines(self.levels), self.grid.size
        rows = [self._row_of_tables("seams", row, checksums) for row in range(self.grid.rows)]
        return np.reshape(rows, (self.grid.rows, self.grid.columns, *shape))

    def strips(
        self, rows: int, checksums: Checksums, first: int = 0, last: int | None = None
    ) -> Iterator[dict[str, np.ndarray]]:
        """Yield raw products of full-width strips of about ``rows`` rows, from the top.

        The right views of the tiles are merged: smallest cost, largest disparity at ties.

        Parameters
        ----------
        rows
            Wanted height, rounded to a multiple of the rows that are compressed together.
        checksums
            Checksums of the files of the tiles; what is read is checked.
        first, last
            The rows ``[first, last)`` of the region, by default all.

        Raises
        ------
        DamagedFileError
            Names the first missing or damaged file.
        """
        step = max(_ROWS_TOGETHER, rows // _ROWS_TOGETHER * _ROWS_TOGETHER)
        last = self.grid.region.height if last is None else last
        for start in range(first // step * step, last, step):
            top, bottom = max(start, first), min(start + step, last)
            strip: dict[str, np.ndarray] = {}
            for dtype, planes in _planes(self.levels).items():
                read = self._rows(dtype, len(planes), top, bottom, checksums)
                strip |= {name: plane.view(of) for (name, of), plane in zip(planes.items(), read, strict=True)}
            yield strip | {"right_winner": self._merged(self._rows(_RIGHT, 1, top, bottom, checksums)[0])}

    def _rows(self, name: str, planes: int, top: int, bottom: int, checksums: Checksums) -> np.ndarray:
        """Read the rows ``[top, bottom)`` of an array with one shard a tile: ``(planes, rows, columns)``.

        The columns are those of the region, or the reaches of all tiles. Planes are contiguous: for any other layout
        kernels would be compiled again.
        """
        size, together = self.grid.size, _together(self.grid)
        dtype, width, columns = np.dtype(np.uint32), self._reach, self.grid.columns * self._reach
        if name != _RIGHT:
            dtype, width, columns = np.dtype(name), size, self.grid.region.width
        found = np.empty((planes, bottom - top, columns), dtype)
        for row in range(top // size, -(-bottom // size)):
            start, stop = max(top - row * size, 0), min(bottom - row * size, size)  # rows of the tile
            pieces = range(start // together, -(-stop // together))
            inside = slice(start - pieces.start * together, stop - pieces.start * together)
            target = found[:, row * size + start - top : row * size + stop - top]
            for column, read in enumerate(self._read(name, row, pieces, dtype, checksums)):
                rows = np.concatenate([piece.reshape(planes, together, width) for piece in read], axis=1)
                here = target[:, :, column * width : (column + 1) * width]
                here[...] = rows[:, inside, : here.shape[2]]
        return found

    def _row_of_tables(self, name: str, row: int, checksums: Checksums) -> np.ndarray:
        """Read the chunks of a row of tiles in an array with one chunk a tile, each as one line."""
        return np.stack([chunk for (chunk,) in self._read(name, row, range(1), np.dtype(_TABLES[name]), checksums)])

    def _read(
        self, name: str, row: int, pieces: range, dtype: np.dtype[Any], checksums: Checksums
    ) -> Iterator[list[np.ndarray]]:
        """Read some pieces of the files of a row of tiles, and check them; yield those of each tile, all flat."""
        files = [self._file(name, self.grid.tile(row, column)) for column in range(self.grid.columns)]
        expected, parts = [], []
        for file in files:
            if file not in checksums:
                raise DamagedFileError(file)
            numbers = checksums[file][2:] or checksums[file]  # a file without pieces is one itself
            ends = list(accumulate(numbers[::2], initial=0))
            chosen = slice(2 * pieces.start, 2 * pieces.stop)
            expected.append(list(zip(numbers[chosen][::2], numbers[chosen][1::2], strict=True)))
            parts.append((file, ends[pieces.start], ends[pieces.stop]))
        for file, content, sums in zip(files, self.folder.read_parts(parts), expected, strict=True):
            view, found = memoryview(content or b""), []
            for size, crc in sums:
                if _checksum(view[:size]) != [size, crc]:
                    raise DamagedFileError(file)
                found.append(np.frombuffer(blosc.decompress(view[:size]), dtype))
                view = view[size:]
            yield found

    def _merged(self, ranks: np.ndarray) -> np.ndarray:
        """Merge the right views of a row of cores into one, ``(rows, width + count - 1)``."""
        best = np.full((ranks.shape[0], self.grid.region.width + self.count - 1), _UNSEEN)
        for column in range(self.grid.columns):
            seen = best[:, column * self.grid.size : column * self.grid.size + self._reach]
            share = ranks[:, column * self._reach : column * self._reach + seen.shape[1]]
            np.minimum(seen, share, out=seen)
        return _winner(best)


def _planes(levels: int) -> dict[str, dict[str, type[np.generic]]]:
    bounds = dict(list(_SUBPIXEL.items())[: 2 * levels])
    return {"int16": {**_WORDS, **bounds}, "uint32": _LONG_WORDS}


def _descriptions(grid: Grid, count: int, ambiguities: int, levels: int, has_seams: bool) -> dict[str, str]:
    """Return the metadata of the group and arrays as texts by file name."""
    texts: dict[str, Any] = {}
    group = zarr.create_group(MemoryStore(texts), zarr_format=3)

    def describe(
        name: str,
        shape: tuple[int, ...],
        shard: tuple[int, ...] | None,
        chunk: tuple[int, ...],
        dtype: npt.DTypeLike,
        fill: Any = 0,
    ) -> None:
        group.create_array(
            name, shape=shape, shards=shard, chunks=chunk, dtype=dtype, compressors=_COMPRESSOR, fill_value=fill
        )

    size, height, width = grid.size, grid.rows * grid.size, grid.columns * grid.size
    together, reach = _together(grid), _reach(grid, count)
    for dtype, planes in _planes(levels).items():
        planes_together = len(planes)
        describe(
            dtype,
            (planes_together, height, width),
            (planes_together, size, size),
            (planes_together, together, size),
            dtype,
        )
    describe(_RIGHT, (height, grid.columns * reach), (size, reach), (together, reach), np.uint32, _UNSEEN)
    lines = len(SIDES), 2, _lines(levels), size
    counts = ambiguities + 1
    if has_seams:
        describe("seams", (grid.rows, grid.columns, *lines), None, (1, 1, *lines), _TABLES["seams"], NO_DISPARITY)
    describe("histogram", (grid.rows, grid.columns, counts), None, (1, 1, counts), _TABLES["histogram"])
    return {name: text.to_bytes().decode() for name, text in texts.items()}


def _together(grid: Grid) -> int:
    """Return the number of rows of a shard that are compressed together."""
    return math.gcd(grid.size, _ROWS_TOGETHER)


def _lines(levels: int) -> int:
    """Return the number of products along the borders of tiles: winner and bounds."""
    return 5 if levels == 2 else 3


def _reach(grid: Grid, count: int) -> int:
    """Return the number of columns of a core's right view."""
    return grid.size + count - 1


def _compressed(chunk: np.ndarray) -> bytes:
    """Compress a chunk as ``_COMPRESSOR`` does."""
    chunk = np.ascontiguousarray(chunk)
    return bytes(blosc.compress(chunk, b"lz4", 1, blosc.SHUFFLE, 0, chunk.itemsize))


def _checksum(content: bytes | memoryview) -> list[int]:
    """Return size in bytes and CRC-32C of a file: processors have an instruction for it (26 GB/s, zlib's CRC-32 4)."""
    return [len(content), google_crc32c.value(bytes(content))]


def _rank(cost: np.ndarray, winner: np.ndarray) -> np.ndarray:
    """Combine cost and winner of right pixels in one number, smallest for the best: cost, then larger disparity."""
    rank = cost.astype(np.uint32) << 16 | (np.iinfo(np.int16).max - winner.astype(np.int32)).astype(np.uint32)
    return np.where(cost == IMPOSSIBLE_COST, _UNSEEN, rank)


def _winner(rank: np.ndarray) -> np.ndarray:
    """Return the winners of ranks, see `_rank`."""
    winner = (np.iinfo(np.int16).max - (rank & 0xFFFF).astype(np.int32)).astype(np.int16)
    return np.where(rank == _UNSEEN, np.int16(NO_DISPARITY), winner)
