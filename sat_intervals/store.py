"""What tiles leave behind until the run is finished: arrays, records, a manifest. The only home of zarr.

A tile's arrays lie in one shard each, written by whoever computed the tile, and its record comes last: a tile is done
when its record is there. Writing a tile again writes the same bytes. The manifest holds everything that decides the
bytes; a store with another manifest is never mixed in.
"""

import errno
import fcntl
import json
import math
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import zarr
from zarr.codecs import BloscCodec

from sat_intervals.errors import SatIntervalsError
from sat_intervals.products import IMPOSSIBLE_COST, NO_DISPARITY
from sat_intervals.tiling import Grid, Tile, Window

# Raw products of the pixels of a core.
PIXEL_ARRAYS = {
    "winner": np.int16,
    "lower": np.int16,
    "upper": np.int16,
    "disparity": np.float32,
    "ambiguity": np.uint32,
    "validity": np.uint16,
}
SIDES = ("top", "bottom", "left", "right")
# The raw products that neighbours compare along a seam.
SEAM_PRODUCTS = ("winner", "lower", "upper")

_MANIFEST, _LOCK, _RECORDS, _FAILURES = "manifest.json", ".lock", "records", "failures"
_NORMALIZATION = "normalization.json"

# Rows of a shard that are compressed together, so that strips read no more than they need.
_ROWS_TOGETHER = 128
_COMPRESSOR = BloscCodec(cname="lz4", clevel=1, shuffle="shuffle")


class StoreError(SatIntervalsError):
    """A store that belongs to another run, or cannot be written."""


