"""A process killed in the middle of a run costs time and nothing else: real processes, really killed."""

import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil
import pytest
import rasterio
import yaml
from distributed import Client, LocalCluster
from helpers import COMMAND, OUTPUTS, PATIENCE, PLACE, invoke, wait_until

from sat_intervals.demo import make_scene
from sat_intervals.raster import BLOCK, read_layers, write_layer
from sat_intervals.run import pair as run
from sat_intervals.run import tile
from sat_intervals.run.job import open_job
from sat_intervals.run.submit import DaskWorkers
from sat_intervals.store.lock import locked

pytestmark = pytest.mark.process

TILES = 56


def traced(out: Path) -> int:
    """Number of tiles and wavefronts whose path states were handed on."""
    return len(list((out / "tiles" / "borders").glob("[0-9]*")))


def done_tiles(out: Path) -> set[str]:
    return {file.stem for file in (out / "tiles" / "tiles").glob("[0-9]*.npz")}


class Command:
    """``sat-intervals match`` as a process of its own."""

    def __init__(
        self, pair: Path, out: Path, *options: str, left: Path | None = None, surface: Sequence[Path] = ()
    ) -> None:
        self.out = out
        self.log = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed by `started`)
        command = [COMMAND, "match", left or pair / "left.tif", pair / "right.tif", out]
        command += ["--config", pair / "settings.yaml"]
        command = [*([COMMAND, "surface", *surface, out] if surface else command), "--quiet", *options]
        self.process = subprocess.Popen(list(map(str, command)), stdout=self.log, stderr=subprocess.STDOUT)

    def wait_for_tiles(self, count: int) -> None:
        wait_until(lambda: len(done_tiles(self.out)) >= count or self.ended, f"{count} tiles")
        assert not self.ended, self.output

    def wait_for_borders(self, count: int) -> None:
        wait_until(lambda: traced(self.out) >= count or self.ended, f"path states of {count} tiles")
        assert not self.ended, self.output
        assert not done_tiles(self.out)

    def end(self, seconds: float = PATIENCE) -> int:
        return self.process.wait(seconds)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    @property
    def ended(self) -> bool:
        return self.process.poll() is not None

    @property
    def output(self) -> str:
        self.log.seek(0)
        return self.log.read()

    def workers(self) -> list[psutil.Process]:
        """The processes of a local cluster."""
        return [child for child in psutil.Process(self.process.pid).children() if is_worker(child)]


def is_worker(process: psutil.Process) -> bool:
    with suppress(psutil.NoSuchProcess):
        return process.status() != psutil.STATUS_ZOMBIE and "spawn_main" in " ".join(process.cmdline())
    return False


@contextmanager
def started(*args: object, **options) -> Iterator[Command]:
    """A command that is killed at the end of the test."""
    command = Command(*args, **options)
    workers: list[psutil.Process] = []
    try:
        yield command
        workers = [] if command.ended else command.workers()
    finally:
        command.kill()
        command.log.close()
        psutil.wait_procs(workers, 10)


def kill(process: psutil.Process) -> None:
    with suppress(psutil.NoSuchProcess):
        process.kill()
        process.wait(10)


def assert_complete(pair: Path, out: Path) -> None:
    """Check for the same bytes, band by band, as the undisturbed run, and for no other files."""
    for name in ("intervals.tif", "validity.tif"):
        with rasterio.open(pair / "undisturbed" / name) as expected, rasterio.open(out / name) as found:
            for band in range(1, expected.count + 1):
                np.testing.assert_array_equal(found.read(band), expected.read(band), err_msg=f"{name}, band {band}")
        assert (out / name).read_bytes() == (pair / "undisturbed" / name).read_bytes(), name
    assert sorted(path.name for path in out.iterdir()) == [".sat-intervals.lock", *OUTPUTS]


def assert_nothing_final(out: Path) -> None:
    assert not {path.name for path in out.iterdir()} & set(OUTPUTS)


def test_match__survives_kill_9_of_workers_at_random_moments(pair, tmp_path):
    chance = random.Random(1)
    with started(pair, tmp_path / "out", "--cluster", "processes", "--workers", "2") as command:
        for count in (1, 60):
            command.wait_for_borders(count)
            kill(chance.choice(command.workers()))
        for count in sorted(chance.sample(range(1, 40), 4)):
            command.wait_for_tiles(count)
            kill(chance.choice(command.workers()))
        assert command.end() == 0, command.output
        assert (
            re.sub(r".*resource_tracker.*\n.*\n", "", command.output) == ""
        )  # Python's word on what a killed one held
    assert_complete(pair, tmp_path / "out")


