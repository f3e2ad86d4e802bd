"""Intermediate tile products: arrays, records and a manifest.

The worker that matches a tile writes its arrays, each tile into its own files, and then its record with sizes and
checksums of these files. A tile is done if its record is intact and its files have these sizes. Checksums are compared
when files are read; a tile with a damaged file is no longer done. Writing a tile again writes the same bytes. The
manifest has everything that decides these bytes; a store with another manifest is refused. Runs with the same manifest
may share an external store, since they write the same bytes.
"""

import errno
import json
import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.errors import RemovedTilesError, RunError, SatIntervalsError
from sat_intervals.store.folder import MADE, Folder, folder_at, mark
from sat_intervals.store.manifest import MANIFEST, StoreError, check_same, digest, grid_of, parsed, sealed, unsealed
from sat_intervals.store.marks import FINISHED, REPLACING, check_replacing
from sat_intervals.store.place import HOME, PLACE, ElsewhereError, is_of_another, place_of
from sat_intervals.store.removal import (
    ARRAYS,
    FAILURES,
    FOLDERS,
    NORMALIZATION,
    RECORDS,
    SEARCH,
    check_not_foreign,
    drop,
    drop_earlier,
    final_name,
    unusable,
)
from sat_intervals.store.steps import Steps
from sat_intervals.store.zarr_arrays import STORED_BYTES, Checksums, DamagedFileError, TileArrays
from sat_intervals.tiling import Grid, Tile

Records = Mapping[str, Mapping[str, Any]]
"""Records of tiles, by name."""

# Increase when arrays or records change: older tiles cannot be resumed.
LAYOUT = 12


class DamagedTilesError(RunError):
    """Tiles that are missing or damaged; they are no longer done."""


