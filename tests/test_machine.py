"""Memory and cores in containers and jobs: made-up trees of cgroups of both versions, and the kernel's own limits."""

import os
import resource
import subprocess
import sys
from functools import partial

import pytest

from sat_intervals import machine

GB = 10**9
PHYSICAL = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
NO_LIMIT = 9223372036854771712  # what version 1 says of none

IN_JOB = "9:memory:/slurm/job_7/step_0\n4:cpu,cpuacct:/slurm/job_7/step_0\n0::/"


def made_up(root, groups, limits):
    """A tree with the kernel's entry of this process, and files of limits by path below ``/sys/fs/cgroup``."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text(groups + "\n")
    for name, text in limits.items():
        file = root / "sys/fs/cgroup" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{text}\n")
    return root


@pytest.mark.parametrize(
    ("groups", "limits", "expected"),
    [
        pytest.param("0::/a/b", {"a/b/memory.max": GB, "a/memory.max": 2 * GB}, GB, id="v2 own"),
        pytest.param("0::/a/b", {"a/b/memory.max": 2 * GB, "a/memory.max": GB}, GB, id="v2 parent"),
        pytest.param("0::/a/b/c", {"a/b/c/memory.max": "max", "a/memory.max": GB}, GB, id="v2 far"),
        pytest.param("0::/a", {"a/memory.max": "max", "b/memory.max": GB}, None, id="v2 of others"),
        pytest.param("0::/", {"memory.max": GB}, GB, id="v2 namespace"),
        pytest.param("0::/docker/x", {"memory.max": GB}, GB, id="v2 container without a namespace"),
        pytest.param(
            IN_JOB,
            {
                "memory/memory.limit_in_bytes": NO_LIMIT,
                "memory/slurm/job_7/memory.limit_in_bytes": GB,
                "memory/slurm/job_7/step_0/memory.limit_in_bytes": NO_LIMIT,
            },
            GB,
            id="v1 job",
        ),
        pytest.param("5:memory:/docker/x", {"memory/memory.limit_in_bytes": GB}, GB, id="v1 container"),
        pytest.param("4:cpu,cpuacct:/\n0::/a", {"unified/a/memory.max": GB}, GB, id="hybrid, memory in v2"),
        pytest.param("0::/a", {}, None, id="no files"),
    ],
)
def test_memory_limits__are_those_of_the_cgroup_and_its_ancestors(tmp_path, groups, limits, expected):
    found = machine._memory_limits(made_up(tmp_path, groups, limits))
    assert min((limit for limit in found if limit < NO_LIMIT), default=None) == expected


def test_memory_limits__there_are_none_without_cgroups(tmp_path):
    assert list(machine._memory_limits(tmp_path)) == []
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").touch()
    assert list(machine._memory_limits(tmp_path)) == []


@pytest.mark.parametrize(
    ("groups", "limits", "expected"),
    [
        pytest.param("0::/a/b", {"a/b/cpu.max": "max 100000", "a/cpu.max": "300000 100000"}, [3], id="v2"),
        pytest.param("0::/a", {"a/cpu.max": "150000 100000"}, [2], id="rounded up"),
        pytest.param("0::/a", {"a/cpu.max": "1000 100000"}, [1], id="at least one"),
        pytest.param(
            IN_JOB,
            {
                "cpu/cpu.cfs_quota_us": -1,
                "cpu/cpu.cfs_period_us": 100_000,
                "cpu/slurm/job_7/cpu.cfs_quota_us": 400_000,
                "cpu/slurm/job_7/cpu.cfs_period_us": 100_000,
            },
            [4],
            id="v1",
        ),
    ],
)
def test_core_limits__are_quotas_over_periods(tmp_path, groups, limits, expected):
    assert list(machine._core_limits(made_up(tmp_path, groups, limits))) == expected


def test_usable_memory_and_cores__are_the_least_of_all_limits(tmp_path, monkeypatch):
    limits = {"a/memory.max": GB // 2, "a/cpu.max": "100000 100000"}
    monkeypatch.setattr(machine, "_ROOT", made_up(tmp_path / "tight", "0::/a", limits))
    assert (machine.usable_memory(), machine.usable_cores()) == (GB // 2, 1)
    limits = {"a/memory.max": 2**60, "a/cpu.max": "100000000 1000"}
    monkeypatch.setattr(machine, "_ROOT", made_up(tmp_path / "wide", "0::/a", limits))
    assert machine.usable_memory() <= PHYSICAL
    assert machine.usable_cores() == len(os.sched_getaffinity(0))


def printed(what, prepare=None, root="/"):
    """Memory or cores that a new process reports after it called ``prepare``."""
    code = f"from pathlib import Path; from sat_intervals import machine; machine._ROOT = Path({str(root)!r}); "
    command = [sys.executable, "-c", code + f"print(machine.{what}())"]
    return int(subprocess.run(command, preexec_fn=prepare, capture_output=True, check=True, timeout=60).stdout)


def test_usable_memory__is_at_most_the_address_space():
    assert printed("usable_memory", partial(resource.setrlimit, resource.RLIMIT_AS, (2**28, 2**28))) == 2**28


def test_usable_cores__are_at_most_those_of_the_affinity():
    assert printed("usable_cores", partial(os.sched_setaffinity, 0, {min(os.sched_getaffinity(0))})) == 1