@pytest.mark.peer("shareloc")
def test_surface__of_raw_images_survives_kill_9_of_workers_in_each_stage(tmp_path):
    from raw import raw_pair  # needs the extra `dsm`

    images = raw_pair(tmp_path / "raw", make_scene(1900, 90, seed=3))
    options = "--disparity", "-20", "20", "--resolution", "0.4"
    assert invoke("surface", *images, tmp_path / "threads", *options).exit_code == 0
    out = tmp_path / "out"
    options += "--cluster", "processes", "--workers", "2"
    begins = {"left.tif": ".left.tif.parts/parts", "run.json": "tiles/tiles", "dsm.tif": ".dsm.tif.parts/parts"}
    with started(tmp_path, out, *options, surface=images) as command:
        for stage, begun in begins.items():
            wait_until(lambda begun=begun: any(out.glob(begun)) or command.ended, stage)
            assert not command.ended, command.output
            kill(command.workers()[0])
            assert not (out / stage).exists()
        assert command.end() == 0, command.output
        assert "distributed" not in command.output
    for name in ("left.tif", "right.tif", "left_grid.tif", "right_grid.tif", "intervals.tif", "validity.tif"):
        assert (out / name).read_bytes() == (tmp_path / "threads" / name).read_bytes(), name
    surface = read_layers(out / "dsm.tif")
    assert surface.shape[1] > 2 * BLOCK
    np.testing.assert_array_equal(surface, read_layers(tmp_path / "threads" / "dsm.tif"))
    assert sorted(path.name for path in out.iterdir()) == sorted(path.name for path in (tmp_path / "threads").iterdir())


def test_match__goes_on_after_kill_9_of_the_command(pair, tmp_path):
    chance, out = random.Random(2), tmp_path / "out"
    with started(pair, out, "--cluster", "processes", "--workers", "2") as command:
        command.wait_for_borders(40)
        command.kill()
    handed_on = traced(out)
    for count, cluster in zip(sorted(chance.sample(range(2, 45), 2)), ("processes", "threads"), strict=True):
        with started(pair, out, "--cluster", cluster, "--workers", "2") as command:
            command.wait_for_tiles(count)
            assert traced(out) > handed_on
            workers = command.workers()
            command.kill()
            _, alive = psutil.wait_procs(workers, 10)
            assert not alive, "workers outlive the command"
        assert_nothing_final(out)
    before = {name: (out / f"tiles/tiles/{name}.npz").stat().st_mtime_ns for name in done_tiles(out)}
    with started(pair, out, "--keep-tiles") as command:
        assert command.end() == 0, command.output
    after = {name: (out / f"tiles/tiles/{name}.npz").stat().st_mtime_ns for name in before}
    assert after == before, "tiles done twice"
    with started(pair, out) as command:  # removes the tiles
        assert command.end() == 0, command.output
    assert_complete(pair, out)


