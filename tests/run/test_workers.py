"""Threads behind the interface of workers: bounded, in order of need, tried again, without dask."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers import hashes, wait_until, write_pair

from sat_intervals import match_pair
from sat_intervals.config import Cluster
from sat_intervals.demo import make_scene
from sat_intervals.run import source, submit, tile, workers
from sat_intervals.run.connection import Connection
from sat_intervals.run.workers import Task, Threads


def test_threads__yield_every_outcome_and_try_again():
    tries = []

    def work(number):
        tries.append(number)
        if number == 3 or (number == 2 and tries.count(2) < 3):
            raise OSError("disk gone")
        return number**2

    with Connection(Cluster(workers=2), Path()) as threads:
        outcomes = {outcome.label: outcome for outcome in threads.outcomes(Task(n, work, (n,), 2) for n in range(5))}
    assert {label: outcome.result for label, outcome in outcomes.items()} == {0: 0, 1: 1, 2: 4, 3: None, 4: 16}
    assert str(outcomes[3].error) == "disk gone"
    assert sorted(tries) == [0, 1, *[2] * 3, *[3] * 3, 4]


def test_threads__take_a_task_once_another_has_made_it_ready():
    ended: list[int] = []

    def tasks() -> Iterator[Task | None]:
        yield Task(0, ended.append, (0,), 0)
        while not ended:
            yield None
        yield Task(1, ended.append, (1,), 0)

    with Connection(Cluster(workers=4), Path()) as threads:
        assert [outcome.label for outcome in threads.outcomes(tasks())] == [0, 1]
    assert ended == [0, 1]


def test_threads__keep_two_tasks_per_thread_in_flight_and_drop_the_rest_at_the_end(monkeypatch):
    monkeypatch.setattr(workers, "CHECK_EVERY", 0.01)
    started, go = [], threading.Event()

    def work(number):
        started.append(number)
        go.wait(10)

    asked = []
    threads = Threads(2)
    outcomes = threads.outcomes(asked.append(n) or Task(n, work, (n,), 0) for n in range(99))
    assert next(outcomes) is None  # nothing ends: the caller may look around
    assert (len(asked), len(started)) == (4, 2)
    outcomes.close()
    go.set()
    threads.close()
    time.sleep(0.05)
    assert started == [0, 1]


@pytest.mark.process
@pytest.mark.parametrize("module", ["sat_intervals.run.pair", "sat_intervals.workflows.batch"])
def test_threads__need_neither_dask_nor_xarray(module):
    code = f"import sys, {module}; print(*{{'dask', 'distributed', 'xarray'}} & sys.modules.keys())"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == []


@pytest.mark.process
@pytest.mark.parametrize(("store", "threads"), [(None, 1), ("memory://tiles", 2)])
def test_connected__gives_processes_a_thread_that_reads_and_writes_tiles_in_a_bucket(tmp_path, store, threads):
    with submit.connected(Cluster(kind="processes", workers=1, store=store), tmp_path) as client:
        assert list(client.nthreads().values()) == [threads]


def test_computing__lets_one_more_thread_read_while_kernels_run(tmp_path, monkeypatch):
    settings = write_pair(tmp_path, make_scene(140, 70, seed=1), tiles={"size": 64, "overlap": 10})
    pair = tmp_path / "left.tif", tmp_path / "right.tif"
    match_pair(*pair, tmp_path / "local", settings)
    read_views = source.read_views
    reads, at_work, most = [], [], []

    def read(*arguments):
        reads.append(threading.current_thread())
        return read_views(*arguments)

    def counted(kernel):
        def work(*arguments):
            at_work.append(None)
            most.append(len(at_work))
            if len(most) == 1:
                wait_until(lambda: len(set(reads)) == 2, "another tile is read meanwhile")
            time.sleep(0.05)  # so that two at once meet
            try:
                return kernel(*arguments)
            finally:
                at_work.pop()

        return work

    monkeypatch.setattr(source, "read_views", read)
    for kernel in ("match_patch", "ambiguity_histogram"):
        monkeypatch.setattr(tile, kernel, counted(getattr(tile, kernel)))
    match_pair(*pair, tmp_path / "out", settings | {"cluster": {"workers": 1, "store": "memory://tiles"}})
    assert max(most) == 1
    assert hashes(tmp_path / "out") == hashes(tmp_path / "local")
