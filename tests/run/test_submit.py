"""Tasks on real clusters of dask: workers that die, stop or leave, a scheduler that is lost."""

import os

import dask
import pytest
from distributed import Client, KilledWorker, LocalCluster

from sat_intervals.config import Cluster
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.run import submit
from sat_intervals.run.submit import DaskWorkers, connected
from sat_intervals.run.workers import Task, reason

pytestmark = pytest.mark.process


def in_threads(workers=1):
    """A cluster in threads of this process: its scheduler and workers are at hand."""
    return LocalCluster(n_workers=workers, threads_per_worker=1, processes=False, dashboard_address=None)


def ended(client, *tasks):
    return [outcome for outcome in DaskWorkers(client).outcomes(iter(tasks)) if outcome]


def test_outcomes__a_task_fails_alone_and_only_after_its_retries(tmp_path):
    def work(number):
        with (tmp_path / str(number)).open("a") as tries:
            tries.write("x")
        return 12 // number

    with in_threads() as local, Client(local) as client:
        outcomes = {end.label: end for end in ended(client, *(Task(n, work, (n,), 2) for n in range(4)))}
    assert {label: end.result for label, end in outcomes.items()} == {0: None, 1: 12, 2: 6, 3: 4}
    assert isinstance(outcomes[0].error, ZeroDivisionError)
    assert [len((tmp_path / str(n)).read_text()) for n in range(4)] == [3, 1, 1, 1]


def test_outcomes__an_error_of_the_disk_is_one_of_its_task():
    with in_threads() as local, Client(local) as client:
        (outcome,) = ended(client, Task(0, os.listdir, ("/nowhere",), 0))
    assert reason(outcome.error) == "/nowhere: No such file or directory"


def test_outcomes__a_task_that_kills_every_worker_fails(tmp_path, monkeypatch):
    monkeypatch.setitem(submit.DASK, "distributed.scheduler.allowed-failures", 1)
    with connected(Cluster(kind="processes", workers=1), tmp_path) as client:
        (outcome,) = ended(client, Task(0, os._exit, (3,), 2))
    assert isinstance(outcome.error, KilledWorker)
    assert reason(outcome.error).startswith("every worker that matched it died, the last at tcp://")


def test_connected__does_not_wait_for_a_host_that_nobody_knows(tmp_path):
    address = "tcp://nowhere.invalid:1"
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(SatIntervalsError, match=f"no dask scheduler answers at {address}: "),
        connected(Cluster(kind="address", address=address), tmp_path),
    ):
        pass


def test_connected__names_the_settings_with_which_dask_cannot_start(tmp_path):
    (tmp_path / "file").touch()
    with (
        dask.config.set({"temporary-directory": str(tmp_path / "file" / "inside")}),
        pytest.raises(RunError, match=r"did not start \(.*Not a directory.*\): .* another DASK_TEMPORARY_DIRECTORY"),
        connected(Cluster(kind="processes", workers=1), tmp_path),
    ):
        pass