@contextmanager
def dask_process(*args: object) -> Iterator[psutil.Popen]:
    """``dask scheduler`` or ``dask worker``; killed with its children at the end."""
    process = psutil.Popen(
        [sys.executable, "-m", "dask", *map(str, args)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        # deaths of workers that dask has a tile survive, by default 3
        env=os.environ | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1"},
    )
    try:
        yield process
    finally:
        kill_tree(process)


def kill_tree(process: psutil.Popen) -> None:
    with suppress(psutil.NoSuchProcess):
        family = [process, *process.children(recursive=True)]  # the parent first: it starts its children again
        for member in family:
            with suppress(psutil.NoSuchProcess):
                member.kill()
        psutil.wait_procs(family, 10)


@contextmanager
def scheduler(folder: Path) -> Iterator[tuple[str, psutil.Popen]]:
    """A scheduler on loopback: its address, its process."""
    file = folder / "scheduler.json"
    options = ("--host", "127.0.0.1", "--port", 0, "--no-dashboard", "--no-show", "--scheduler-file", file)
    with dask_process("scheduler", *options) as process:
        wait_until(lambda: file.exists() and file.read_text().endswith("}"), "scheduler")
        yield yaml.safe_load(file.read_text())["address"], process


def worker(address: str, folder: Path, *options: object):
    fixed = ("--host", "127.0.0.1", "--nthreads", 1, "--no-dashboard", "--local-directory", folder)
    return dask_process("worker", address, *fixed, *options)


def test_match__ends_when_the_scheduler_dies_and_goes_on_elsewhere(pair, tmp_path):
    out = tmp_path / "out"
    with (
        scheduler(tmp_path) as (address, process),
        worker(address, tmp_path),
        started(pair, out, "--cluster", address) as command,
    ):
        command.wait_for_tiles(3)
        kill_tree(process)
        assert command.end() == 1, command.output
        assert "the dask scheduler is gone; rerun the same command" in command.output
        assert len(command.output.splitlines()) == 1, command.output
    assert_nothing_final(out)
    with started(pair, out) as command:
        assert command.end() == 0, command.output
    assert_complete(pair, out)


def test_match__names_the_tiles_of_a_truncated_input_and_matches_it_mended(pair, tmp_path):
    out, left = tmp_path / "out", tmp_path / "left.tif"
    shutil.copy(pair / "left.tif", left)
    whole = left.read_bytes()
    with left.open("r+b") as file:
        file.truncate(len(whole) * 17 // 20)
    with started(pair, out, left=left) as command:
        assert command.end() == 1, command.output
        failed = set(re.findall(r"tile (\d+_\d+): .*left\.tif cannot be read at rows", command.output))
        assert f"{len(failed)} of {TILES} tiles failed" in command.output
        assert len(command.output.splitlines()) == 1 + len(failed)
    done = done_tiles(out)
    assert failed
    assert not failed & done
    waiting = TILES - len(failed | done)  # that wait for path states
    assert_nothing_final(out)
    status = subprocess.run([COMMAND, "status", out], capture_output=True, text=True, check=True)
    assert f"{len(done)} of {TILES} tiles done, {len(failed)} failed, {waiting} left" in status.stdout

    left.write_bytes(whole)
    with started(pair, out, "--overwrite", left=left) as command:
        assert command.end() == 0, command.output
    assert_complete(pair, out)


def test_match__ends_where_the_disk_is_full_and_goes_on_after(pair, tmp_path, disk):
    place = disk(24 << 20)
    out, ballast = place / "out", place / "ballast"
    with started(pair, out) as command:
        command.wait_for_tiles(5)
        free = shutil.disk_usage(place).free
        with suppress(OSError):
            ballast.write_bytes(bytes(free))
        assert command.end() == 1, command.output
        assert "No space left on device: free disk space and rerun the same command" in command.output
        assert len(command.output.splitlines()) == 1, command.output
    assert_nothing_final(out)
    assert len(done_tiles(out)) >= 5
    ballast.unlink()
    disk(100 << 20)
    with started(pair, out) as command:
        assert command.end() == 0, command.output
    assert_complete(pair, out)


def test_match_jobs__keeps_few_tiles_in_flight_however_many_there_are(pair, tmp_path, monkeypatch):
    def record_only(job, block):
        job.store.write("tiles", block.name)

    monkeypatch.setattr(tile, "match_block", record_only)
    monkeypatch.setattr(tile, "trace_block", lambda *step: {})
    futures, known = [], []
    image = tmp_path / "wide.tif"
    write_layer(image, np.ones((64 * 40, 64 * 50), np.uint16), 0, PLACE)
    job = open_job(image, image, tmp_path / "out", yaml.safe_load((pair / "settings.yaml").read_text()))
    with locked(job.out):
        job.begin()
        with (
            LocalCluster(
                n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0"
            ) as cluster,
            Client(cluster) as client,
        ):

            def progress(stage, done, total):
                futures.append(len(client.futures))
                known.append(len(cluster.scheduler.tasks))

            for matched in run.match_jobs(DaskWorkers(client), [job], progress):
                assert not matched.failures
    assert len(futures) >= 1 + 500 + 3 * 500  # blocks of 2 x 2 tiles and three wavefronts, one before the first ends
    assert max(futures) <= 6  # two a core, and those that are just being released
    assert max(known) <= 12
