"""What tiles leave behind until the run is finished: arrays, records, a manifest.

A tile's arrays lie in files of its own, written by whoever computed the tile. Its record comes last and holds sizes and
checksums of these files: a tile is done when its record is whole and its files have their sizes. Checksums are compared
where files are read, and a tile with a damaged file is no longer done. Writing a tile again writes the same bytes. The
manifest holds everything that decides the bytes; a store with another manifest is never mixed in. Runs with the same
manifest may share a store that lies elsewhere than in the folder of one of them: they write the same bytes.
"""

import errno
import json
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import RunError
from sat_intervals.store.folder import Folder, folder_at
from sat_intervals.store.manifest import MANIFEST, StoreError, check_same, grid_of, parsed, sealed, unsealed
from sat_intervals.store.place import PLACE, ElsewhereError, is_own, place_of
from sat_intervals.store.removal import ARRAYS, FAILURES, NORMALIZATION, RECORDS, check_free, drop, is_of_run
from sat_intervals.store.zarr_arrays import Checksums, DamagedFileError, TileArrays
from sat_intervals.tiling import Grid, Tile

Records = Mapping[str, Mapping[str, Any]]
"""Records of tiles, by name."""

# To be counted up when arrays or records change: tiles of before cannot be gone on with.
LAYOUT = 5

# Names of ours alone, as that of the lock: files of the user in the folder mean nothing, and stay.
# In the folder of the run from the beginning of one that replaces another to its end.
_REPLACING = ".sat-intervals.replacing"
# In the folder of the run from when its files get their names until its tiles are removed: which run that is.
_FINISHED = ".sat-intervals.finished"


class DamagedTilesError(RunError):
    """Tiles that are not what was written; they are no longer done."""


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
        return TileArrays(self.folder.inside(ARRAYS), self.grid, self.count, self.ambiguities)

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
            check_free(folder)
            text = None if overwrite or before is None else before.read(MANIFEST) or None
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
                        drop(before)
            if overwrite or (text is None and not self.elsewhere):
                drop(folder)
            if folder.read(MANIFEST) == "":  # as a power loss leaves it
                folder.delete(MANIFEST)
            for name in ("", RECORDS, FAILURES):
                folder.make(name)
            home.make("")
            home.delete(_FINISHED)
            if overwrite:
                home.write(_REPLACING, "")
            if self.elsewhere:
                home.write(PLACE, json.dumps(str(folder)))
            else:
                home.delete(PLACE)
            self._arrays.create()
            if not folder.create(MANIFEST, sealed(manifest)):
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
        except ElsewhereError as error:
            if not overwrite:
                raise
            _LOG.warning("%s: they stay there", error.said)
            return None
        except StoreError:  # the note is damaged: the user says it anew
            if overwrite or self.elsewhere:
                return self.folder
            raise

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
        """Names of the tiles that are complete, see `records`."""
        return set(self.records())

    def write_arrays(self, tile: Tile, arrays: Mapping[str, np.ndarray], manifest: Mapping[str, Any]) -> Checksums:
        """Write what a tile leaves behind, see `TileArrays.write`, into the store of a manifest and no other."""
        self.check(manifest)
        try:
            checksums = self._arrays.write(tile, arrays)
            self.check(manifest)
        except Exception:
            if self.folder.read(MANIFEST) is None:  # it was removed meanwhile, and what came later would stay for ever
                self.folder.delete_all([f"{ARRAYS}/{name}" for name in self._arrays.files_of(tile)], [ARRAYS])
                self.folder.delete_if_empty()
            raise
        return checksums

    def write_record(self, tile: Tile, record: Mapping[str, Any]) -> None:
        """Write what the run wants to know of a tile, and ``files``, its checksums; from now on the tile is done."""
        self.folder.write(f"{RECORDS}/{tile.name}.json", sealed(record))

    def write_normalization(self, normalization: Mapping[str, Any]) -> None:
        """Keep what was measured of the whole images, so that all tiles of the run agree on it, whenever matched."""
        self.folder.write(NORMALIZATION, sealed(normalization))

    def normalization(self) -> dict[str, Any] | None:
        """What `write_normalization` kept; None where nothing was measured, or that is damaged."""
        return unsealed(self.folder.read(NORMALIZATION))

    def write_failure(self, tile: str, reason: str) -> None:
        """Remember why a tile failed, for whoever asks for the status; a record that comes later outweighs it."""
        with suppress(OSError):  # a full disk is reason enough for a tile to fail, but not for the run to end at once
            if self.folder.read(MANIFEST) is not None:  # else a bucket would keep it for ever
                self.folder.write(f"{FAILURES}/{tile}.json", json.dumps(reason))

    def failures(self) -> dict[str, str]:
        """Why tiles failed that are not done since, by name."""
        reasons, done = self.folder.read_all(FAILURES), self.done()
        return {name: _reason(reasons[name]) for name in sorted(reasons) if name not in done}

    def check_space(self, tile: Tile) -> None:
        """Raise an OSError where the disk has no room for what a tile leaves behind, before work is put in."""
        needed = self._arrays.bytes_of(tile)
        free = self.folder.free_bytes()
        if free is not None and free < needed:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.folder))

    def records(self) -> dict[str, dict[str, Any]]:
        """The records of the tiles that are done, by name: whole ones, whose files are there in their sizes."""
        texts, sizes = self.folder.read_all(RECORDS), self._arrays.folder.sizes()
        found = {}
        for tile in self.grid:
            record = unsealed(texts.get(tile.name))
            files = record.get("files", {}) if record else {}
            is_whole = files.keys() == self._arrays.files_of(tile)
            if record and is_whole and all(sizes.get(name) == size for name, (size, _) in files.items()):
                found[tile.name] = record
        return found

    def histogram(self, records: Records) -> np.ndarray:
        """Ambiguities of the whole region: int64 ``(ambiguities + 1,)``; errors as of `strips`."""
        with self._sound():
            return self._arrays.histogram(_checksums(records))

    def seams(self, records: Records) -> np.ndarray:
        """The lines along the tiles' borders, see `TileArrays.seams`; errors as of `strips`."""
        with self._sound():
            return self._arrays.seams(_checksums(records))

    def strips(self, rows: int, records: Records) -> Iterator[dict[str, np.ndarray]]:
        """Raw products of the region in full-width strips of about ``rows`` rows, from the top.

        Raises
        ------
        DamagedTilesError
            Of tiles whose files are not what was written.
        """
        with self._sound():
            yield from self._arrays.strips(rows, _checksums(records))

    @contextmanager
    def _sound(self) -> Iterator[None]:
        """Where a block meets a damaged file, look for all damaged tiles, so that they are matched again in one go."""
        try:
            yield
        except DamagedFileError as error:
            records, damaged = self.records(), []
            for tile in self.grid:
                if tile.name not in records or not self._arrays.are_sound(records[tile.name]["files"]):
                    self.folder.delete(f"{RECORDS}/{tile.name}.json")
                    self._arrays.drop(tile)
                    damaged.append(tile.name)
            names = ", ".join(damaged) or f"of {error}"
            raise DamagedTilesError(
                f"tiles {names} in {self.folder} are damaged: the same command matches them again"
            ) from error

    def remove(self) -> None:
        """Delete the tiles, and nothing else that may be in their folder."""
        remove_tiles(self.home, self.folder)


