"""Compilation of kernels beside the first run of an installation: numba uses one core of a process."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sat_intervals.config import Config
from sat_intervals.kernels.disparity import median

_COMPILE = """
import sys
from sat_intervals.config import Config
from sat_intervals.match.warm_up import compile_postprocessing
compile_postprocessing(Config.model_validate_json(sys.argv[1]))
"""


@contextmanager
def compiled_beside(config: Config) -> Iterator[None]:
    """In an installation without compiled kernels, let a second process compile those after matching meanwhile."""
    cache = getattr(getattr(median, "stats", None), "cache_path", None)  # of this installation and our kernels alone
    if cache is None or any(Path(cache).glob("*.nbi")):
        yield
        return
    any_range = config.disparity.model_copy(update={"minimum": 0, "maximum": 3})
    settings = config.model_copy(update={"disparity": any_range}).model_dump_json()
    with subprocess.Popen([sys.executable, "-c", _COMPILE, settings], stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.kill()
