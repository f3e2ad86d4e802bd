"""Give finished files their final names, all of them or none, and replace no file that is not to be replaced."""

import ctypes
import errno
import filecmp
import json
import logging
import os
import stat
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path

from sat_intervals.errors import ChangedInputError
from sat_intervals.raster.publishing import OutputError
from sat_intervals.raster.watching import watched
from sat_intervals.store.manifest import unsealed
from sat_intervals.store.open_folder import flush_names

_LOG = logging.getLogger(__name__)

# Reports that are published with files: of a run, and of its points.
RUN_REPORT, POINTS_REPORT = "run.json", "points.json"
REPORTS = RUN_REPORT, POINTS_REPORT
# Arguments of Linux' renameat2: paths are relative to the working directory; replace nothing; exchange two files.
_HERE, _REPLACE_NOTHING, _EXCHANGE = -100, 1, 2
# Folder of the replaced files, among the finished ones.
REPLACED = "replaced"


@contextmanager
def pinned(folder: Path) -> Iterator[Path]:
    """Yield a path of a folder that stays its own, even if a link or another folder takes its place.

    The path is one of this process only. Without ``/proc`` it is the plain one, which protects against nothing.

    Raises
    ------
    OSError
        It is not a folder, or a link.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        path = Path(f"/proc/self/fd/{descriptor}")
        yield path if path.exists() else folder
    finally:
        os.close(descriptor)


def check_own(file: Path) -> os.stat_result:
    """Return the status of a temporary file.

    Raises
    ------
    OSError
        A link took its place, of either kind.
    """
    status = file.lstat()
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        raise _replaced(file)
    return status


def open_own(file: Path, flags: int) -> int:
    """Open a temporary file that exists; return its descriptor.

    Raises
    ------
    OSError
        A link took its place, of either kind.
    """
    there = check_own(file)
    descriptor = os.open(file, flags | os.O_NOFOLLOW)
    status = os.fstat(descriptor)
    if not os.path.samestat(there, status) or status.st_nlink > 1:
        os.close(descriptor)
        raise _replaced(file)
    return descriptor


def _replaced(file: Path) -> OSError:
    return OSError(errno.ESTALE, f"its temporary file {file.name} was replaced")


def check_opened(place: Path, opened: Path, folder: Path) -> None:
    """Raise if a place in a folder, or this itself, is not the one that was opened: another folder took its place."""
    with suppress(FileNotFoundError):
        if os.path.samestat(place.stat(), opened.stat()):
            return
    raise OutputError(f"{folder} was replaced by another folder meanwhile: rerun the command")


def stamps(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return sizes and modification times of the files that exist, by name; a file that is moved keeps them."""
    found = {}
    for name in names:
        with suppress(FileNotFoundError, NotADirectoryError):
            status = (folder / name).lstat()
            found[name] = f"{status.st_size:x}-{status.st_mtime_ns:x}"
    return found


def _stamp(file: Path) -> str | None:
    return stamps(file.parent, [file.name]).get(file.name)


@contextmanager
def examined(folder: Path, names: Iterable[str]) -> Iterator[dict[str, str]]:
    """Yield the `stamps` of files that the block examines, to replace them later.

    Raises
    ------
    ChangedInputError
        At the end of the block: one came, went or changed meanwhile, so that another one may have been examined.
    """
    names = tuple(names)
    check = watched((folder / name for name in names), is_local=True)
    there = stamps(folder, names)
    yield there
    check()
    if stamps(folder, names) != there:
        raise ChangedInputError(f"files in {folder} came or went while they were examined: rerun the command")


def publish(
    finished: Path,
    folder: Path,
    named: Path,
    names: Sequence[str],
    replaceable: Mapping[str, str],
    failing: Callable[[Path], AbstractContextManager[None]],
    compared: Mapping[str, str],
) -> None:
    """Move files to another folder, all of them or none, the last of ``names`` last.

    Parameters
    ----------
    finished
        Folder of the finished files. Existing files are put aside in its folder ``replaced``. If the process is killed,
        `put_back` restores them.
    folder, named
        Their new folder, `pinned`, and its path for messages.
    names
        Their names in both.
    replaceable
        `stamps` of the files that may be replaced. A killed process may also have published some of the same files.
    failing
        Context for the work on a final name.
    compared
        `stamps` that files had when they were compared with their checksums.

    Raises
    ------
    OutputError
        Names a file that must not be replaced, or says that another program changed some.
    """
    own: dict[str, os.stat_result] = {}
    for name in names:
        with failing(named / name):
            own[name] = check_own(finished / name)
    try:
        for name in reversed(names):
            with failing(named / name):
                if not _put_aside(finished / name, folder / name, replaceable.get(name)):
                    raise OutputError(
                        f"{named / name} is not of this run, or was changed since it started: move it away"
                    )
        for name in names:
            with failing(named / name):
                rename_new(finished / name, folder / name)
        if stamps(folder, compared) != compared:
            raise OutputError(f"another program changed temporary files in {named}: rerun the command")
        with failing(named):
            flush_folder(folder)
    except BaseException:
        for name in names:
            with suppress(OSError):
                if os.path.samestat(own[name], (folder / name).lstat()):
                    _remove(folder / name, finished, partial(_is_file, own[name]))
        put_back(finished, folder, names)
        raise


