"""SLURM of one node on loopback, with a state, ports and a munge key of its own."""

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import psutil
import pytest
from helpers import wait_until

PROGRAMS = ("munged", "slurmctld", "slurmd")
CONFIGURATION = """\
ClusterName=tests
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
AuthType=auth/munge
AuthInfo=socket={folder}/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
ReturnToService=2
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SchedulerType=sched/backfill
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
NodeName=localhost NodeAddr=127.0.0.1 CPUs={cores} RealMemory={megabytes} State=UNKNOWN
PartitionName=debug Nodes=localhost Default=YES MaxTime=INFINITE State=UP
"""


@pytest.fixture(scope="session")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A running SLURM; SLURM_CONF names its configuration."""
    if os.geteuid() or not all(map(shutil.which, PROGRAMS)):
        pytest.skip("SLURM needs root, and apt-get install slurm-wlm munge")
    folder = tmp_path_factory.mktemp("slurm")
    folder.chmod(0o755)
    key, conf = folder / "munge.key", folder / "slurm.conf"
    key.touch(0o600)
    key.write_bytes(os.urandom(128))
    for name in ("state", "spool"):
        (folder / name).mkdir()
    megabytes = int(psutil.virtual_memory().total * 0.8 / 2**20)
    conf.write_text(CONFIGURATION.format(folder=folder, ports=_ports(2), cores=os.cpu_count(), megabytes=megabytes))
    munge = ["munged", "--foreground", "--force", f"--socket={folder}/munge", f"--key-file={key}"]
    munge += [f"--{name}-file={folder}/munge.{name}" for name in ("pid", "log", "seed")]
    with pytest.MonkeyPatch.context() as patch, ExitStack() as running:
        patch.setenv("SLURM_CONF", str(conf))
        _start(running, munge, folder)
        wait_until((folder / "munge").exists, "munge")
        _start(running, ["slurmctld", "-D", "-f", conf], folder)
        _start(running, ["slurmd", "-D", "-f", conf, "-N", "localhost"], folder)
        wait_until(lambda: "idle" in _said("sinfo", "-h", "-o", "%t"), f"SLURM, see {folder}")
        yield
        _said("scancel", "--user", "root")
        wait_until(lambda: not _said("squeue", "--noheader"), "end of the jobs")


def _ports(count: int) -> list[int]:
    with ExitStack() as opened:
        sockets = [opened.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


def _start(running: ExitStack, command: list[object], folder: Path) -> None:
    """Start a daemon; it ends with ``running``."""
    log = running.enter_context((folder / f"{command[0]}.log").open("w"))
    process = subprocess.Popen(list(map(str, command)), stdout=log, stderr=subprocess.STDOUT)
    running.callback(process.wait, 30)
    running.callback(process.terminate)


def _said(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=30).stdout
