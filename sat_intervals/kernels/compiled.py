"""Compilation of kernels, with machine code cached between processes.

The cache folder is named by a digest of all kernel sources and of the constants that they freeze: numba itself checks
only the file of a kernel, not the files of the kernels that it calls.
"""

import hashlib
import os
import threading
from contextlib import suppress
from functools import cache
from pathlib import Path

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


def cached(kernel):
    """Compile a kernel that releases the GIL, and cache its machine code on disk.

    numba reads the cache folder from its global configuration while it decorates. The configuration is restored at
    once, because it applies to the cached functions of other packages too. Without a writable folder, every process
    compiles the kernels again.
    """
    folder = _folder()
    if folder is None:
        return njit(nogil=True)(kernel)
    with _LOCK:
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        try:
            return _healing(njit(nogil=True, cache=True)(kernel))
        finally:
            config.CACHE_DIR = before


def _healing(kernel):
    """Let a kernel be compiled again if its cache is damaged, as after a power loss; numba would fail for good."""
    cached = getattr(kernel, "_cache", None)
    if cached is None:  # numba compiles nothing, with NUMBA_DISABLE_JIT
        return kernel
    load = cached.load_overload

    def load_or_drop(*arguments):
        try:
            return load(*arguments)
        except OSError:
            raise
        except Exception as error:  # whatever unpickling damaged bytes raises
            with suppress(OSError):  # then the next process compiles it again, too
                cached.flush()
            if isinstance(error, MemoryError):
                raise
            return None

    cached.load_overload = load_or_drop
    return kernel


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
