"""Find the files that a raster is read from, and watch them."""

import os
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rasterio.io import DatasetReader

from sat_intervals.errors import ChangedInputError, InputError, check_regular
from sat_intervals.raster import gdal
from sat_intervals.raster.beside import came_beside, is_read, names_beside
from sat_intervals.raster.identity import local_file, stamp_of
from sat_intervals.raster.virtual import sources_of
from sat_intervals.raster.watching import watched

# File systems of which GDAL does not say what it reads, or whether it has changed; archives on servers.
_UNKNOWN = re.compile(r"/vsi(sparse/|cached\?|\w+_streaming/)")
_IN_REMOTE = re.compile(r"(/?vsi(zip|tar|gzip|7z|rar|subfile)/(\d+(_\d+)?,)?\{?)+/?vsi(curl|s3|gs|az|adls|oss|swift)")


def other_files(name: str) -> list[str]:
    """Return the other files that a raster is read from: its mask file, sources of a virtual raster and their masks.

    Raises
    ------
    InputError
        GDAL does not list all of them.
    """
    return survey(name).files


class Survey(NamedTuple):
    """What a raster is read from.

    Attributes
    ----------
    files
        The `other_files`.
    sources
        Those of them that are sources of virtual rasters.
    uses_overviews
        Whether GDAL may read overviews of sources.
    unread
        Those of the files that are overviews of which full resolution needs none.
    """

    files: list[str]
    sources: set[str]
    uses_overviews: bool
    unread: set[str]


def survey(name: str) -> Survey:
    """Return what a raster is read from; raises as `other_files`."""
    seen: set[str] = set()
    asked: set[str] = set()
    named: set[str] = set()  # by virtual rasters
    listed: dict[str, list[str]] = {}
    waiting = [name]
    of_virtual: set[str] = set()
    overviews: dict[str, set[str]] = {}
    uses_overviews = False
    while waiting:
        path = waiting.pop()
        if path in asked:
            continue
        asked.add(path)
        check_pipes_beside(path, listed)
        check_regular(path)
        try:
            with gdal.reading(path) as dataset:
                files, sources = dataset.files, sources_of(path, dataset)
                _check_watched(path, dataset, sources.names)
                overviews[path] = _overviews(path, files)
        except gdal.GDAL_ERRORS as error:
            if path in named:
                raise InputError(
                    f"{path}, a source of {name}, cannot be read: {gdal.reason(error)}: restore it"
                ) from error
            continue  # a sidecar file that is not a raster
        known = set(map(_place, files))
        others = {source for source in sources.names if _place(source) not in known}
        new = {file for file in files if file not in seen and not _is_same(file, name)}
        seen |= new | {source for source in others if not _may_have_others(source)}
        named |= others
        waiting += [*filter(_may_have_others, new | others), *sources.positions]
        of_virtual |= set(map(_place, sources.names))
        uses_overviews |= sources.uses_overviews
    sources_seen = {file for file in seen if _place(file) in of_virtual}
    unread = overviews.get(name, set()) if uses_overviews else set().union(*overviews.values())
    return Survey(sorted(seen), sources_seen, uses_overviews, unread - sources_seen)


def read_files(name: str) -> list[str]:
    """Return a raster and its `other_files`, but no ``.aux.xml`` that a program wrote which only showed it."""
    return [name, *filter(is_read, other_files(name))]


def pixel_files(name: str) -> list[str]:
    """Return the `read_files` that decide the pixels of a raster at full resolution: no overviews, if it needs none."""
    found = survey(name)
    return [name, *(file for file in found.files if is_read(file) and file not in found.unread)]


