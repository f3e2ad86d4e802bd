"""The method's inner loops: arrays in, arrays out. The only home of numba.

Compiled once a machine and kept in a folder that is named after the kernels' sources, and after the constants that they
freeze: numba itself looks at the file of a kernel alone, and not at those of the kernels that it calls.
"""

import atexit
import hashlib
import os
import shutil
import tempfile
from pathlib import Path

from numba import config


def _fingerprint(package: Path) -> str:
    digest = hashlib.sha256()
    for source in (*sorted((package / "kernels").glob("*.py")), package / "products.py"):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Where numba's own setting says, else in the user's cache, else in a temporary folder of this process alone.

    Never in a place that others can foresee: numba loads what it finds there.
    """
    place = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        folder = Path(place).expanduser() / "sat-intervals" / FINGERPRINT
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return _own_folder()
    return folder if os.access(folder, os.W_OK) else _own_folder()


def _own_folder() -> Path:
    """One that goes with this process."""
    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


# Tells these kernels from those of any other version.
FINGERPRINT = _fingerprint(Path(__file__).parents[1])
config.CACHE_DIR = str(_cache_folder())
