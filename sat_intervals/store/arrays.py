"""The one form of intermediate files: a NumPy ``.npz``, an uncompressed zip of arrays with a member ``meta`` in JSON.

``zipfile`` compares each member with its CRC-32 as it is read, and ``np.load`` opens the files, too.
"""

import errno
import json
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from io import BytesIO
from typing import Any

import numpy as np

from sat_intervals.products import as_json
from sat_intervals.store.folder import Folder

META = "meta"
# What a damaged file raises: its zip, a member, or the header of an array.
_DAMAGES = zipfile.BadZipFile, ValueError, KeyError, EOFError, RuntimeError, OverflowError, struct.error, zlib.error


class DamagedFileError(Exception):
    """A file that is missing, damaged, or of another run."""


class Archive:
    """An open file; its methods raise `DamagedFileError`."""

    def __init__(self, archive: zipfile.ZipFile, of: str) -> None:
        """Open a file that was written for ``of``."""
        self._archive = archive
        with _damage_noticed():
            self.meta: dict[str, Any] = json.loads(archive.read(META))
            if self.meta["of"] != of:
                raise ValueError(of)

    def names(self) -> list[str]:
        """Return the names of its arrays; the directory of a zip has no checksum, ``meta`` has one."""
        return list(self.meta["names"])

    def is_intact(self) -> bool:
        """Return whether all of it agrees with its checksums."""
        with _damage_noticed():
            return self._archive.testzip() is None and all(map(self._archive.getinfo, map(_member, self.names())))

    def __getitem__(self, name: str) -> np.ndarray:
        """Read an array, which cannot be written to."""
        with _damage_noticed():
            content = self._archive.read(_member(name))
            stream = BytesIO(content)
            np.lib.format.read_magic(stream)
            shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
            return np.frombuffer(content, dtype, offset=stream.tell()).reshape(shape)


def _member(name: str) -> str:
    return f"{name}.npy"


@contextmanager
def _damage_noticed() -> Iterator[None]:
    """Turn what damage raises into a DamagedFileError."""
    try:
        yield
    except (FileNotFoundError, *_DAMAGES) as error:
        raise DamagedFileError(error) from error
    except OSError as error:
        if error.errno == errno.EINVAL:  # a damaged offset
            raise DamagedFileError(error) from error
        raise


def packed(arrays: Iterable[tuple[str, np.ndarray]], meta: Mapping[str, Any]) -> memoryview:
    """Return the content of a file; equal arrays and meta give equal bytes."""
    stream, names = BytesIO(), []
    with zipfile.ZipFile(stream, "w") as archive:
        for name, array in arrays:
            names.append(name)
            array = np.ascontiguousarray(array)
            with archive.open(zipfile.ZipInfo(_member(name)), "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, np.lib.format.header_data_from_array_1_0(array))
                member.write(array.reshape(-1).view(np.uint8).data)
            del array
        record = as_json({**meta, "names": names}, indent=None)  # completed by ``arrays``
        archive.writestr(zipfile.ZipInfo(META), record)
    return stream.getbuffer()


def numbered(arrays: Iterable[np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    """Name arrays by their numbers, for `packed`."""
    return ((str(number), array) for number, array in enumerate(arrays))


@contextmanager
def unpacked(folder: Folder, name: str, of: str) -> Iterator[Archive]:
    """Open a file of a folder for reading some of its arrays; DamagedFileError if it is not there for ``of``."""
    with ExitStack() as stack:
        with _damage_noticed():
            stream = stack.enter_context(folder.opened(name))
            archive = stack.enter_context(zipfile.ZipFile(stream))
        yield Archive(archive, of)
