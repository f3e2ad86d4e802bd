"""What tiles leave behind until the run is finished: arrays, records, a manifest.

A tile's arrays lie in files of its own, written by whoever computed the tile, and its record comes last: a tile is done
when its record and its files are there. Writing a tile again writes the same bytes. The manifest holds everything that
decides the bytes; a store with another manifest is never mixed in. Runs with the same manifest may share a store that
lies elsewhere than in the folder of one of them: they write the same bytes.
"""

import errno
import json
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import RunError
from sat_intervals.store.folder import Folder, folder_at
from sat_intervals.store.manifest import MANIFEST, StoreError, check_same, parsed
from sat_intervals.store.place import PLACE, ElsewhereError, is_own, place_of
from sat_intervals.store.zarr_arrays import DamagedTilesError, TileArrays
from sat_intervals.tiling import Grid, Tile, Window

# To be counted up when arrays or records change: tiles of before cannot be gone on with.
LAYOUT = 4

_ARRAYS, _RECORDS, _FAILURES = "arrays.zarr", "records", "failures"
_NORMALIZATION = "normalization.json"
# In the folder of the run from the beginning of one that replaces another to its end.
_REPLACING = "replacing"

_LOG = logging.getLogger(__name__)


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
        Folder, in the store that the user names, where the tiles lie; by default ``home``.
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
            Whether what is there is dropped, and the files of a run before are to be replaced. Tiles in a store that
            the user does not name stay.

        Raises
        ------
        StoreError
            When the store that is there was begun with other settings, inputs or versions, or lies in another place, or
            cannot be used.
        """
        home, folder = folder_at(self.home), self.folder
        try:
            before = self._place_before(overwrite)
            text = None if overwrite or before is None else before.read(MANIFEST)
            if before is not None and text is not None:
                check_same(text, before, manifest)
                if before != folder:
                    raise StoreError(
                        f"the tiles of the run in {self.home.parent} lie in {before}, not in {folder}: give the same "
                        "--store to go on, or none where there was none, --overwrite to start afresh"
                    )
            folder.make("")  # so that what cannot be used is told before anything is dropped
            if overwrite and before is not None:
                with suppress(OSError):  # what cannot be reached stays
                    if before == home or is_own(before):
                        _drop(before)
            if overwrite or (text is None and not self.elsewhere):
                _drop(folder)
            for name in ("", _RECORDS, _FAILURES):
                folder.make(name)
            home.make("")
            if overwrite:
                home.write(_REPLACING, "")
            if self.elsewhere:
                home.write(PLACE, json.dumps(str(folder)))
            else:
                home.delete(PLACE)
            self._arrays.create()
            if not folder.create(MANIFEST, json.dumps(manifest, indent=1)):
                self.check(manifest)
        except OSError as error:
            raise StoreError(
                f"{folder} cannot be used: {error.strerror or error}: check the path or URL, the credentials, and that "
                "the package of its file system is installed (sat-intervals[remote] for s3://)"
            ) from error

    def _place_before(self, overwrite: bool) -> Folder | None:
        """Where the tiles of the run before are; with ``overwrite`` None where that is not to be touched."""
        try:
            return place_of(self.home, self.elsewhere and self.elsewhere.rpartition("/")[0])
        except StoreError as error:
            if not overwrite:
                raise
            if isinstance(error, ElsewhereError):
                _LOG.warning("%s: they stay there", error.said)
            return None

    def check(self, manifest: Mapping[str, Any]) -> None:
        """Hold that the store is that of a run still: others may have removed it, or begun another in its place.

        Raises
        ------
        RunError
            When it is gone.
        StoreError
            When it is another's.
        """
        there = self.folder.read(MANIFEST)
        if there is None:
            raise RunError(
                f"the tiles in {self.folder} are gone, as where another run of the same images and settings ended: "
                "run the same command again, it matches them anew"
            )
        check_same(there, self.folder, manifest)

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
            if self.folder.read(MANIFEST) is None:  # it was removed meanwhile, and what came later would stay for ever
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
            if self.folder.read(MANIFEST) is not None:  # else a bucket would keep it for ever
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
        remove_tiles(self.home, self.folder)


def remove_tiles(home: Path, place: Folder) -> None:
    """Delete the tiles in ``place`` of the run to whose folder ``home`` belongs."""
    _drop(place)
    for name in (PLACE, _REPLACING):
        folder_at(home).delete(name)


def mark_replaced(home: Path) -> None:
    """Note that the files of the run before have been replaced, see `is_replacing`."""
    folder_at(home).delete(_REPLACING)


def is_replacing(home: Path) -> bool:
    """Whether a run has begun that is to replace the files of one before, and has not done so yet."""
    return folder_at(home).read(_REPLACING) is not None


def inputs_before(home: Path, store: str | None) -> dict[str, Any]:
    """What the manifest of the tiles that are there says of the inputs; nothing where it cannot be read."""
    try:
        return dict(json.loads(place_of(home, store).read(MANIFEST) or "{}").get("inputs", {}))
    except (OSError, AttributeError, TypeError, ValueError):
        return {}


def store_of(home: Path, store: str | None = None) -> Store:
    """The store of the run to whose folder ``home`` belongs, to be looked at: how far it is.

    ``store`` is the one that the user names, see `place_of`.

    Raises
    ------
    StoreError
        Where there is none.
    """
    folder = place_of(home, store)
    text = folder.read(MANIFEST)
    if text is None:
        raise StoreError(f"{home.parent} holds no run that began: name the folder given to match")
    manifest = parsed(text, folder)
    try:
        grid = Grid(Window(**manifest["region"]), manifest["settings"]["tiles"]["size"])
    except (LookupError, TypeError) as error:
        raise StoreError(f"{folder}/{MANIFEST} is no manifest of a run: --overwrite starts afresh") from error
    return Store(home, grid, 1, 0, str(folder))


def _drop(folder: Folder) -> None:
    """Delete the tiles in a folder, and the folder where nothing else is in it."""
    # The manifest first: without it nothing of the rest counts.
    for name in (MANIFEST, _ARRAYS, _RECORDS, _FAILURES, _NORMALIZATION):
        folder.delete(name)
    folder.delete_if_empty()
