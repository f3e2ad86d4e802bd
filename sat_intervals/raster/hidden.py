"""The hidden folder of a command's unfinished files, and what a killed process left there."""

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path

from sat_intervals.raster.files import File
from sat_intervals.raster.identity import checksum_of
from sat_intervals.raster.old_publishing import (
    POINTS_REPORT,
    REPLACED,
    REPORTS,
    RUN_REPORT,
    OutputError,
    check_opened,
    examined,
    flush_folder,
    pinned,
    publish,
    put_back,
    rename_new,
)
from sat_intervals.raster.space import way_out
from sat_intervals.store.folder import LocalFolder

# The folder, named after the first of the files, and the mark that a process made what is in it. Files of a killed
# process are replaced, others stay.
_HIDDEN, _MADE = ".unpublished-{}", ".sat-intervals.files"
# Names there: a final one, an unfinished one, and those of GDAL beside both.
_UNFINISHED = r"(?:strips-(?:[0-9a-f]+-)?)?(?:{})(?:\.aux\.xml|(?:\.warped\.tif|\.msk)?(?:\.ovr)?\.tmp)?|strips-\w{{8}}"


class HiddenFolder:
    """A locked folder inside an output folder. Both stay open, so that nothing is done in what takes their places.

    Parameters
    ----------
    folder
        The output folder.
    names
        Names of the files that are written there.

    Attributes
    ----------
    files
        Path of the unfinished files, for other processes.
    opened_files, opened_folder
        Paths of them and of the output folder that stay theirs, see `pinned`.
    is_published
        Whether the files were published, so that those that they replace are deleted.
    """

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self._folder = self.opened_folder = folder
        self._hidden = folder / _HIDDEN.format(names[0])
        self.files = self.opened_files = self._hidden / "files"
        self._replaced = self.files / REPLACED
        self._names = (*names, *REPORTS)
        self._made: dict[Path, os.stat_result] = {}
        self.is_published = False

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Open the output folder and lock the hidden one for the block.

        Raises
        ------
        OutputError
            See `check` and `check_folder`, or the folder cannot be opened.
        """
        with ExitStack() as stack:
            try:
                self.opened_folder = stack.enter_context(pinned(self._folder.resolve()))
            except OSError as error:
                raise OutputError(f"{self._folder} cannot be written: {error.strerror}: {way_out(error)}") from error
            self.check_is_own()
            stack.enter_context(LocalFolder(self._hidden).locked())
            self.check_folder(self._hidden)
            self._made = {self._hidden: self._inside(self._hidden).lstat()}
            yield

    @contextmanager
    def made(self) -> Iterator[None]:
        """Make the folders for the block, after what a killed process left is restored and deleted."""
        self.put_back()
        self.remove()
        self.is_published = False
        (self._inside(self._hidden) / _MADE).touch()
        self._inside(self._replaced).mkdir(parents=True, exist_ok=True)
        with pinned(self._inside(self.files)) as self.opened_files:
            self._made[self.files] = self.opened_files.stat()
            self._made[self._replaced] = (self.opened_files / self._replaced.name).lstat()
            self.check()
            yield

    def exists(self) -> bool:
        """Return whether there is a hidden folder."""
        return self._hidden.is_dir()

    def _inside(self, place: Path) -> Path:
        """Return the path of a place through the open output folder."""
        return self.opened_folder / place.relative_to(self._folder)

    def check_folder(self, *others: Path) -> None:
        """Raise if the output folder, or another one in it, is not the one that is open: others took its place."""
        for place in (self._folder, *others):
            check_opened(place, self._inside(place), self._folder)

    def check(self) -> None:
        """Raise if folders of temporary files are not folders, are links, or are not those that were made."""
        for place in (self._hidden, self.files, self._replaced):
            if place.is_symlink():
                raise OutputError(f"{place} is a symbolic link, but temporary files go there: remove it")
            if place.exists() and not place.is_dir():
                raise OutputError(f"{place} is not a folder, but temporary files go there: move it away")
        for place, made in self._made.items():
            if place.exists() and not os.path.samestat(made, place.lstat()):
                raise OutputError(f"{place}, a folder of temporary files, was replaced: move it away and rerun")

    def check_is_own(self) -> None:
        """Raise if folders of temporary files are links, or have files of their names that no killed process left."""
        self.check()
        is_ours = (self._hidden / _MADE).exists() or LocalFolder(self._hidden).has_lock()
        if not is_ours and (foreign := next(self._unfinished(self._replaced, self.files), None)):
            raise OutputError(f"{foreign} was not written by sat-intervals: move {self._hidden} away")

    def _unfinished(self, *folders: Path) -> Iterator[Path]:
        """Yield files with names of temporary ones in some folders."""
        ours = re.compile(_UNFINISHED.format("|".join(map(re.escape, self._names))))
        for folder in folders:
            with suppress(OSError):
                yield from (file for file in folder.iterdir() if ours.fullmatch(file.name) and not file.is_dir())

    def check_complete(self) -> None:
        """Raise if the folders are not there any more, or are others."""
        self.check()
        if not self.files.exists():
            raise OutputError(f"{self.files}, a folder of temporary files, is gone: rerun the command")
        self.check_folder()

    def publish(
        self,
        names: Sequence[str],
        replaceable: Mapping[str, str],
        failing: Callable[[Path], AbstractContextManager[None]],
        compared: Mapping[str, str],
    ) -> None:
        """Give finished files their final names, see `publishing.publish`."""
        publish(self.opened_files, self.opened_folder, self._folder, names, replaceable, failing, compared)
        self.is_published = True
        self.check_folder()

    def put_back(self) -> None:
        """Restore the files that a killed process put aside; if it lacked only the name of its points' report, give it.

        A run needs none: it resumes from its tiles.
        """
        report, place = (folder / POINTS_REPORT for folder in (self._inside(self.files), self.opened_folder))
        with suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
            made = json.loads(report.read_text())["files"]
            if made == {name: checksum_of(self.opened_folder / name) for name in made}:
                rename_new(report, place)
                flush_folder(self.opened_folder)
                self.is_published = True
                return
        put_back(self._inside(self.files), self.opened_folder, self._names)

    def remove(self) -> None:
        """Delete temporary files of this or a killed process, and the replaced ones after publishing; no others.

        They are deleted in open folders, so that a link that takes the place of one leads to no others.
        """
        with suppress(OutputError, OSError):
            self.check()
            with pinned(self._inside(self._hidden)) as hidden:
                with suppress(OSError), pinned(hidden / self.files.name) as files:
                    with suppress(OSError), pinned(files / self._replaced.name) as replaced:
                        if self.is_published:
                            self._delete(hidden, files, replaced)
                        (files / self._replaced.name).rmdir()
                    self._delete(hidden, files)
                with suppress(OSError):
                    (hidden / self.files.name).rmdir()
                if not any(self._unfinished(*map(self._inside, (self._replaced, self.files)))):
                    (hidden / _MADE).unlink()

    def _delete(self, *opened: Path) -> None:
        """Delete the files of the last of some open folders, unless one of them is not the one that was made."""
        pairs = zip(self._made.values(), map(Path.stat, opened), strict=False)  # those of a killed one are unknown
        are_own = all(os.path.samestat(made, there) for made, there in pairs)
        for file in [*self._unfinished(opened[-1])] if are_own else []:
            with suppress(OSError):
                file.unlink()


def remove_scratch(folder: Path, files: Sequence[File]) -> None:
    """Delete temporary files of a killed process; those that it put aside only if all final files exist."""
    with _killed(folder, files) as hidden:
        names = *(file.name for file in files), RUN_REPORT
        if all((hidden.opened_folder / name).is_file() for name in names):
            with suppress(OSError):
                flush_folder(hidden.opened_folder)
                hidden.is_published = True


def restore(folder: Path, files: Sequence[File]) -> None:
    """Restore the files that a killed process put aside, and delete its temporary ones."""
    with _killed(folder, files) as hidden:
        hidden.put_back()


@contextmanager
def replaceable(folder: Path, files: Sequence[File]) -> Iterator[dict[str, str]]:
    """Restore what a killed process put aside; then yield the stamps of the files to replace, see `examined`."""
    restore(folder, files)
    with examined(folder, [file.name for file in files]) as there:
        yield there


@contextmanager
def _killed(folder: Path, files: Sequence[File]) -> Iterator[HiddenFolder]:
    """Yield the hidden folder of a killed process; afterwards delete its temporary files."""
    hidden = HiddenFolder(folder, [file.name for file in files])
    hidden.check_is_own()
    if hidden.exists():
        with hidden.opened():
            yield hidden
            hidden.remove()
    else:
        yield hidden
