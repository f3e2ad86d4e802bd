"""Report progress and time the stages of a run."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

Progress = Callable[[str, int, int], None]
"""Callback with the name of a stage, the amount done, and the total amount."""

_LOG = logging.getLogger(__name__)


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the seconds that the block takes to ``seconds[stage]``."""
    started = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - started


def add_seconds(seconds: dict[str, float], more: Mapping[str, float]) -> None:
    """Add seconds by stage."""
    for stage, took in more.items():
        seconds[stage] = seconds.get(stage, 0.0) + took


@contextmanager
def clocked(seconds: dict[str, float], progress: Progress) -> Iterator[Progress]:
    """Give a callback that adds the seconds from each call to the next, or the end of the block, to its stage."""
    last = "start", time.perf_counter()

    def look(stage: str, done: int, total: int) -> None:
        nonlocal last
        before, last = last, (stage, time.perf_counter())
        add_seconds(seconds, {before[0]: last[1] - before[1]})
        progress(stage, done, total)

    yield look
    add_seconds(seconds, {last[0]: time.perf_counter() - last[1]})


@contextmanager
def logged_stage(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Time a stage as `timed` does, and log its start and end."""
    _LOG.info("stage %s begins", stage)
    before = seconds.get(stage, 0.0)
    with timed(seconds, stage):
        yield
    _LOG.info("stage %s ended after %.1f s", stage, seconds[stage] - before)
