"""What tiles leave behind until the run is finished: arrays, records, a manifest.

A tile's arrays lie in files of its own, written by whoever computed the tile, and its record comes last: a tile is done
when its record and its files are there. Writing a tile again writes the same bytes. The manifest holds everything that
decides the bytes; a store with another manifest is never mixed in. Runs with the same manifest may share a store that
lies elsewhere than in the folder of one of them: they write the same bytes.
"""

import errno
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.store.folder import Folder, LocalFolder, folder_at
from sat_intervals.store.zarr_arrays import DamagedTilesError, TileArrays
from sat_intervals.tiling import Grid, Tile, Window

# To be counted up when arrays or records change: tiles of before cannot be gone on with.
LAYOUT = 4

_MANIFEST, _ARRAYS, _RECORDS, _FAILURES = "manifest.json", "arrays.zarr", "records", "failures"
_NORMALIZATION = "normalization.json"
# In the folder of the run where its tiles lie elsewhere: it says where.
_PLACE = "store.json"
# In the folder of the run from the beginning of one that replaces another to its end.
_REPLACING = "replacing"


class StoreError(SatIntervalsError):
    """A store that belongs to another run, or cannot be written."""


@dataclass(frozen=True)
class Store:
    """The tiles of one run; picklable, so that every worker writes for itself.

    Attributes
    ----------
    home
        Folder of the run that the tiles belong to.
    grid
        The tiles.
    count
        Number of disparities of the search range.
    ambiguities
        Largest ambiguity a pixel can have.
    elsewhere
        Folder or fsspec URL where the tiles lie; by default ``home``.
    """

    home: Path
    grid: Grid
    count: int
    ambiguities: int
    elsewhere: str | None = None

    @property
    def folder(self) -> Folder:
        """Where the tiles lie."""
        return folder_at(self.elsewhere or self.home)

    @property
    def _arrays(self) -> TileArrays:
        return TileArrays(self.folder.inside(_ARRAYS), self.grid, self.count, self.ambiguities)

    def open(self, manifest: Mapping[str, Any], *, overwrite: bool = False) -> None:
        """Create the store, or go on with the one that is there; to be called while ``home`` is locked.

        Parameters
        ----------
        manifest
            All that decides the bytes of a tile; ``region`` and ``settings`` tell the tiles.
        overwrite
            Whether what is there is dropped, wherever it lies, and the files of a run before are to be replaced.

        Raises
        ------
        StoreError
            When the store that is there was begun with other settings, inputs or versions, or lies in another place, or
            cannot be used.
        """
        home, folder, before = folder_at(self.home), self.folder, _place(self.home)
        try:
            text = None if overwrite else before.read(_MANIFEST)
            if text is not None:
                _check_same(text, before, manifest)
                if before != folder:
                    raise StoreError(
                        f"the tiles of the run in {self.home.parent} lie in {before}, not in {folder}: give the same "
                        "--store to go on, or none where there was none, --overwrite to start afresh"
                    )
            folder.make("")  # so that what cannot be used is told before anything is dropped
            if overwrite:
                with suppress(OSError):  # what cannot be reached stays
                    _drop(before)
            if overwrite or (text is None and not self.elsewhere):
                _drop(folder)
            for name in ("", _RECORDS, _FAILURES):
                folder.make(name)
            home.make("")
            if overwrite:
                home.write(_REPLACING, "")
            if self.elsewhere:
                home.write(_PLACE, json.dumps(str(folder)))
            else:
                home.delete(_PLACE)
            self._arrays.create()
            if not folder.create(_MANIFEST, json.dumps(manifest, indent=1)):
                self.check(manifest)
        except OSError as error:
            raise StoreError(
                f"{folder} cannot be used: {error.strerror or error}: check the path or URL, the credentials, and that "
                "the package of its file system is installed (sat-intervals[remote] for s3://)"
            ) from error

    def check(self, manifest: Mapping[str, Any]) -> None:
        """Hold that the store is that of a run still: others may have removed it, or begun another in its place.

        Raises
        ------
        RunError
            When it is gone.
        StoreError
            When it is another's.
        """
        there = self.folder.read(_MANIFEST)
        if there is None:
            raise RunError(
                f"the tiles in {self.folder} are gone, as where another run of the same images and settings ended: "
                "run the same command again, it matches them anew"
            )
        _check_same(there, self.folder, manifest)

    @contextmanager
    def needed(self, manifest: Mapping[str, Any]) -> Iterator[None]:
        """A block that fails because the store is gone fails with just that, see `check`."""
        try:
            yield
        except Exception:
            with suppress(OSError):
                self.check(manifest)
            raise

    def done(self) -> set[str]:
        """Names of the tiles that are complete: their record is there, and all that was written before it still is."""
        records, arrays = self.folder.names(_RECORDS), self._arrays
        there = arrays.files()
        return {tile.name for tile in self.grid if tile.name in records and arrays.files_of(tile) <= there}

    def write_arrays(self, tile: Tile, arrays: Mapping[str, np.ndarray], manifest: Mapping[str, Any]) -> None:
        """Write what a tile leaves behind, see `TileArrays.write`, into the store of a manifest and no other."""
        self.check(manifest)
        try:
            self._arrays.write(tile, arrays)
            self.check(manifest)
        except Exception:
            if self.folder.read(_MANIFEST) is None:  # it was removed meanwhile, and what came later would stay for ever
                _drop(self.folder)
            raise

    def write_record(self, tile: Tile, record: Mapping[str, Any]) -> None:
        """Write what the run wants to know of a tile, as JSON; from now on the tile is done."""
        self.folder.write(f"{_RECORDS}/{tile.name}.json", json.dumps(record))

    def write_normalization(self, normalization: Mapping[str, Any]) -> None:
        """Keep what was measured of the whole images, so that all tiles of the run agree on it, whenever matched."""
        self.folder.write(_NORMALIZATION, json.dumps(normalization))

    def normalization(self) -> dict[str, Any] | None:
        """What `write_normalization` kept; None where nothing was measured."""
        kept = self.folder.read(_NORMALIZATION)
        return None if kept is None else dict(json.loads(kept))

    def write_failure(self, tile: str, reason: str) -> None:
        """Remember why a tile failed, for whoever asks for the status; a record that comes later outweighs it."""
        with suppress(OSError):  # a full disk is reason enough for a tile to fail, but not for the run to end at once
            if self.folder.read(_MANIFEST) is not None:  # else a bucket would keep it for ever
                self.folder.write(f"{_FAILURES}/{tile}.json", json.dumps(reason))

    def failures(self) -> dict[str, str]:
        """Why tiles failed that are not done since, by name."""
        reasons, done = self.folder.read_all(_FAILURES), self.done()
        return {name: json.loads(reasons[name]) for name in sorted(reasons) if name not in done}

    def check_space(self, tile: Tile) -> None:
        """Raise an OSError where the disk has no room for what a tile leaves behind, before work is put in."""
        needed = self._arrays.bytes_of(tile)
        free = self.folder.free_bytes()
        if free is not None and free < needed:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.folder))

    def records(self) -> dict[str, dict[str, Any]]:
        """The records of the tiles that are done, by name; those that a power loss left unreadable are deleted."""
        texts, found = self.folder.read_all(_RECORDS), {}
        for tile in self.grid:
            try:
                if tile.name in texts:
                    found[tile.name] = dict(json.loads(texts[tile.name]))
            except (ValueError, TypeError):
                self.folder.delete(f"{_RECORDS}/{tile.name}.json")
        return found

    def histogram(self) -> np.ndarray:
        """Ambiguities of the whole region: int64 ``(ambiguities + 1,)``."""
        return self._arrays.histogram()

    def seams(self) -> np.ndarray:
        """The lines along the tiles' borders, see `TileArrays.seams`."""
        return self._arrays.seams()

    def strips(self, rows: int) -> Iterator[dict[str, np.ndarray]]:
        """Raw products of the region in full-width strips of about ``rows`` rows, from the top.

        Raises
        ------
        RunError
            Of tiles whose files cannot be read; they are no longer done.
        """
        try:
            yield from self._arrays.strips(rows)
        except DamagedTilesError as error:
            for tile in error.tiles:
                self.folder.delete(f"{_RECORDS}/{tile.name}.json")
                self._arrays.drop(tile)
            names = ", ".join(tile.name for tile in error.tiles)
            raise RunError(
                f"tiles {names} in {self.folder} cannot be read, {error}: the same command matches them again"
            ) from error

    def remove(self) -> None:
        """Delete the tiles, and nothing else that may be in their folder."""
        remove_tiles(self.home)


