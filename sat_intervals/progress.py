"""How far a long call is, and how long its stages take."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, how much of it is done, and how much there is to do."""

_LOG = logging.getLogger(__name__)


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the seconds that the block takes to a stage."""
    started = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - started


@contextmanager
def logged_stage(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Like `timed`, and say in the log when the stage begins and ends."""
    _LOG.info("stage %s begins", stage)
    before = seconds.get(stage, 0.0)
    with timed(seconds, stage):
        yield
    _LOG.info("stage %s ended after %.1f s", stage, seconds[stage] - before)