@dataclass(frozen=True)
class Store:
    """The tiles of one run under a folder; picklable, so that every worker writes for itself.

    Attributes
    ----------
    path
        The folder.
    grid
        The tiles.
    count
        Number of disparities of the search range.
    ambiguities
        Largest ambiguity a pixel can have.
    """

    path: Path
    grid: Grid
    count: int
    ambiguities: int

    @property
    def _reach(self) -> int:
        """Columns of the right view that a core sees."""
        return self.grid.size + self.count - 1

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep every other run out of the folder, until the block ends or this process dies.

        Raises
        ------
        StoreError
            When another run is at work there.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        with (self.path / _LOCK).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise StoreError(
                    f"another run is at work in {self.path.parent}: wait for its end or choose another folder"
                ) from error
            yield

    def open(
        self, manifest: Mapping[str, Any], *, overwrite: bool = False, is_mended: Callable[[], bool] = lambda: False
    ) -> None:
        """Create the store, or go on with the one that is there; to be called while it is `locked`.

        Parameters
        ----------
        manifest
            All that decides the bytes of a tile; ``region`` and ``settings`` tell the tiles.
        overwrite
            Whether what is there is dropped.
        is_mended
            Asked where tiles failed and nothing but the content of the inputs changed since: whether what is done would
            be the same with these inputs. If so, the run goes on with them.

        Raises
        ------
        StoreError
            When the store that is there was begun with other settings, inputs or versions.
        """
        file = self.path / _MANIFEST
        wanted = json.loads(json.dumps(manifest))
        if file.exists() and not overwrite:
            try:
                there = json.loads(file.read_text())
            except ValueError as error:
                raise StoreError(f"{file} cannot be read, {error}: --overwrite starts afresh") from error
            changed = list(_differences(there, wanted))
            mendable = bool(self.failures()) and _without_content(there) == _without_content(wanted)
            if changed and mendable and is_mended():
                _write_whole(file, json.dumps(manifest, indent=1))
            elif changed:
                raise StoreError(
                    f"{self.path} holds the tiles of another run: {'; '.join(changed)} "
                    "(use the same settings and inputs to go on, --overwrite to start afresh)"
                )
            return
        file.unlink(missing_ok=True)  # first: without it nothing of the rest counts
        (self.path / _NORMALIZATION).unlink(missing_ok=True)
        for folder in (self._arrays, self.path / _RECORDS, self.path / _FAILURES):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        self._create_arrays()
        _write_whole(file, json.dumps(manifest, indent=1))

    def _create_arrays(self) -> None:
        size, height = self.grid.size, self.grid.rows * self.grid.size
        width = self.grid.columns * size
        together = math.gcd(size, _ROWS_TOGETHER)
        group = zarr.create_group(self._arrays)
        for name, dtype in PIXEL_ARRAYS.items():
            _create(group, name, (height, width), (size, size), (together, size), dtype)
        right = height, self.grid.columns * self._reach
        shard = size, self._reach
        _create(group, "right_cost", right, shard, (together, self._reach), np.uint16)
        _create(group, "right_winner", right, shard, (together, self._reach), np.int16)
        lines = len(SIDES), 2, len(SEAM_PRODUCTS), size
        _create(group, "seams", (self.grid.rows, self.grid.columns, *lines), None, (1, 1, *lines), np.int16)
        counts = self.ambiguities + 1
        _create(group, "histogram", (self.grid.rows, self.grid.columns, counts), None, (1, 1, counts), np.uint32)

    @property
    def _arrays(self) -> Path:
        return self.path / "arrays.zarr"

    def _array(self, name: str, mode: Literal["r", "r+"] = "r") -> zarr.Array[Any]:
        return zarr.open_array(self._arrays / name, mode=mode)

    def _record_file(self, tile: Tile) -> Path:
        return self.path / _RECORDS / f"{tile.name}.json"

    def is_done(self, tile: Tile) -> bool:
        """Whether the tile is complete."""
        return self._record_file(tile).exists()

    def write_arrays(self, tile: Tile, arrays: Mapping[str, np.ndarray]) -> None:
        """Write what a tile leaves behind.

        Parameters
        ----------
        tile
            Which tile.
        arrays
            Those of PIXEL_ARRAYS, of the core's shape; ``right_cost`` and ``right_winner``, which may be missing;
            ``seams`` (SIDES, own line or ring, SEAM_PRODUCTS, size); ``histogram``.
        """
        row = tile.grid_row * self.grid.size
        for name, array in arrays.items():
            target = self._array(name, "r+")
            if name in ("seams", "histogram"):
                target[tile.grid_row, tile.grid_column] = array
            else:
                column = tile.grid_column * (self.grid.size if name in PIXEL_ARRAYS else self._reach)
                target[row : row + array.shape[0], column : column + array.shape[1]] = array

    def write_record(self, tile: Tile, record: Mapping[str, Any]) -> None:
        """Write what the run wants to know of a tile, as JSON; from now on the tile is done."""
        _write_whole(self._record_file(tile), json.dumps(record))

    def write_normalization(self, normalization: Mapping[str, Any]) -> None:
        """Keep what was measured of the whole images, so that all tiles of the run agree on it, whenever matched."""
        _write_whole(self.path / _NORMALIZATION, json.dumps(normalization))

    def normalization(self) -> dict[str, Any] | None:
        """What `write_normalization` kept; None where nothing was measured."""
        file = self.path / _NORMALIZATION
        return json.loads(file.read_text()) if file.exists() else None

    def write_failure(self, tile: str, reason: str) -> None:
        """Remember why a tile failed, for whoever asks for the status; a record that comes later outweighs it."""
        with suppress(OSError):  # a full disk is reason enough for a tile to fail, but not for the run to end at once
            _write_whole(self.path / _FAILURES / f"{tile}.json", json.dumps(reason))

    def failures(self) -> dict[str, str]:
        """Why tiles failed that are not done since, by name."""
        files = sorted((self.path / _FAILURES).glob("[0-9]*.json"))
        return {
            file.stem: json.loads(file.read_text()) for file in files if not (self.path / _RECORDS / file.name).exists()
        }

    def check_space(self, tile: Tile) -> None:
        """Raise an OSError where the disk has no room for what a tile leaves behind, before work is put in."""
        pixel = sum(np.dtype(dtype).itemsize for dtype in PIXEL_ARRAYS.values())
        needed = tile.core.height * (tile.core.width * pixel + (tile.core.width + self.count - 1) * 4)
        if shutil.disk_usage(self.path).free < needed:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))

    def records(self) -> dict[str, dict[str, Any]]:
        """The records of the tiles that are done, by name."""
        files = ((tile.name, self._record_file(tile)) for tile in self.grid)
        return {name: json.loads(file.read_text()) for name, file in files if file.exists()}

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
        """
        arrays = {name: self._array(name) for name in (*PIXEL_ARRAYS, "right_cost", "right_winner")}
        width = self.grid.region.width
        step = max(_ROWS_TOGETHER, rows // _ROWS_TOGETHER * _ROWS_TOGETHER)
        for first in range(0, self.grid.region.height, step):
            last = min(first + step, self.grid.region.height)
            strip = {name: np.asarray(arrays[name][first:last, :width]) for name in PIXEL_ARRAYS}
            cost, winner = (np.asarray(arrays[name][first:last]) for name in ("right_cost", "right_winner"))
            yield strip | {"right_winner": self._merged(cost, winner)}

    def _merged(self, cost: np.ndarray, winner: np.ndarray) -> np.ndarray:
        """One right view ``(rows, width + count - 1)`` from the shares of all cores of the rows."""
        columns = self.grid.region.width + self.count - 1
        best = np.full((cost.shape[0], columns), IMPOSSIBLE_COST, np.uint16)
        merged = np.full(best.shape, NO_DISPARITY, np.int16)
        for grid_column in range(self.grid.columns):
            start, share = grid_column * self.grid.size, grid_column * self._reach
            width = min(self._reach, columns - start)
            here, there = np.s_[:, start : start + width], np.s_[:, share : share + width]
            wins = (cost[there] < best[here]) | ((cost[there] == best[here]) & (winner[there] > merged[here]))
            best[here] = np.where(wins, cost[there], best[here])
            merged[here] = np.where(wins, winner[there], merged[here])
        return merged

    def remove(self) -> None:
        """Delete the store, and nothing else that may be in its folder."""
        (self.path / _MANIFEST).unlink(missing_ok=True)  # first: without it nothing of the rest counts
        for folder in (self._arrays, self.path / _RECORDS, self.path / _FAILURES):
            shutil.rmtree(folder, ignore_errors=True)
        for name in (_NORMALIZATION, _LOCK):
            (self.path / name).unlink(missing_ok=True)
        with suppress(OSError):
            self.path.rmdir()


@dataclass(frozen=True)
class Status:
    """How far the tiles of a run are.

    Attributes
    ----------
    total, done
        Numbers of tiles.
    failed
        Why tiles failed that are not done since, by name.
    running
        Whether a run is at work on them.
    """

    total: int
    done: int
    failed: dict[str, str]
    running: bool


def read_status(path: Path) -> Status:
    """How far a run is, from its store alone.

    Raises
    ------
    StoreError
        Where there is no store.
    """
    if not (path / _MANIFEST).exists():
        raise StoreError(f"{path.parent} holds no run that began: name the folder given to match")
    manifest = json.loads((path / _MANIFEST).read_text())
    grid = Grid(Window(**manifest["region"]), manifest["settings"]["tiles"]["size"])
    done = {file.stem for file in (path / _RECORDS).glob("[0-9]*.json")}
    store = Store(path, grid, 1, 0)
    try:
        with store.locked():
            running = False
    except StoreError:
        running = True
    return Status(len(grid), len(done), store.failures(), running)


def _create(
    group: zarr.Group,
    name: str,
    shape: tuple[int, ...],
    shard: tuple[int, ...] | None,
    chunk: tuple[int, ...],
    dtype: npt.DTypeLike,
) -> None:
    fill = {"right_cost": IMPOSSIBLE_COST, "disparity": np.nan, "validity": 0, "ambiguity": 0, "histogram": 0}
    group.create_array(
        name, shape=shape, shards=shard, chunks=chunk, dtype=dtype,
        compressors=_COMPRESSOR, fill_value=fill.get(name, NO_DISPARITY),
    )  # fmt: skip


def _write_whole(file: Path, text: str) -> None:
    """Write a file that is either there as a whole or not at all."""
    temporary = file.with_name(f".{file.name}.{uuid.uuid4().hex}")
    try:
        temporary.write_text(text)
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def _differences(there: Any, wanted: Any, path: str = "") -> Iterator[str]:
    """The values in which two manifests differ, each with its path."""
    if isinstance(there, dict) and isinstance(wanted, dict):
        for key in sorted(there.keys() | wanted.keys()):
            yield from _differences(there.get(key), wanted.get(key), f"{path}.{key}".lstrip("."))
    elif isinstance(there, list) and isinstance(wanted, list) and len(there) == len(wanted):
        for place, pair in enumerate(zip(there, wanted, strict=True)):
            yield from _differences(*pair, f"{path}.{place}")
    elif there != wanted and not path.endswith(".modified"):  # when does not matter where SHA-256 agrees
        yield f"{path} was {json.dumps(there)}, now {json.dumps(wanted)}"


def _without_content(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """A manifest without what tells the content of its inputs."""

    def without(there: Any) -> Any:
        if isinstance(there, list):
            return [without(value) for value in there]
        if not isinstance(there, dict):
            return there
        return {key: without(value) for key, value in there.items() if key not in ("bytes", "modified", "sha256")}

    return {**manifest, "inputs": without(manifest["inputs"])}
