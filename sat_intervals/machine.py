"""Memory and cores that this process may use, which in a container or a batch job are less than the machine's."""

import os
import re
import resource
from collections.abc import Iterator
from pathlib import Path

_ROOT = Path("/")


def usable_memory() -> int:
    """Bytes: the least of physical memory, the limit of the address space, and the limits of cgroups."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_memory_limits(_ROOT)]
    address_space, _ = resource.getrlimit(resource.RLIMIT_AS)
    return min(limits if address_space == resource.RLIM_INFINITY else [*limits, address_space])


def usable_cores() -> int:
    """The least of the cores that this process may run on, and the quotas of cgroups; at least 1."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min([affinity, *_core_limits(_ROOT)])


def _memory_limits(root: Path) -> Iterator[int]:
    """Limits in bytes of this process's cgroup and of its ancestors; ``root`` holds ``proc`` and the mount points."""
    for folder in _cgroups(root, "memory"):
        yield from _numbers(folder / "memory.max")
        yield from _numbers(folder / "memory.limit_in_bytes")  # version 1; without limit a number near 2**63


def _core_limits(root: Path) -> Iterator[int]:
    """Cores that the quotas of this process's cgroup and of its ancestors are worth."""
    for folder in _cgroups(root, "cpu"):
        one = [*_numbers(folder / "cpu.cfs_quota_us"), *_numbers(folder / "cpu.cfs_period_us")]
        for figures in (_numbers(folder / "cpu.max"), one):
            if len(figures) == 2 and min(figures) > 0:  # version 1 has the quota -1 for none
                quota, period = figures
                # Rounded up: tiles do not wait for each other, so workers held back now and then use the whole quota;
                # rounded down, up to half of it would stay idle.
                yield -(-quota // period)


def _numbers(file: Path) -> list[int]:
    """Whole numbers in a file; none if it is absent, as in the root cgroup, or says ``max``."""
    try:
        return [int(word) for word in file.read_text().split()]
    except (OSError, ValueError):
        return []


def _cgroups(root: Path, controller: str) -> Iterator[Path]:
    """Folders of this process's cgroup and of its ancestors, as far up as they are mounted.

    A controller has a hierarchy of its own (version 1), or is part of the common one (version 2), or the common one is
    there without it.
    """
    try:
        groups, mounts = (
            (root / "proc/self" / name).read_text(errors="surrogateescape").split("\n")[:-1]
            for name in ("cgroup", "mountinfo")
        )
    except OSError:  # no Linux
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
    """Names that lead from the cgroup at the top of a mount down to the one at ``path``; None if it is not below.

    A container may see a part of the hierarchy only. Both paths start from the root of its cgroup namespace, with
    ``..`` for what is above; of a mount from above it, the names down to that root cannot be known.
    """
    names, tops = ([name for name in text.split("/") if name] for text in (path, top))
    rest = names[len(tops) :]
    if names[: len(tops)] == tops and ".." not in rest:
        return rest
    return [] if tops.count("..") == len(tops) > names.count("..") else None
