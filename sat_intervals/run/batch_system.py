"""Jobs of a batch system (SLURM, PBS, LSF or SGE) with dask-jobqueue."""

import logging
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import dask
from distributed import Status

from sat_intervals.config import Cluster
from sat_intervals.errors import SatIntervalsError
from sat_intervals.run.workers import readers

_CHARGE_PROJECTS = "lsf", "sge"  # not accounts


def batch_system(settings: Cluster, logs: Path) -> Any:
    """Create the dask-jobqueue cluster; missing settings come from the user's dask configuration."""
    try:
        import dask_jobqueue
    except ImportError as error:
        raise SatIntervalsError(
            f"cluster {settings.kind} needs dask-jobqueue: pip install 'sat-intervals[cluster]'"
        ) from error
    base: Any = getattr(dask_jobqueue, f"{settings.kind.upper()}Cluster")
    own_logs = dask.config.get(f"jobqueue.{settings.kind}.log-directory", None)
    given = _given(settings, own_logs, logs)
    logged = given.get("log_directory") or own_logs or os.getcwd()
    submitted: set[str] = set()
    refusals: list[str] = []
    own = {"submitted": submitted, "refusals": refusals, "logged": logged}
    own["job_cls"] = _job_class(base.job_cls, submitted, refusals)
    try:
        return type(base.__name__, (base,), own)(**given, silence_logs=logging.CRITICAL)
    except ValueError as error:  # a setting is neither in the section nor in dask's configuration
        raise SatIntervalsError(f"cluster {settings.kind}: {' '.join(str(error).split())}") from error


def _given(settings: Cluster, own_logs: str | None, logs: Path) -> dict[str, Any]:
    """Return the arguments for dask-jobqueue; they win over the user's dask configuration."""
    walltime = settings.walltime
    if walltime and settings.kind == "lsf":
        walltime = ":".join(walltime.split(":")[:2])  # without seconds
    options = {
        "queue": settings.queue,
        "project" if settings.kind in _CHARGE_PROJECTS else "account": settings.account,
        "cores": settings.cores,
        "processes": 1,
        "memory": settings.memory,
        "walltime": walltime,
        "job_extra_directives": settings.directives,
    }
    if settings.memory is None and dask.config.get(f"jobqueue.{settings.kind}.memory", None) is None:
        raise SatIntervalsError(
            f"cluster {settings.kind} needs the memory of a job: set cluster.memory, such as 4GB, or "
            f"jobqueue.{settings.kind}.memory of dask's configuration"
        )
    if more := readers(settings):
        own = dask.config.get(f"jobqueue.{settings.kind}.worker-extra-args", None) or []
        options["worker_extra_args"] = [*own, "--nthreads", str(settings.cores + more)]
    given: dict[str, Any] = {name: value for name, value in options.items() if value not in (None, [])}
    if not dask.config.get(f"jobqueue.{settings.kind}.scheduler-options", {}):
        given["scheduler_options"] = {"dashboard_address": "127.0.0.1:0"}
    # With an external store, jobs may not see the folder of the run. Job scripts cannot have spaces.
    if own_logs is None and settings.store is None and not any(map(str.isspace, str(logs.absolute()))):
        given["log_directory"] = str(logs.absolute())
    return given


def _job_class(base: Any, submitted: set[str], refusals: list[str]) -> type:
    """Return a job class that records submissions and refusals, and whose jobs can always be closed."""

    class Job(base):  # type: ignore[misc]
        async def start(self) -> None:
            try:
                await super().start()
            except RuntimeError as error:  # dask does not report it
                refusals.append(str(error).rpartition("stderr:")[2])
                self.status = Status.failed  # otherwise it could not be closed
                raise
            submitted.add(self.job_id)

        async def close(self) -> None:
            await super().close()
            self.status = Status.closed  # dask asserts this of every job that still exists

    return Job


def job_script(settings: Cluster, out: Path) -> str:
    """Return the script of one job of a batch system, without submitting it."""
    if settings.kind in ("threads", "processes", "address"):
        raise SatIntervalsError(f"cluster {settings.kind} submits no jobs: give slurm, pbs, lsf or sge")
    new = [folder for folder in (out / "logs", out) if not folder.exists()]  # dask-jobqueue creates them
    with batch_system(settings, out / "logs") as cluster:
        script = str(cluster.job_script())
    for folder in new:
        with suppress(OSError):
            folder.rmdir()
    return script
