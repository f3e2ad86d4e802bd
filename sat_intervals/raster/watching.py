"""Notice files that are changed, exchanged or joined by others while they are read."""

import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from sat_intervals.errors import ChangedInputError, RunError
from sat_intervals.raster.beside import came_beside
from sat_intervals.raster.identity import check_unchanged, local_file, local_stamp, stamp_of
from sat_intervals.raster.moves import moves

# Attempts to read a file that changes meanwhile.
_TRIES = 3

_Read = TypeVar("_Read")


class _Place(NamedTuple):
    """State of a file, link or folder on a path: inode, times in nanoseconds, and its `moves`."""

    inode: int
    modified: int
    changed: int
    is_folder: bool
    moves: tuple[int, int] | None

    def is_touched(self, later: "_Place") -> bool:
        """Return whether a file or link changed, or a folder was exchanged.

        A folder that gets a new file has both times of that moment, one that is renamed only the change time.
        """
        is_moved = None not in (self.moves, later.moves) and self.moves != later.moves
        has_other_time = self.changed != later.changed and not (later.is_folder and later.modified == later.changed)
        return self.inode != later.inode or is_moved or has_other_time


class _Moment(NamedTuple):
    """Stamp of a file, None if it has none, and the places on its path and those of its links."""

    stamp: str | None
    places: list[_Place]

    def is_touched(self, later: "_Moment") -> bool:
        """Return whether the file, or a link or folder on its path, was changed or exchanged since."""
        return self.stamp != later.stamp or _is_other_way(self.places, later.places)


def _moment(path: str) -> _Moment:
    file = local_file(path)
    return _Moment(None, []) if file is None else _Moment(local_stamp(file), [*_way_to(file.absolute())])


def _way_to(path: Path) -> Iterator[_Place]:
    for place in (path, *path.parents):
        counted, status = moves(place), place.lstat()  # in this order: what comes between them changes the inode
        is_folder, is_link = stat.S_ISDIR(status.st_mode), stat.S_ISLNK(status.st_mode)
        if is_folder or is_link:
            yield _Place(status.st_ino, status.st_mtime_ns, status.st_ctime_ns, is_folder, counted)
        if is_link:
            yield from _way_to(place.parent / place.readlink())


def _is_other_way(before: Sequence[_Place], later: Sequence[_Place]) -> bool:
    return len(before) != len(later) or any(map(_Place.is_touched, before, later))


def read_unchanged(files: Mapping[str, Mapping[str, Any]], read: Callable[[], _Read]) -> _Read:
    """Read from the inputs of a run and return the result.

    It reads again if an input was touched meanwhile, or a file came beside it: another one may have been read.

    Raises
    ------
    ChangedInputError
        See `check_unchanged`.
    RunError
        An input is touched all the time.
    """
    for _ in range(_TRIES):
        came, before = came_beside(files, with_overviews=True), {name: _moment(name) for name in files}
        try:
            content = read()
        finally:  # a changed input explains a read error
            check_unchanged(files)
        now = {name: _moment(name) for name in files}
        touched = [name for name in files if before[name].is_touched(now[name])]
        arrived = came_beside(files, with_overviews=True)
        touched += [name for name, count in arrived.items() if came.get(name) != count]
        if not touched:
            return content
    raise RunError(
        f"{touched[0]} keeps changing while it is read: stop the program that writes it and rerun the same command"
    )


def watched(files: Iterable[str | Path | None], *, is_local: bool = False) -> Callable[[], None]:
    """Return a function that raises if a file was made, replaced or changed since; None is ignored.

    Call it between reading several times from files and publishing what was made of them. Of rasters, see
    `watched_rasters`. A server that does not answer does not change a file; with ``is_local``, none is asked.
    """
    names = {str(file) for file in files if file is not None}
    before = {file: (_moment(file), None if is_local else stamp_of(file)) for file in names}

    def check() -> None:
        for file, (moment, stamp) in before.items():
            now = None if is_local else stamp_of(file)
            if moment.is_touched(_moment(file)) or (None not in (stamp, now) and stamp != now):
                raise ChangedInputError(f"{file} was replaced or changed while it was read: rerun the command")

    return check


def watched_folder(folder: Path) -> Callable[[], None]:
    """Return a function that raises if a folder was another one for a moment since, while files were written there."""
    before = [*_way_to(folder.absolute())]

    def check() -> None:
        if _is_other_way(before, [*_way_to(folder.absolute())]):
            raise ChangedInputError(f"{folder} was another folder while files were written: rerun the command")

    return check
