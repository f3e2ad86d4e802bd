"""A real SLURM of one node on loopback: cancelled jobs, and jobs that reach their time limit."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import dask
import psutil
import pytest
import yaml
from helpers import COMMAND, LOCK, hashes, wait_until

from sat_intervals import SatIntervalsError
from sat_intervals.config import Cluster
from sat_intervals.errors import RunError
from sat_intervals.run.batch_system import job_script
from sat_intervals.run.submit import DaskWorkers


@contextmanager
def submitted(
    pair,
    folder: Path,
    status: int = 0,
    own: dict[str, object] | None = None,
    programs: str = "",
    constants: dict[str, float] | None = None,
    is_quiet: bool = True,
    **cluster: object,
):
    """``match --cluster slurm`` with one job, under a user's ``own`` dask configuration; ``programs`` come first.

    ``constants`` are those of `run.submit`; where it ends well and ``is_quiet`` it must say nothing.
    """
    settings = yaml.safe_load((pair / "settings.yaml").read_text())
    folder.mkdir(exist_ok=True)
    job = {"jobs": 1, "cores": 1, "memory": "2GB", "walltime": "00:05:00"} | cluster
    (folder / "settings.yaml").write_text(yaml.safe_dump(settings | {"cluster": job}))
    own = {
        "JOBQUEUE__SLURM__INTERFACE": "lo",
        "JOBQUEUE__SLURM__LOCAL_DIRECTORY": str(folder),
        "DISTRIBUTED__DEPLOY__LOST_WORKER_TIMEOUT": "2s",
    } | (own or {})
    code = "from sat_intervals import cli; from sat_intervals.run import submit; "
    code += f"vars(submit).update({constants or {}}); cli.main()"
    command = [sys.executable, "-c", code, "match", pair / "left.tif", pair / "right.tif", folder / "out"]
    command += ["--config", folder / "settings.yaml", "--cluster", "slurm", "--quiet"]
    with (folder / "log").open("w") as log:
        environment = os.environ | {f"DASK_{name}": str(value) for name, value in own.items()}
        environment["PATH"] = f"{programs}:{environment['PATH']}".lstrip(":")
        process = subprocess.Popen(list(map(str, command)), stdout=log, stderr=subprocess.STDOUT, env=environment)
    try:
        yield process
        assert process.wait(400) == status, (folder / "log").read_text()
        if status == 0 and is_quiet:
            assert (folder / "log").read_text() == ""
    finally:
        process.kill()
        process.wait()
        subprocess.run(["scancel", "--user", "root"], check=True, timeout=30)


def wait_for_files(process: subprocess.Popen, folder: Path, files: str, count: int) -> None:
    tiles = folder / "out" / "tiles"
    wait_until(lambda: len(list(tiles.glob(files))) >= count or process.poll() is not None, files, 60)
    assert process.poll() is None, "ended before it was disturbed"


def wait_for_tiles(process: subprocess.Popen, folder: Path, count: int) -> None:
    wait_for_files(process, folder, "tiles/[0-9]*.npz", count)


def jobs(state: str = "RUNNING") -> set[str]:
    """Running and waiting jobs."""
    command = ["squeue", "--noheader", "--states", state, "--format", "%A"]
    return set(subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout.split())


def workers(folder: Path) -> list[psutil.Process]:
    """The processes of the jobs of a run."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.NoSuchProcess):
            if "dask_worker" in " ".join(process.cmdline()) and str(folder) in process.cmdline():
                found += [process, *process.children(recursive=True)]
    return found


def assert_complete(pair, out: Path) -> None:
    assert hashes(out) == hashes(pair / "undisturbed")
    assert {path.name for path in out.iterdir()} - {"logs", LOCK} == {"intervals.tif", "run.json", "validity.tif"}


def test_match__goes_on_in_a_new_job_after_scancel(slurm, pair, tmp_path):
    with submitted(pair, tmp_path, own={"JOBQUEUE__SLURM__LOG_DIRECTORY": tmp_path / "own-logs"}) as process:
        before = set()
        for files, count in (("borders/[0-9]*", 20), ("tiles/[0-9]*.npz", 5)):  # in both phases
            wait_for_files(process, tmp_path, files, count)
            (job,) = jobs() - before
            before.add(job)
            subprocess.run(["scancel", job], check=True, timeout=30)
    assert list((tmp_path / "own-logs").glob("*.err"))
    assert_complete(pair, tmp_path / "out")
    wait_until(lambda: not jobs(), "end of the jobs", 40)


def test_match__goes_on_in_a_new_job_when_the_walltime_ends(slurm, pair, tmp_path):
    with submitted(pair, tmp_path, walltime="00:01:00", is_quiet=False) as process:  # it says whom it waits for
        wait_for_tiles(process, tmp_path, 5)
        (job,) = jobs()
        for worker in workers(tmp_path):  # a pair that takes a minute would do as well
            worker.send_signal(signal.SIGSTOP)
        wait_until(lambda: job not in jobs(), "end of the job's time", 130)
        assert process.poll() is None
    assert_complete(pair, tmp_path / "out")