def put_back(finished: Path, folder: Path, names: Iterable[str]) -> None:
    """Restore files that were put aside, unless there are others of their names."""
    for name in names:
        with suppress(OSError):
            rename_new(finished / REPLACED / name, folder / name)


def _put_aside(new: Path, place: Path, stamp: str | None) -> bool:
    """Put a file aside, and return whether it has the stamp or is equal to the new one."""
    if not os.path.lexists(place):
        return True
    if place.is_dir() and not place.is_symlink():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))

    def may_go(file: Path) -> bool:
        return _stamp(file) == stamp or _is_same(file, new)

    aside = new.parent / REPLACED / new.name
    if os.path.lexists(aside):  # a killed process has put aside the one to restore
        return _remove(place, new.parent, may_go)
    os.replace(place, aside)
    if may_go(aside):
        return True
    _give_back(aside, place)
    return False


def _remove(place: Path, folder: Path, may_go: Callable[[Path], bool]) -> bool:
    """Delete a file if it may go, and return whether it did: it is looked at where nothing can take its place.

    There it has a name that nobody deletes, in case of a kill.
    """
    aside = _name_of_its_own(folder, place)
    os.rename(place, aside)
    if not may_go(aside):
        _give_back(aside, place)
        return False
    os.unlink(aside)
    return True


def _give_back(aside: Path, place: Path) -> None:
    """Return what was there for a moment only; if its place is taken again, keep it under a name of its own."""
    try:
        _rename_free(aside, place)
    except FileExistsError:
        _keep(aside, aside.parent, place)


def _name_of_its_own(folder: Path, place: Path) -> Path:
    """Return a new name for a file that was in the place of an output: no temporary one, which would be deleted."""
    return folder / f"kept-{uuid.uuid4().hex}-{place.name}"  # names of outputs may have 32 hexadecimal digits, too


def _keep(aside: Path, folder: Path, place: Path) -> None:
    """Give what had the place of an output for a moment a name of its own in a folder."""
    kept = _name_of_its_own(folder, place)
    os.rename(aside, kept)
    _LOG.warning("a file of another program was %s for a moment: it is kept as %s", place.resolve(), kept.resolve())


def _is_file(own: os.stat_result, file: Path) -> bool:
    return os.path.samestat(own, file.lstat())


def _is_same(file: Path, new: Path) -> bool:
    """Return whether a file is equal to the new one of its name, and a report to that of the same files."""
    if file.is_symlink() or not file.is_file():
        return False
    if new.name == RUN_REPORT:
        with suppress(ValueError, LookupError, TypeError, RecursionError):
            there = unsealed(file.read_text())  # None if it was edited
            return there is not None and bool(there["files"] == json.loads(new.read_text())["files"])
        return False
    return filecmp.cmp(file, new, shallow=False)


def rename_new(source: Path, target: Path) -> None:
    """Rename a file that is no folder, but never over another."""
    if source.is_dir() and not source.is_symlink():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    _rename_free(source, target)


def _rename_free(source: Path, target: Path) -> None:
    """Rename a file or folder, but never over another; on disks with neither way to do so, one may come meanwhile."""
    if _is_renamed(source, target, _REPLACE_NOTHING):
        return
    try:
        os.link(source, target, follow_symlinks=False)
    except (FileExistsError, FileNotFoundError):
        raise
    except OSError:  # a file system without hard links, or a folder
        if os.path.lexists(target):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
        os.rename(source, target)
    else:
        os.unlink(source)


def _is_renamed(source: Path, target: Path, flag: int) -> bool:
    """Rename with a flag of Linux' renameat2 and return True; False where the system or the disk has no such flag."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    if not rename(_HERE, os.fsencode(source), _HERE, os.fsencode(target), flag):
        return True
    error = ctypes.get_errno()
    if error in (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP):
        return False
    raise OSError(error, os.strerror(error), str(source))


def replace_same(new: Path, place: Path, stamp: str) -> None:
    """Replace a file that still has its stamp, see `stamps`; the replaced one is then where the new one was.

    Raises
    ------
    FileExistsError
        Another file came there meanwhile, and stays.
    """
    own = _stamp(new)
    aside = _name_of_its_own(new.parent, place)  # a kill leaves there what nobody has looked at
    os.rename(new, aside)
    try:
        if _stamp(place) == stamp:
            _exchange(aside, place)
    finally:  # of a signal, too
        there = _stamp(aside)
        if there not in (stamp, own, None):
            _exchange(aside, place)
            if _stamp(aside) not in (own, None):  # again another one
                _keep(aside, place.parent, place)
        with suppress(FileNotFoundError):
            os.rename(aside, new)
    if there not in (stamp, None):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))


def _exchange(new: Path, place: Path) -> None:
    """Exchange two files in one step, so that the replaced one can be examined; replace it where that is impossible."""
    with suppress(FileNotFoundError):  # what was to be replaced may be away
        if not _is_renamed(new, place, _EXCHANGE):
            os.replace(new, place)


def flush_folder(folder: Path) -> None:
    """Flush new names in a folder to the disk, before what they replace is deleted: a power loss could take both."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        flush_names(descriptor)
    finally:
        os.close(descriptor)


def flush(path: Path) -> None:
    """Flush a file to the disk; raises if that fails."""
    with open(path, "rb") as stream:
        os.fsync(stream.fileno())
