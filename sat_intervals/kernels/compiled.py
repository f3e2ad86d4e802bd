"""Kernels whose machine code is kept from one process to the next.

The folder is named after the kernels' sources, and after the constants that they freeze: numba itself looks at the file
of a kernel alone, and not at those of the kernels that it calls.
"""

import hashlib
import os
import threading
from functools import cache
from pathlib import Path

from numba import config, njit


def fingerprint(package: Path) -> str:
    """Tell the kernels of a package from those of any other version."""
    digest = hashlib.sha256()
    for source in (*sorted((package / "kernels").glob("*.py")), package / "products.py"):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


FINGERPRINT = fingerprint(Path(__file__).parents[1])
_LOCK = threading.Lock()


def cached(kernel):
    """Compile a kernel that releases the GIL, once a machine.

    numba takes the folder from its configuration while it decorates. The configuration is put back at once: everybody
    else's cached functions follow it too. Where no folder can be written, every process compiles for itself.
    """
    folder = _folder()
    if folder is None:
        return njit(nogil=True)(kernel)
    with _LOCK:
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        try:
            return njit(nogil=True, cache=True)(kernel)
        finally:
            config.CACHE_DIR = before


@cache
def _folder() -> Path | None:
    """Where numba's own setting says, else in the user's cache; None where that cannot be written.

    Never in a place that others can foresee: numba loads what it finds there.
    """
    place = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        folder = Path(place).expanduser() / "sat-intervals" / FINGERPRINT
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return None
    return folder if os.access(folder, os.W_OK) else None
