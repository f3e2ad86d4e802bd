"""Find the memory and the cores that this process may use: in a container or a job, less than the machine has."""

import os
import resource
from collections.abc import Iterator
from pathlib import Path

_ROOT = Path("/")


def usable_memory() -> int:
    """Return bytes: the least of physical memory, address-space limit and cgroup limits."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_memory_limits(_ROOT)]
    address_space, _ = resource.getrlimit(resource.RLIMIT_AS)
    return min(limits if address_space == resource.RLIM_INFINITY else [*limits, address_space])


def usable_cores() -> int:
    """Return the least of CPU affinity and cgroup quotas; at least 1."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min([affinity, *_core_limits(_ROOT)])


def _memory_limits(root: Path) -> Iterator[int]:
    """Yield memory limits (bytes) of this process's cgroup and its ancestors; ``root`` has ``proc`` and ``sys``."""
    for folder in _cgroups(root, "memory"):
        yield from _numbers(folder / "memory.max")
        yield from _numbers(folder / "memory.limit_in_bytes")  # version 1; close to 2**63 means no limit


def _core_limits(root: Path) -> Iterator[int]:
    """Yield CPU quotas, in cores, of this process's cgroup and its ancestors."""
    for folder in _cgroups(root, "cpu"):
        one = [*_numbers(folder / "cpu.cfs_quota_us"), *_numbers(folder / "cpu.cfs_period_us")]
        for figures in (_numbers(folder / "cpu.max"), one):
            if len(figures) == 2 and min(figures) > 0:  # version 1: quota -1 means no limit
                quota, period = figures
                # Round up: tiles are independent, so throttled workers still use the whole quota. Rounding down would
                # leave up to half of it idle.
                yield -(-quota // period)


def _numbers(file: Path) -> list[int]:
    """Return the integers in a file; none if it is missing (root cgroup) or contains ``max``."""
    try:
        return [int(word) for word in file.read_text().split()]
    except (OSError, ValueError):
        return []


def _cgroups(root: Path, controller: str) -> Iterator[Path]:
    """Yield the folders of this process's cgroup and of its ancestors, of versions 1 and 2; some may be missing."""
    try:
        groups = (root / "proc/self/cgroup").read_text(errors="surrogateescape").splitlines()
    except OSError:  # not Linux
        return
    mounts = root / "sys/fs/cgroup"
    for line in groups:
        _, controllers, path = line.split(":", 2)
        names = [name for name in path.split("/") if name]
        tops = [mounts / controller] if controller in controllers.split(",") else []
        for top in tops if controllers else (mounts, mounts / "unified"):
            yield from (top.joinpath(*names[:depth]) for depth in range(len(names), -1, -1))
