"""Compilation of kernels, with machine code cached between processes.

The cache folder is named by a digest of all kernel sources and of the constants that they freeze: numba itself checks
only the file of a kernel, not the files of the kernels that it calls.
"""

import hashlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numba
from numba import config, njit


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


@cache
def _folder() -> str:
    """Cache folder in NUMBA_CACHE_DIR, else in the user's cache; empty where it is not writable."""
    place = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        folder = Path(place).expanduser() / "sat-intervals" / FINGERPRINT
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return ""
    return str(folder) if os.access(folder, os.W_OK) else ""


@contextmanager
def _own_folder() -> Iterator[None]:
    """Cache what is decorated in the block in our folder. numba reads it from a global that applies to all packages."""
    with _LOCK:
        before, config.CACHE_DIR = config.CACHE_DIR, _folder() or config.CACHE_DIR
        try:
            yield
        finally:
            config.CACHE_DIR = before


def cached(kernel):
    """Compile a kernel that releases the GIL; without a writable folder, in every process again."""
    with _own_folder():
        return njit(nogil=True, cache=bool(_folder()), no_cfunc_wrapper=True)(kernel)


@contextmanager
def kernels_of_others() -> Iterator[None]:
    """Let packages that are imported in the block cache their kernels in our folder, without ``fastmath``, serial."""
    # With ``fastmath``, results depend on the processor, and on whether this process has compiled the code or read it.
    # ``parallel`` loops over the few points of a call wait for their threads: on busy cores 18 times as long.
    with _own_folder():
        numba.njit = lambda *signature, fastmath=False, parallel=False, **options: njit(*signature, **options)
        try:
            yield
        finally:
            numba.njit = njit