def remove_tiles(home: Path) -> None:
    """Delete the tiles of the run to whose folder ``home`` belongs, wherever they lie."""
    _drop(_place(home))
    for name in (_PLACE, _REPLACING):
        folder_at(home).delete(name)


def mark_replaced(home: Path) -> None:
    """Note that the files of the run before have been replaced, see `is_replacing`."""
    folder_at(home).delete(_REPLACING)


def is_replacing(home: Path) -> bool:
    """Whether a run has begun that is to replace the files of one before, and has not done so yet."""
    return folder_at(home).read(_REPLACING) is not None


def inputs_before(home: Path) -> dict[str, Any]:
    """What the manifest of the tiles that are there says of the inputs; nothing where it cannot be read."""
    try:
        return dict(json.loads(_place(home).read(_MANIFEST) or "{}").get("inputs", {}))
    except (OSError, AttributeError, TypeError, ValueError):
        return {}


def _place(home: Path) -> Folder:
    """Where the tiles lie of the run to whose folder ``home`` belongs."""
    noted = folder_at(home).read(_PLACE)
    return folder_at(json.loads(noted) if noted else home)


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


def read_status(home: Path) -> Status:
    """How far a run is, from its store alone.

    Parameters
    ----------
    home
        Folder of the tiles in that of the run, wherever they lie.

    Raises
    ------
    StoreError
        Where there is no store.
    """
    folder = _place(home)
    text = folder.read(_MANIFEST)
    if text is None:
        raise StoreError(f"{home.parent} holds no run that began: name the folder given to match")
    manifest = _parsed(text, folder)
    try:
        grid = Grid(Window(**manifest["region"]), manifest["settings"]["tiles"]["size"])
    except (LookupError, TypeError) as error:
        raise StoreError(f"{folder}/{_MANIFEST} is no manifest of a run: --overwrite starts afresh") from error
    store = Store(home, grid, 1, 0, str(folder))
    return Status(len(grid), len(store.done()), store.failures(), LocalFolder(home).is_locked())