_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Store:
    """The tiles of one run; picklable, so that each worker writes its own tiles.

    Attributes
    ----------
    home
        Folder of the tiles in the folder of the run.
    grid
        The tiles.
    count
        Number of disparities of the search range.
    ambiguities
        Largest possible ambiguity of a pixel.
    levels
        Levels of sub-pixel bounds, see `TileArrays`.
    has_seams
        Whether the lines along the tiles' borders are kept: with overlaps.
    run
        Digest of the manifest: what belongs to another run is not taken for a part of this one.
    elsewhere
        Folder of the tiles in the store that the user names; by default ``home``.
    """

    home: Path
    grid: Grid
    count: int
    ambiguities: int
    levels: int
    has_seams: bool
    run: str
    elsewhere: str | None = None

    @property
    def folder(self) -> Folder:
        """Return the folder of the tiles."""
        return self._place.of_run(self.run)

    @property
    def _place(self) -> Folder:
        """Return the folder of the tiles, which may still be of another run."""
        return folder_at(self.elsewhere or self.home)

    @property
    def _marks(self) -> Folder:
        """Return the folder of the marker files, which is locked during a run."""
        return folder_at(self.home) if self.elsewhere else self.folder

    @property
    def _arrays(self) -> TileArrays:
        return TileArrays(
            self.folder.inside(ARRAYS), self.grid, self.count, self.ambiguities, self.levels, self.has_seams
        )

    @property
    def steps(self) -> Steps:
        """Return what steps hand to later ones."""
        return Steps(self.folder, self.run)

    def open(
        self, manifest: Mapping[str, Any], *, overwrite: bool = False, replaceable: Mapping[str, str] | None = None
    ) -> None:
        """Create the store or resume an existing one; call it while ``home`` is locked.

        Parameters
        ----------
        manifest
            All that decides the bytes of a tile; ``region`` and ``settings`` define the grid.
        overwrite
            Whether to delete existing tiles and replace the files of an earlier run. Tiles in a store that the user
            does not name are kept.
        replaceable
            What `replaceable_files` of this run returns afterwards, with ``overwrite``.

        Raises
        ------
        StoreError
            The existing store has other settings, inputs or versions, is at another place, or cannot be used.
        """
        home, folder = folder_at(self.home), self.folder
        try:
            before = self._place_before(overwrite)
            check_not_foreign(folder)
            text = None if overwrite or before is None else before.read(MANIFEST) or None
            if before is not None and text is not None:
                check_same(text, before, manifest)
                if before != folder:
                    raise StoreError(
                        f"the tiles of the run in {self.home.parent} are in {before}, not in {folder}: give the same "
                        "--store as before (or none) to resume, or --overwrite to start again"
                    )
            if not overwrite:
                check_replacing(self.home, self.run)
            if self.elsewhere and (there := unsealed(folder.read(MANIFEST))) and digest(there) != self.run:
                raise StoreError(f"{folder} has the tiles of another run, which were moved there: move them away")
            self._place.make("")  # fails before anything is deleted
            drop_earlier(None if text else before, self.home, overwrite=overwrite)
            if overwrite or (text is None and not self.elsewhere):
                drop(folder if self.elsewhere else home)
            self._place.make("")
            folder.write(MADE, mark(self.run))
            if folder.read(MANIFEST) == "":  # after a power loss
                folder.delete(MANIFEST)
            for name in FOLDERS:
                folder.make(name)
            home.make("")
            home.delete(FINISHED)
            if overwrite:
                home.write(REPLACING, json.dumps({"run": self.run, "files": dict(replaceable or {})}))
            if self.elsewhere:
                if not is_of_another(folder, self.home):
                    folder.write(HOME, json.dumps(str(self.home)))
                home.write(PLACE, json.dumps(str(folder)))
            else:
                home.delete(PLACE)
            self._arrays.create()
            if not folder.create(MANIFEST, sealed(manifest)):
                self.check(manifest)
        except OSError as error:
            raise unusable(folder, error, "used") from error

    def _place_before(self, overwrite: bool) -> Folder | None:
        """Return the folder of the earlier run's tiles; with ``overwrite``, None if they must be kept."""
        try:
            return place_of(self.home, self.elsewhere and self.elsewhere.rpartition("/")[0])
        except ElsewhereError as error:
            if not overwrite:
                raise
            _LOG.warning("%s: they are kept", error.problem)
            return None
        except StoreError:  # the place file is damaged: the user's --store replaces it
            if overwrite or self.elsewhere:
                return self.folder
            raise

    def check(self, manifest: Mapping[str, Any]) -> None:
        """Raise if the store was removed or replaced by another run.

        Raises
        ------
        RunError
            It was removed.
        StoreError
            It belongs to another run.
        """
        if (there := self.folder.read(MANIFEST)) is None:
            raise RunError(
                f"the tiles in {self.folder} are gone: another run of the same images and settings may have removed "
                "them: rerun the same command: it matches them again"
            )
        check_same(there, self.folder, manifest)

    @contextmanager
    def needed(self, manifest: Mapping[str, Any]) -> Iterator[None]:
        """If the block fails because the store is gone, raise the error of `check` instead."""
        try:
            yield
        except Exception as error:
            with suppress(OSError):
                if not isinstance(error, RemovedTilesError):
                    self.check(manifest)
            raise

    def done(self) -> set[str]:
        """Return the names of the tiles that are done, see `records`."""
        return set(self.records())

    def write_arrays(self, tile: Tile, arrays: Mapping[str, np.ndarray], manifest: Mapping[str, Any]) -> Checksums:
        """Write the products of a tile, see `TileArrays.write`, if the store has this manifest."""
        self.check(manifest)
        try:
            checksums = self._arrays.write(tile, arrays)
            self.check(manifest)
        except Exception:
            if self.folder.read(MANIFEST) is None:  # removed meanwhile: delete what was written after that
                self.folder.delete_all([f"{ARRAYS}/{name}" for name in self._arrays.files_of(tile)], [ARRAYS])
                self.folder.delete_if_empty()
            raise
        return checksums

    def write_record(self, tile: Tile, record: Mapping[str, Any]) -> None:
        """Write the record of a tile, with its checksums in ``files``; the tile is then done."""
        name = f"{RECORDS}/{tile.name}.json"
        self.folder.write(name, sealed(record, f"{self.run}/{tile.name}"))
        if self.folder.read(MANIFEST) is None:  # another run removed the tiles meanwhile
            self.folder.delete(name)

    def write_normalization(self, normalization: Mapping[str, Any]) -> None:
        """Write the statistics of the whole images, so that all tiles use the same."""
        self.folder.write(NORMALIZATION, sealed(normalization, self.run))

    def normalization(self) -> dict[str, Any] | None:
        """Read the statistics of `write_normalization`; None if missing or damaged."""
        return unsealed(self.folder.read(NORMALIZATION), self.run)

    def write_search(self, search: Mapping[str, Any], of: str) -> None:
        """Write the search range that was found, so that it is not searched again, see `before`.

        ``of`` names all that decides which range is found: not the run, which depends on the range.
        """
        self.folder.write(SEARCH, sealed(search, of))

    def search(self, of: str) -> dict[str, Any] | None:
        """Read what `write_search` wrote; None if missing, damaged or of other images."""
        return unsealed(self.folder.read(SEARCH), of)

    def write_failure(self, tile: str, reason: str) -> None:
        """Write why a tile failed, for `failures`; a later record replaces it."""
        with suppress(OSError, SatIntervalsError):  # a full disk or a damaged store must not end the run
            if self.folder.read(MANIFEST) is not None:  # otherwise it would never be deleted
                self.folder.write(f"{FAILURES}/{tile}.json", json.dumps(reason))

    def failures(self) -> dict[str, str]:
        """Return why tiles failed, by name, without those done since."""
        reasons, done = self.folder.read_all(FAILURES), self.done()
        return {name: _reason(reasons[name]) for name in sorted(reasons) if name not in done}

    def stored_bytes(self, tiles: Iterable[Tile]) -> int:
        """Return the size of the products of tiles, compressed."""
        return (STORED_BYTES + 2 * self.levels) * sum(tile.core.height * tile.core.width for tile in tiles)

    def check_space(self, tile: Tile) -> None:
        """Raise an OSError if the disk has no room for the products of a tile; call it before matching."""
        free = self.folder.free_bytes()
        if free is not None and free < self._arrays.bytes_of(tile):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.folder))

    def records(self) -> dict[str, dict[str, Any]]:
        """Return the records of tiles that are done, by name: intact ones whose files have the right sizes."""
        texts, sizes = self.folder.read_all(RECORDS), self._arrays.folder.sizes()
        found = {}
        for tile in self.grid:
            record = unsealed(texts.get(tile.name), f"{self.run}/{tile.name}")
            files = record.get("files", {}) if record else {}
            is_complete = files.keys() == self._arrays.files_of(tile)
            if record and is_complete and all(sizes.get(name) == size for name, (size, *_) in files.items()):
                found[tile.name] = record
        return found

    def histogram(self, records: Records) -> np.ndarray:
        """Return the ambiguity histogram of the region, int64 ``(ambiguities + 1,)``; errors as in `strips`."""
        with self._damage_handled():
            return self._arrays.histogram(_checksums(records))

    def seams(self, records: Records) -> np.ndarray:
        """Return the lines along the tiles' borders, see `TileArrays.seams`; errors as in `strips`."""
        with self._damage_handled():
            return self._arrays.seams(_checksums(records))

    def strips(
        self, rows: int, records: Records, first: int = 0, last: int | None = None
    ) -> Iterator[dict[str, np.ndarray]]:
        """Yield raw products of full-width strips of about ``rows`` rows, from the top, see `TileArrays.strips`.

        ``records`` are those of the tiles in the rows ``[first, last)``, by default of all.

        Raises
        ------
        DamagedTilesError
            Names the tiles with damaged files.
        """
        with self._damage_handled():
            yield from self._arrays.strips(rows, _checksums(records), first, last)

    def keep(self, records: Records) -> None:
        """Compare the files of all tiles with their checksums, and restore the arrays' metadata; raises as `strips`."""
        with self._damage_handled():
            self._arrays.create()
            if not self._arrays.are_intact(_checksums(records)):
                raise DamagedFileError

    @contextmanager
    def _damage_handled(self) -> Iterator[None]:
        """If the block meets a damaged file, delete all damaged tiles, so that one retry matches them again."""
        try:
            yield
        except DamagedFileError as error:
            records, damaged = self.records(), []
            for tile in self.grid:
                if tile.name not in records or not self._arrays.are_intact(records[tile.name]["files"]):
                    self.folder.delete(f"{RECORDS}/{tile.name}.json")
                    self._arrays.drop(tile)
                    damaged.append(tile.name)
            names = ", ".join(damaged) or f"of {error}"
            raise DamagedTilesError(
                f"tiles {names} in {self.folder} are damaged: rerun the same command: it matches them again"
            ) from error

    def remove(self) -> bool:
        """Delete the tiles of this run and no other files; return whether none are left.

        Those of another run may have taken their place.
        """
        is_own = (there := unsealed(self.folder.read(MANIFEST))) is None or digest(there) == self.run
        return is_own and remove_tiles(folder_at(self.home), self.folder)

    def mark_finished(self, name: str, stamps: Sequence[str]) -> None:
        """Mark a run as finished, so that its tiles are removed even if it is killed before.

        Call it before its files are published, with the stamps that they will have.
        """
        self._marks.write(FINISHED, "\n".join([name, *stamps]))

    def mark_replaced(self) -> None:
        """Mark the earlier run's files as replaced, see `is_replacing`."""
        self._marks.delete(REPLACING)


def remove_tiles(home: Folder, place: Folder) -> bool:
    """Delete a run's tiles in ``place``, and its marker files in ``home``; return whether no tiles are left."""
    is_gone = drop(place)
    home.delete_all([name for name in home.sizes() if final_name(name) in (PLACE, REPLACING, FINISHED)])
    return is_gone


def _checksums(records: Records) -> Checksums:
    """Return the checksums of the files of all tiles."""
    return {name: file for record in records.values() for name, file in record["files"].items()}


def _reason(text: str) -> str:
    try:
        return str(json.loads(text))
    except (ValueError, RecursionError):
        return "the reason cannot be read"


def store_of(home: Path, store: str | None = None) -> Store:
    """Open the store of a run, only to read its progress.

    Parameters
    ----------
    home, store
        See `place_of`.

    Raises
    ------
    StoreError
        There is no store.
    """
    folder = place_of(home, store)
    text = folder.read(MANIFEST)
    if text is None:
        raise StoreError(f"{home.parent} has no run: give the folder that match was given")
    manifest = parsed(text, folder)
    grid, has_seams = grid_of(manifest, folder), manifest["settings"]["tiles"].get("overlap") != "exact"
    return Store(home, grid, 1, 0, 0, has_seams, digest(manifest), str(folder))