def remove_tiles(home: Path, place: Folder) -> None:
    """Delete the tiles in ``place`` of the run to whose folder ``home`` belongs."""
    drop(place)
    for name in (PLACE, _REPLACING, _FINISHED):
        folder_at(home).delete(name)


def mark_finished(home: Path, run: str, stamps: Sequence[str] = ()) -> None:
    """Note which run is about to give its files their names, after which its tiles are to be removed.

    To be called again, with the stamps of these files, when they have their names.
    """
    folder_at(home).write(_FINISHED, "\n".join([run, *stamps]))


def finished_run(home: Path) -> tuple[str, list[str]] | None:
    """What `mark_finished` noted, where the tiles have not been removed since."""
    run, *stamps = (folder_at(home).read(_FINISHED) or "").split("\n")
    return (run, stamps) if run else None


def mark_replaced(home: Path) -> None:
    """Note that the files of the run before have been replaced, see `is_replacing`."""
    folder_at(home).delete(_REPLACING)


def is_replacing(home: Path) -> bool:
    """Whether a run has begun that is to replace the files of one before, and has not done so yet."""
    return folder_at(home).read(_REPLACING) is not None


def has_begun(home: Path) -> bool:
    """Whether a run made this folder of tiles; that of a user may have the same name."""
    return is_of_run(folder_at(home)) or folder_at(home).read(PLACE) is not None


def inputs_before(home: Path, store: str | None) -> dict[str, Any]:
    """What the manifest of the tiles that are there says of the inputs; nothing where it cannot be read."""
    try:
        return dict((unsealed(place_of(home, store).read(MANIFEST)) or {}).get("inputs", {}))
    except (OSError, TypeError, ValueError):
        return {}


def _checksums(records: Records) -> Checksums:
    """Those of the files of all tiles."""
    return {name: file for record in records.values() for name, file in record["files"].items()}


def _reason(text: str) -> str:
    try:
        return str(json.loads(text))
    except (ValueError, RecursionError):
        return "its reason cannot be read"


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
    return Store(home, grid_of(parsed(text, folder), folder), 1, 0, str(folder))