def watched_rasters(
    files: Iterable[str | Path | None], files_of: Callable[[str], list[str]] = read_files
) -> Callable[[], None]:
    """Return what `watched` returns, for rasters and their ``files_of``, none of which may appear either.

    Nor may one come and go, where the system counts `arrivals`.
    """
    names = {str(file) for file in files if file is not None}
    came = came_beside(names, with_overviews=True)
    before = {name: files_of(name) for name in names}
    sources = {file for name in names for file in before[name]}
    came_to = partial(came_beside, sources, with_overviews=any(survey(name).uses_overviews for name in names))
    came = came_to() | came
    check_files = watched(sources)

    def check() -> None:
        check_files()
        for name in names:
            if files_of(name) != before[name]:
                raise ChangedInputError(f"a file beside {name} appeared while it was read: rerun the command")
        for file, count in came_to().items():
            if count > came.get(file, 0) + os.path.lexists(file):  # what is still there was compared
                raise ChangedInputError(
                    f"{file} came, and went or was replaced, while files were read: rerun the command"
                )

    return check


def watched_image(*names: str | None) -> Callable[[], None]:
    """Return what `watched` returns, for a local image and its mask while it is opened, and what comes beside them."""
    files = [name for name in names if name is not None]
    came, check_files = came_beside(files), watched(files, is_local=True)

    def check() -> None:
        check_files()
        if new := came_beside(files).items() - came.items():
            raise ChangedInputError(f"{min(new)[0]} came while an image was opened: rerun the command")

    return check


def stamps_of(*names: str | None) -> dict[str, str | None]:
    """Return the stamps of the `pixel_files` of rasters by name, see `stamp_of`; None for one that has none."""
    return {file: stamp_of(file) for name in names if name is not None for file in pixel_files(name)}


def check_pipes_beside(path: str, listed: dict[str, list[str]] | None = None) -> None:
    """Raise if a file beside a raster, such as a mask, is a pipe: GDAL would wait for it.

    ``listed`` keeps such files by folder, so that the folder of many rasters is listed once.
    """
    folder, name = os.path.split(path)
    listed = {} if listed is None else listed
    if folder not in listed:
        listed[folder] = []
        with suppress(OSError), os.scandir(folder or ".") as files:
            listed[folder] = [file.name for file in files if not (file.is_file() or file.is_dir())]
    for other in listed[folder]:
        if other.lower() in names_beside(name):
            check_regular(os.path.join(folder, other))


def _check_watched(name: str, dataset: DatasetReader, sources: Iterable[str]) -> None:
    """Raise if the tool could not notice that files of a raster, or ``sources``, are incomplete or change."""
    names = name, *dataset.files, *sources
    if remote := next(filter(_IN_REMOTE.match, names), None):
        raise InputError(f"{remote} is in an archive on a server, of which a change would not be noticed: download it")
    if any(map(os.path.isdir, names)) or any(map(_UNKNOWN.search, names)):
        raise InputError(
            f"{name} is read from files that GDAL does not list, which may change during a run: convert it with "
            "gdal_translate"
        )
    if dataset.driver in gdal.UNCHECKED:
        raise InputError(
            f"{name} has the format {dataset.driver}, in which GDAL does not report missing data or changed files: "
            "convert it with gdal_translate"
        )


def _place(name: str) -> str:
    """Return a local file without links, and other names as they are."""
    return os.path.realpath(name) if os.path.exists(name) else name


def _overviews(name: str, files: Iterable[str]) -> set[str]:
    """Return the overviews of a raster and of its mask; ``files`` has the raster itself under GDAL's name."""
    own = [name.lower(), *(file.lower() for file in files if _is_same(file, name))]
    names = {f"{file}{ending}" for file in own for ending in (".ovr", ".msk.ovr")}
    return {file for file in files if file.lower() in names}


def _is_same(file: str, name: str) -> bool:
    """Return whether GDAL lists a raster of this name as a file."""
    scheme, is_url, place = name.partition("://")
    is_listed = bool(is_url) and scheme != "vrt" and file.startswith("/vsi") and file.endswith(place)
    return is_listed or Path(file).resolve() == Path(name).resolve()


def _may_have_others(name: str) -> bool:
    """Return whether to open a file for others: of remote ones only virtual rasters."""
    is_remote = local_file(name) is None and name.startswith(("/vsi", "http", "s3:", "gs:", "az:"))
    return not is_remote or name.endswith((".vrt", ".VRT"))
