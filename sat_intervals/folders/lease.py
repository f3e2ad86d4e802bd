"""The lock of a remote folder: an object that its owner signs again and again for as long as it lives.

A lease that was not signed for TAKEN_OVER seconds, by the clock of whoever watches it, is taken over. Two clocks are
never compared. What holds:

- Where the service creates objects on condition, as S3 does, of several runs that find no lease one gets it. Elsewhere,
  and where several take over the same lease, the last that wrote it, unless one of them halts for longer than SETTLED
  seconds between its look and its writing.
- A run that halts for longer than TAKEN_OVER seconds, or cannot reach the service, may find another in its place, and
  stops. It looks whenever it signs, and, where its signature is older than TAKEN_OVER seconds, before it goes on with
  anything.
"""

import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import Protocol, Self

from sat_intervals.errors import RunError, SatIntervalsError

# Seconds.
SIGNED_EVERY, TAKEN_OVER, SETTLED = 5.0, 20.0, 1.0

_LEASE = "lease.json"


class Place(Protocol):
    """A folder that can tell whether it was the first to write a file."""

    def create(self, name: str, text: str) -> bool:
        """Write a file unless it is there."""

    def read(self, name: str) -> str | None:
        """Text of a file."""

    def write(self, name: str, text: str) -> None:
        """Write a file."""

    def delete(self, name: str) -> None:
        """Delete a file."""


class Lease:
    """The lease of this process, signed from the time its context is entered until it is left."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._owner = uuid.uuid4().hex
        self._signed = time.time()
        self._lost = False
        self._ended = threading.Event()
        self._signing = threading.Thread(target=self._sign_on, name="lease", daemon=True)

    def text(self) -> str:
        """What the lease says at this moment."""
        who = {"owner": self._owner, "host": socket.gethostname(), "process": os.getpid()}
        return json.dumps(who | {"signed": datetime.now(UTC).isoformat()})

    def is_mine(self) -> bool:
        """Whether the lease that is there is that of this process."""
        there = self._place.read(_LEASE)
        return there is not None and _content(there).get("owner") == self._owner

    def check(self) -> None:
        """Raise a RunError where another run has taken over."""
        if time.time() - self._signed > TAKEN_OVER:
            self._look()
        if self._lost:
            raise RunError(
                f"another run has taken over {self._place}, as it may where one gives no sign of life for "
                f"{TAKEN_OVER:.0f} s: leave it to that run, or run the same command again after its end"
            )

    def _look(self) -> None:
        self._lost = self._lost or not self.is_mine()

    def _sign_on(self) -> None:
        while not self._lost and not self._ended.wait(SIGNED_EVERY):
            with suppress(OSError):  # the service may come back in time
                now = time.time()
                self._look()
                if not self._lost:
                    self._place.write(_LEASE, self.text())
                    self._signed = now

    def __enter__(self) -> Self:
        self._signing.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._signing.join()
        with suppress(OSError):  # a lease that is left runs out
            if self.is_mine():
                self._place.delete(_LEASE)


def taken(place: Place, waiting: Callable[[], None]) -> Lease:
    """The lease of a folder, once no other run has it.

    Raises
    ------
    SatIntervalsError
        When another run gives a sign of life.
    """
    lease = Lease(place)
    while not place.create(_LEASE, lease.text()):
        there = place.read(_LEASE)
        if there is None:
            continue
        waiting()
        if _is_left(place, there):
            place.write(_LEASE, lease.text())
            break
    time.sleep(SETTLED)
    if not lease.is_mine():
        raise SatIntervalsError(f"another run has just begun in {place}: wait for its end or choose another --store")
    return lease


def _is_left(place: Place, there: str) -> bool:
    """Whether a lease stays as it is; False where its owner gives it up, an error where it is signed again."""
    seen = time.monotonic()
    while time.monotonic() - seen < TAKEN_OVER:
        time.sleep(1.0)
        now = place.read(_LEASE)
        if now is None:
            return False
        if now != there:
            who = _content(now)
            raise SatIntervalsError(
                f"another run, process {who.get('process')} on {who.get('host')}, is at work in {place}: wait for its "
                f"end or choose another --store (a run that gives no sign of life for {TAKEN_OVER:.0f} s is taken over)"
            )
    return True


def is_fresh(place: Place) -> bool:
    """Whether a lease was signed lately, by the clock of this machine: good enough to be told."""
    there = place.read(_LEASE)
    if there is None:
        return False
    try:
        signed = datetime.fromisoformat(_content(there)["signed"])
    except (KeyError, ValueError):
        return False
    return datetime.now(UTC) - signed < timedelta(seconds=TAKEN_OVER)


def _content(text: str) -> dict[str, str]:
    """What a lease says; nothing where it is none of ours."""
    try:
        content = json.loads(text)
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}
