"""Find the memory and the cores that this process may use: in a container or a job, less than the machine has."""

import os
import re
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
    """Yield memory limits (bytes) of this process's cgroup and its ancestors; ``root`` contains ``proc`` and mounts."""
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
    """Yield the folders of this process's cgroup and of its mounted ancestors.

    A controller either has its own hierarchy (version 1) or belongs to the common one (version 2). The common hierarchy
    may also exist without this controller.
    """
    try:
        groups, mounts = (
            (root / "proc/self" / name).read_text(errors="surrogateescape").split("\n")[:-1]
            for name in ("cgroup", "mountinfo")
        )
    except OSError:  # not Linux
        return
    paths = {}
    for line in groups:
        _, controllers, path = line.split(":", 2)
        if not controllers:
            paths["cgroup2"] = path
        elif controller in controllers.split(","):
            paths["cgroup"] = path
    for line in mounts:
        place, _, system = line.partition(" - ")
        kind, _, options = system.split(" ", 2)
        if kind not in paths or (kind == "cgroup" and controller not in options.split(",")):
            continue
        top, point = (re.sub(r"\\(\d{3})", lambda code: chr(int(code[1], 8)), text) for text in place.split(" ")[3:5])
        names = _below(paths[kind], top)
        if names is not None:
            yield from (root.joinpath(point.lstrip("/"), *names[:depth]) for depth in range(len(names), -1, -1))


def _below(path: str, top: str) -> list[str] | None:
    """Return the path from the cgroup at the top of a mount down to ``path``; None if ``path`` is not below it.

    A container may see only part of the hierarchy. Both paths start at the root of its cgroup namespace, and ``..``
    means above it. For a mount from above, the names down to that root are unknown.
    """
    names, tops = ([name for name in text.split("/") if name] for text in (path, top))
    rest = names[len(tops) :]
    if names[: len(tops)] == tops and ".." not in rest:
        return rest
    return [] if tops.count("..") == len(tops) > names.count("..") else None