@pytest.mark.peer("dask_jobqueue")
@pytest.mark.parametrize(
    "command", ["match left.tif right.tif", "surface left.tif right.tif --resolution 1", "batch -"]
)
def test_commands__print_the_job_script_and_submit_nothing(pair, tmp_path, command):
    settings = yaml.safe_load((pair / "settings.yaml").read_text())
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump(settings | {"cluster": {"cores": 2, "memory": "3GB"}}))
    words = [COMMAND, *command.split(), tmp_path / "out", "--config", tmp_path / "settings.yaml"]
    words += ["--cluster", "slurm", "--dry-run"]
    script = subprocess.run(words, cwd=pair, capture_output=True, text=True, check=True).stdout.splitlines()
    assert {"#SBATCH --cpus-per-task=2", "#SBATCH --mem=3G"} <= set(script)
    assert f"#SBATCH -e {tmp_path}/out/logs/dask-worker-%J.err" in script
    assert [path.name for path in tmp_path.iterdir()] == ["settings.yaml"]


@pytest.mark.peer("dask_jobqueue")
@pytest.mark.parametrize(
    ("kind", "lines"),
    [
        ("slurm", {"#SBATCH -p day", "#SBATCH -A dinamis", "#SBATCH --cpus-per-task=2", "#SBATCH -t 01:30:00"}),
        ("pbs", {"#PBS -q day", "#PBS -A dinamis", "#PBS -l select=1:ncpus=2:mem=3815MB", "#PBS -l walltime=01:30:00"}),
        ("lsf", {"#BSUB -q day", '#BSUB -P "dinamis"', "#BSUB -n 2", "#BSUB -W 01:30"}),
        ("sge", {"#$ -q day", "#$ -P dinamis", "#$ -l h_rt=01:30:00"}),
    ],
)
def test_job_script__says_what_is_set_as_each_batch_system_takes_it(tmp_path, kind, lines):
    given = {"cores": 2, "memory": "4GB", "walltime": "01:30:00", "queue": "day", "account": "dinamis"}
    script = job_script(Cluster(kind=kind, directives=["--exclusive"], **given), tmp_path / "out").splitlines()
    assert lines <= set(script)
    assert any(line.endswith(" --exclusive") for line in script)
    with pytest.raises(SatIntervalsError, match=rf"cluster {kind} needs the memory of a job: set cluster\.memory"):
        job_script(Cluster(kind=kind), tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.peer("dask_jobqueue")
@pytest.mark.parametrize(("store", "threads"), [(None, ["2"]), ("s3://bucket/tiles", ["2", "3"])])
def test_job_script__has_one_more_thread_that_reads_and_writes_tiles_in_a_bucket(tmp_path, store, threads):
    with dask.config.set({"jobqueue.slurm.worker-extra-args": ["--lifetime", "1h"]}):
        script = job_script(Cluster(kind="slurm", cores=2, memory="4GB", store=store), tmp_path / "out")
    assert re.findall(r"--nthreads (\d+)", script) == threads  # the last one holds
    assert "--cpus-per-task=2" in script
    assert "--lifetime 1h" in script


def sbatch(folder: Path, script: str) -> str:
    """A folder with an ``sbatch`` that wraps SLURM's own, which is in $SBATCH."""
    (folder / "programs").mkdir()
    program = folder / "programs" / "sbatch"
    program.write_text(f"#!/bin/sh\nSBATCH={shutil.which('sbatch')}\n{script}\n")
    program.chmod(0o755)
    return str(program.parent)


def test_match__waits_for_the_first_worker_and_says_so(slurm, pair, tmp_path):
    programs = sbatch(tmp_path, 'exec $SBATCH --begin=now+15 "$@"')
    with submitted(pair, tmp_path, programs=programs, constants={"_WARN_EVERY": 4, "WORKERS_GONE": 5}, is_quiet=False):
        pass
    lines = (tmp_path / "log").read_text().splitlines()
    assert 1 <= len(lines) <= 20
    assert all("there is no worker yet" in line and str(tmp_path / "out" / "logs") in line for line in lines)
    assert_complete(pair, tmp_path / "out")


def test_outcomes__warn_once_a_minute_while_there_is_no_worker_and_end_minutes_after_the_last(monkeypatch, caplog):
    seconds, cores = [0.0], {}
    monkeypatch.setattr(time, "monotonic", lambda: seconds[0])
    system = SimpleNamespace(refusals=[], submitted={"1"}, logged="/logs")
    workers = DaskWorkers(SimpleNamespace(cluster=system, nthreads=lambda: dict(cores)))
    for seconds[0] in range(0, 3600, 4):
        assert workers._limit() == 2
    assert 55 <= len(caplog.messages) <= 60
    assert "/logs" in caplog.messages[0]
    cores["one"] = 2
    seconds[0] += 4
    assert workers._limit() == 4
    cores.clear()
    seconds[0] += 299
    workers._limit()
    seconds[0] += 4
    with pytest.raises(RunError, match=r"none has started for 300 s: .* /logs; rerun the same command"):
        workers._limit()


def test_match__ends_when_the_batch_system_takes_no_job(slurm, pair, tmp_path):
    refused = tmp_path / "refused"
    with submitted(pair, refused, 2, queue="nowhere"):
        pass
    log = (refused / "log").read_text()
    assert log.startswith("sat-intervals: the batch system refuses the job: sbatch: error: invalid partition specified")
    assert len(log.splitlines()) == 1
