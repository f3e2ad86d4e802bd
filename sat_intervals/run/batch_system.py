"""Jobs of a batch system, SLURM, PBS, LSF or SGE, by dask-jobqueue."""

import logging
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Status

from sat_intervals.config import Cluster
from sat_intervals.errors import RunError, SatIntervalsError

# Seconds without any worker of a batch system, after there were some, at which a run ends.
WORKERS_GONE = 300.0
# Seconds from one word on the first worker, for which a run waits, to the next.
_TOLD_EVERY = 60.0

# Batch systems that know projects and no accounts.
_CHARGE_PROJECTS = "lsf", "sge"

LOOPBACK = "127.0.0.1"

_LOG = logging.getLogger(__name__)


def batch_system(settings: Cluster, logs: Path) -> Any:
    """The dask-jobqueue cluster of SLURM, PBS, LSF or SGE; what is not set comes from the user's dask configuration."""
    try:
        import dask_jobqueue
    except ImportError as error:
        raise SatIntervalsError(
            f"cluster {settings.kind} needs dask-jobqueue: pip install sat-intervals[cluster]"
        ) from error
    base: Any = getattr(dask_jobqueue, f"{settings.kind.upper()}Cluster")
    own_logs = dask.config.get(f"jobqueue.{settings.kind}.log-directory", None)
    given = _given(settings, own_logs, logs)
    logged = given.get("log_directory") or own_logs or os.getcwd()
    submitted: set[str] = set()
    refusals: list[str] = []
    own = {"job_cls": _job_class(base.job_cls, submitted, refusals), "logged": logged}
    # Of `workers_there`: what it judges by, when a worker was there, when the wait was told of.
    own |= {"submitted": submitted, "refusals": refusals, "seen": None, "told": time.monotonic()}
    try:
        return type(base.__name__, (base,), own)(**given, silence_logs=logging.CRITICAL)
    except ValueError as error:  # of settings that neither the section nor dask's own configuration gives
        raise SatIntervalsError(f"cluster {settings.kind}: {' '.join(str(error).split())}") from error


def _given(settings: Cluster, own_logs: str | None, logs: Path) -> dict[str, Any]:
    """What dask-jobqueue is to be called with, beside the user's dask configuration."""
    options = {
        "queue": settings.queue,
        "project" if settings.kind in _CHARGE_PROJECTS else "account": settings.account,
        "cores": settings.cores,
        "processes": 1,
        "memory": settings.memory,
        "walltime": _without_seconds(settings.walltime) if settings.kind == "lsf" else settings.walltime,
        "job_extra_directives": settings.directives,
    }
    if settings.memory is None and dask.config.get(f"jobqueue.{settings.kind}.memory", None) is None:
        raise SatIntervalsError(
            f"cluster {settings.kind} needs the memory of a job: set cluster.memory, such as 4GB, or "
            f"jobqueue.{settings.kind}.memory of dask's configuration"
        )
    given: dict[str, Any] = {name: value for name, value in options.items() if value not in (None, [])}
    if not dask.config.get(f"jobqueue.{settings.kind}.scheduler-options", {}):
        given["scheduler_options"] = {"dashboard_address": f"{LOOPBACK}:0"}
    # Jobs may not see the folder of a run whose tiles lie elsewhere, and their scripts take no spaces.
    if own_logs is None and settings.store is None and not any(map(str.isspace, str(logs.absolute()))):
        given["log_directory"] = str(logs.absolute())
    return given


def _job_class(base: Any, submitted: set[str], refusals: list[str]) -> type:
    """Jobs that note here whether the batch system took them, and that can be closed in any case."""

    class Job(base):  # type: ignore[misc]
        async def start(self) -> None:
            try:
                await super().start()
            except RuntimeError as error:  # which dask keeps to itself
                refusals.append(str(error).rpartition("stderr:")[2])
                self.status = Status.failed  # else it could not be closed
                raise
            submitted.add(self.job_id)

        async def close(self) -> None:
            await super().close()
            self.status = Status.closed  # dask asserts it of every job that is not garbage by then

    return Job


def _without_seconds(walltime: str | None) -> str | None:
    """Hours and minutes, as LSF wants them."""
    return ":".join(walltime.split(":")[:2]) if walltime else None


def job_script(settings: Cluster, out: Path) -> str:
    """The script of one job of a batch system, as it would be submitted.

    Raises
    ------
    SatIntervalsError
        For a cluster that submits no jobs.
    """
    if settings.kind in ("threads", "processes", "address"):
        raise SatIntervalsError(f"cluster {settings.kind} submits no jobs: name slurm, pbs, lsf or sge")
    new = [folder for folder in (out / "logs", out) if not folder.exists()]  # dask-jobqueue makes them
    with batch_system(settings, out / "logs") as cluster:
        script = str(cluster.job_script())
    for folder in new:
        with suppress(OSError):
            folder.rmdir()
    return script


def workers_there(client: Client) -> dict[str, int]:
    """Addresses and cores of the workers that a client has. Called every few seconds, it ends a wait that is in vain.

    For the first worker of a batch system it waits without limit, and says so once a minute.

    Raises
    ------
    SatIntervalsError
        When the batch system took no job.
    RunError
        When its last worker has gone, and none has come since for WORKERS_GONE seconds.
    """
    cores: dict[str, int] = client.nthreads()
    cluster: Any = client.cluster
    if not hasattr(cluster, "refusals"):
        return cores
    now = time.monotonic()
    if cores:
        cluster.seen = now
    elif cluster.refusals and not cluster.submitted:
        raise SatIntervalsError(
            f"the batch system refuses the job: {' '.join(cluster.refusals[0].split())}: check the section cluster"
        )
    elif cluster.seen is None and now - cluster.told >= _TOLD_EVERY:
        cluster.told = now
        _LOG.warning(
            "no worker has come yet: jobs wait in the queue of the batch system, or ended before, of which their logs "
            "in %s tell",
            cluster.logged,
        )
    elif cluster.seen is not None and now - cluster.seen > WORKERS_GONE:
        raise RunError(
            f"the last worker has gone and none has come for {WORKERS_GONE:.0f} s: of the jobs their logs in "
            f"{cluster.logged} tell; the same command goes on from the tiles that are done"
        )
    return cores
