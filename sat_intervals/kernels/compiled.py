"""Compilation of kernels, with machine code cached between processes.

The cache folder is named by a digest of all kernel sources and of the constants that they freeze: numba itself checks
only the file of a kernel, not the files of the kernels that it calls.
"""

import hashlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from io import BytesIO
from pathlib import Path

import numba
from numba import config, njit
from numba.core import caching
from numba.core.caching import IndexDataCacheFile


def fingerprint(package: Path) -> str:
    """Digest of the kernel sources and constants of a package: 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for source in (*sorted((package / "kernels").glob("*.py")), package / "products.py"):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


# Decorators of functions that only kernels call: without wrappers for callers in Python they compile faster.
_PART = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
part = njit(**_PART)
inlined = njit(forceinline=True, **_PART)
inlined_unchecked = njit(forceinline=True, error_model="numpy", **_PART)  # divisions by zero do not raise

FINGERPRINT = fingerprint(Path(__file__).parents[1])
_LOCK = threading.Lock()


class _CheckedFiles(IndexDataCacheFile):
    """Files of cached machine code, with digests: numba executes what it finds, also damaged, as after a power loss.

    The code says for which signature and processor it was made: two processes that save at once may leave the index of
    one with the code of the other. A kernel without right files is compiled and saved again.
    """

    def save(self, key: object, data: object) -> None:
        with suppress(OSError):  # a full disk: the next process compiles it again
            super().save(key, (str(key), data))

    def load(self, key: object) -> object:
        made_for, data = super().load(key) or ("", None)
        return data if made_for == str(key) else None

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BytesIO]:
        with super()._open_for_write(filepath) as file:
            yield (made := BytesIO())
            content = made.getvalue()
            file.write(content + hashlib.sha256(content).digest())

    def _load_index(self) -> dict[object, str]:
        with suppress(OSError):  # there is none, or it cannot be read
            if _is_intact(self._index_path):
                return super()._load_index()
        return {}

    def _load_data(self, name: str) -> object:
        if not _is_intact(path := self._data_path(name)):
            raise FileNotFoundError(path)  # numba then compiles the kernel
        return super()._load_data(name)


def _is_intact(file: str) -> bool:
    """Return whether a file ends with the digest of what comes before."""
    content = Path(file).read_bytes()
    size = hashlib.sha256().digest_size
    return hashlib.sha256(content[:-size]).digest() == content[-size:]


@contextmanager
def _checked_cache() -> Iterator[None]:
    """Let functions that are decorated in the block keep their machine code in checked files.

    numba reads the folder, and the class of the files, from its globals while it decorates. They are restored, because
    they apply to all packages. Nothing is changed without a writable folder.
    """
    folder = _folder()
    if folder is None:
        yield
        return
    with _LOCK:
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        caching.IndexDataCacheFile = _CheckedFiles
        try:
            yield
        finally:
            config.CACHE_DIR, caching.IndexDataCacheFile = before, IndexDataCacheFile


@contextmanager
def kernels_of_others() -> Iterator[None]:
    """Let a package that is imported in the block keep machine code in checked files, and compute without ``fastmath``.

    With ``fastmath``, results depend on the processor, and on whether this process has compiled the code or read it.
    """

    def exact(*signature, fastmath=False, **options):
        return njit(*signature, **options)

    with _checked_cache():
        numba.njit = exact
        try:
            yield
        finally:
            numba.njit = njit


def cached(kernel):
    """Compile a kernel that releases the GIL, and cache its machine code on disk.

    Without a writable folder, every process compiles the kernels again.
    """
    with _checked_cache():
        return njit(nogil=True, cache=_folder() is not None)(kernel)


@cache
def _folder() -> Path | None:
    """Cache folder in NUMBA_CACHE_DIR, else in the user's cache; None where it is not writable.

    The default is never a shared folder such as /tmp: numba executes the machine code that it finds.
    """
    place = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        folder = Path(place).expanduser() / "sat-intervals" / FINGERPRINT
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return None
    return folder if os.access(folder, os.W_OK) else None