def _parsed(manifest: str, folder: Folder) -> dict[str, Any]:
    try:
        return dict(json.loads(manifest))
    except (ValueError, TypeError) as error:
        raise StoreError(f"{folder}/{_MANIFEST} cannot be read, {error}: --overwrite starts afresh") from error


def _check_same(there: str, folder: Folder, manifest: Mapping[str, Any]) -> None:
    """Hold that the manifest in a folder is that of the run."""
    if changed := list(differences(_parsed(there, folder), json.loads(json.dumps(manifest)))):
        raise StoreError(
            f"{folder} holds the tiles of another run: {'; '.join(changed)} "
            "(use the same settings and inputs to go on, --overwrite to start afresh)"
        )


def _drop(folder: Folder) -> None:
    """Delete the tiles in a folder, and the folder where nothing else is in it."""
    # The manifest first: without it nothing of the rest counts.
    for name in (_MANIFEST, _ARRAYS, _RECORDS, _FAILURES, _NORMALIZATION):
        folder.delete(name)
    folder.delete_if_empty()


def digest(manifest: Mapping[str, Any]) -> str:
    """A name of 32 digits that only manifests share in which `differences` finds none."""

    def without_times(there: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in there.items() if key != "modified"}

    same = json.dumps(json.loads(json.dumps(manifest), object_hook=without_times), sort_keys=True)
    return hashlib.sha256(same.encode()).hexdigest()[:32]


def differences(there: Any, wanted: Any, path: str = "") -> Iterator[str]:
    """The values in which two manifests differ, each with its path; when a file was changed does not count."""
    if isinstance(there, dict) and isinstance(wanted, dict):
        for key in sorted(there.keys() | wanted.keys()):
            yield from differences(there.get(key), wanted.get(key), f"{path}.{key}".lstrip("."))
    elif isinstance(there, list) and isinstance(wanted, list) and len(there) == len(wanted):
        for place, pair in enumerate(zip(there, wanted, strict=True)):
            yield from differences(*pair, f"{path}.{place}")
    elif there != wanted and not path.endswith(".modified"):  # when does not matter where SHA-256 agrees
        yield f"{path} was {json.dumps(there)}, now {json.dumps(wanted)}"
