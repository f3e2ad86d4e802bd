"""Nothing waits forever: pipes in place of files, YAML that expands without end, silent workers."""

import asyncio
import json
import logging
import os
import signal
import socket
import subprocess
import threading
import time
from types import SimpleNamespace

import dask
import numpy as np
import psutil
import pytest
import rasterio
from distributed import Client, LocalCluster
from helpers import COMMAND, invoke

from sat_intervals import load_config, open_image
from sat_intervals.config import Cluster, ConfigError, Mccnn
from sat_intervals.config.pairs import find_pairs, read_batch
from sat_intervals.config.weights import weights_file
from sat_intervals.errors import RunError, SatIntervalsError, check_regular
from sat_intervals.raster import read_place, read_window
from sat_intervals.raster.identity import identity
from sat_intervals.results import open_run
from sat_intervals.run import cluster, submit
from sat_intervals.run.cluster import connected
from sat_intervals.run.submit import Submission
from sat_intervals.run.workers import Task
from sat_intervals.tiling import Window


# ---- Files that are none ---------------------------------------------------------------------------------------
def write(path, **options):
    profile = {"driver": "GTiff", "height": 9, "width": 9, "count": 1, "dtype": "uint8", "crs": "EPSG:32631"}
    with rasterio.open(path, "w", transform=rasterio.Affine(1, 0, 3e5, 0, -1, 4e6), **profile | options) as file:
        file.write(np.ones((9, 9), np.uint8), 1)
    return path


@pytest.mark.parametrize(
    "read",
    [
        open_image,
        load_config,
        read_place,
        weights_file,
        lambda pipe: open_image(write(pipe.parent / "image.tif"), mask=pipe),
        lambda pipe: read_batch(pipe.rename(pipe.parent / "pairs.yaml")),
        lambda pipe: read_batch(pipe.rename(pipe.parent / "pairs.csv")),
        lambda pipe: find_pairs([pipe.rename(pipe.parent / "pairs.csv")]),
        lambda pipe: open_run(pipe.rename(pipe.parent / "run.json").parent),
    ],
)
def test_check_regular__refuses_a_pipe_wherever_a_file_is_read(tmp_path, read):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(SatIntervalsError, match=r"is a named pipe: give a regular file$"):
        read(pipe)


@pytest.mark.parametrize("read", [open_image, lambda path: identity(str(path.parent / "pipe"))])
def test_open_image__refuses_a_virtual_raster_of_a_pipe(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "image.vrt").write_text(
        '<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        '<SourceFilename relativeToVRT="1">pipe</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>'
    )
    with pytest.raises(SatIntervalsError, match="pipe is a named pipe: give a regular file"):
        read(tmp_path / "image.vrt")


@pytest.mark.parametrize("ending", [".tif.msk", ".tif.ovr", ".tif.aux.xml", ".RPB", "_RPC.TXT"])
@pytest.mark.parametrize("name", ["image.tif", "image.vrt"])
def test_open_image__does_not_wait_for_a_pipe_beside_a_raster(tmp_path, name, ending):
    write(tmp_path / "image.tif")
    (tmp_path / "image.vrt").write_text(
        '<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        '<SourceFilename relativeToVRT="1">image.tif</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>'
    )
    os.mkfifo(tmp_path / f"image{ending}")
    with pytest.raises(SatIntervalsError, match=f"image{ending} is a named pipe: give a regular file"):
        open_image(tmp_path / name)


@pytest.mark.parametrize("ending", [".msk", ".aux.xml"])
def test_read_window__does_not_wait_for_a_pipe_that_appears_beside_an_image(tmp_path, ending):
    image = open_image(write(tmp_path / "image.tif"))
    os.mkfifo(tmp_path / f"image.tif{ending}")
    with pytest.raises(SatIntervalsError, match=f"image.tif{ending} is a named pipe: give a regular file"):
        read_window(image, Window(0, 0, 9, 9))


def test_log_file__does_not_wait_for_who_reads_a_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    result = invoke("ablate", tmp_path, "--log-file", tmp_path / "pipe")
    assert result.exit_code == 2
    assert "pipe cannot be written: No such device or address: choose another --log-file" in result.stderr


def test_log_file__may_be_a_pipe_that_is_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    invoke("ablate", tmp_path, "--log-file", tmp_path / "pipe")
    assert b"ablate begins" in os.read(reader, 4096)
    os.close(reader)


@pytest.mark.parametrize("name", ["run.json", "batch.json", "meta.json"])
def test_commands__refuse_json_that_is_nested_without_end(tmp_path, name):
    for file in (name, "left.tif", "right.tif", "truth.tif"):
        (tmp_path / file).write_text(100_000 * "[")
    command = {"run.json": "report", "batch.json": "status", "meta.json": "ablate"}[name]
    result = invoke(command, tmp_path)
    assert result.exit_code == 2, result.stderr
    assert name in result.stderr


def test_check_regular__passes_what_is_a_file_a_folder_or_elsewhere(tmp_path):
    for path in (__file__, tmp_path, tmp_path / "absent", "s3://bucket/key", "with\0zero"):
        check_regular(path)
    with pytest.raises(SatIntervalsError, match="is a device: give a regular file"):
        check_regular("/dev/zero")


# ---- YAML --------------------------------------------------------------------------------------------------------
def bomb(levels, wrap):
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{i}: &a{i} " + wrap.format(", ".join(9 * [f"*a{i - 1}"])) for i in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize("wrap", ["{{<<: [{}]}}", "[{}]"])
def test_load_config__refuses_yaml_that_repeats_itself_without_end(tmp_path, wrap):
    file = tmp_path / "settings.yaml"
    file.write_text(bomb(9, wrap))
    began = time.monotonic()
    with pytest.raises(ConfigError, match=r"settings.yaml: line 5: more than 10000 values, aliases expanded"):
        load_config(file)
    assert time.monotonic() - began < 2
    pairs = tmp_path / "pairs.csv"
    cell = bomb(9, wrap).replace('"', '""')
    pairs.write_text(f'name,left,right,sgm\na,b,c,"{cell}"\n')
    with pytest.raises(SatIntervalsError, match=r"row 1: sgm is .* more than 10000 values"):
        read_batch(pairs)


def test_load_config__takes_aliases_and_merge_keys(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("disparity: &range {minimum: -3, maximum: 4}\n")
    plain = load_config(file)
    file.write_text("disparity: {<<: [{minimum: -3}, {maximum: 4}]}\n")
    assert load_config(file) == plain


def test_read_small__refuses_a_large_file(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("#" * 1_000_001)
    for read in (load_config, read_batch):
        with pytest.raises(SatIntervalsError, match=r"settings.yaml has more than 1 MB: is it the right file\?$"):
            read(file)


@pytest.mark.parametrize("read", [read_batch, lambda file: find_pairs([file])])
def test_read_small__refuses_a_large_table(tmp_path, read):
    file = tmp_path / "pairs.csv"
    file.write_bytes(b"name,left,right\n" + 2_000_000 * b"a,b,c\n")
    with pytest.raises(SatIntervalsError, match=r"pairs.csv has more than 10 MB: is it the right file\?$"):
        read(file)


def test_read_batch__takes_a_list_of_thousands_of_pairs(tmp_path):
    file = tmp_path / "pairs.json"
    file.write_text(json.dumps([{"name": f"p{i}", "left": "a", "right": "b"} for i in range(2000)]))
    assert len(read_batch(file)) == 2000


# ---- Sizes -------------------------------------------------------------------------------------------------------
def test_weights_file__refuses_a_large_file_before_it_is_read(tmp_path):
    file = tmp_path / "zeros.onnx"
    with file.open("wb") as stream:
        stream.truncate(3 * 10**9)
    began = time.monotonic()
    with pytest.raises(SatIntervalsError, match=r"zeros.onnx has 3000 MB, a network like MC-CNN has less than 256 MB"):
        weights_file(Mccnn(weights=str(file)).weights)
    assert time.monotonic() - began < 1


@pytest.mark.parametrize("disparity", [(), ("--disparity", "0", "4")])
@pytest.mark.parametrize("command", ["plan", "match", "range"])
def test_endless_image__is_refused(tmp_path, command, disparity):
    source = write(tmp_path / "small.tif")
    side = 2 * 10**9
    vrt = tmp_path / "endless.vrt"
    vrt.write_text(
        f'<VRTDataset rasterXSize="{side}" rasterYSize="{side}"><VRTRasterBand dataType="Byte" band="1">'
        f"<SimpleSource><SourceFilename>{source}</SourceFilename><SourceBand>1</SourceBand></SimpleSource>"
        "</VRTRasterBand></VRTDataset>"
    )
    given = {"match": [tmp_path / "out", *disparity], "plan": disparity, "range": []}[command]
    # a process of its own: an endless list of blocks could not be interrupted here
    run = [COMMAND, command, vrt, vrt, *given]
    result = subprocess.run(run, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert "GB" in result.stderr


# ---- Workers that say nothing ------------------------------------------------------------------------------------
def heard(monkeypatch):
    """Messages that the package logs from now on; pytest's own handlers are silenced with those of distributed."""
    messages, handler = [], logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())
    monkeypatch.setattr(logging.getLogger("sat_intervals"), "handlers", [handler])
    return messages


@pytest.mark.process
def test_submission__ends_when_no_worker_answers(tmp_path, monkeypatch):
    warned = heard(monkeypatch)
    monkeypatch.setattr(submit, "SILENT", 3.0)
    monkeypatch.setattr(submit, "DEAD", 8.0)
    with connected(Cluster(kind="processes", workers=1), tmp_path) as client:
        (process,) = client.run(os.getpid).values()
        (address,) = client.nthreads()
        submission = Submission(client, iter([Task(0, time.sleep, (600,), 0)]))
        began = time.monotonic()
        stopping = threading.Timer(4.0, psutil.Process(process).send_signal, [signal.SIGSTOP])
        stopping.start()
        with pytest.raises(RunError, match="no worker has answered for 8 s"):
            list(submission)
        assert time.monotonic() - began < 30
        psutil.Process(process).kill()
    assert f"waiting for {address}, silent for 3 s" in warned


@pytest.mark.process
def test_submission__does_not_end_for_a_task_that_takes_long(tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.WARNING)
    monkeypatch.setattr(submit, "SILENT", 3.0)
    monkeypatch.setattr(submit, "DEAD", 4.0)
    with connected(Cluster(kind="processes", workers=1), tmp_path) as client:
        outcomes = [outcome for outcome in Submission(client, iter([Task(0, time.sleep, (9,), 0)])) if outcome]
    assert [outcome.error for outcome in outcomes] == [None]
    assert not [record for record in caplog.records if record.name.startswith("sat_intervals")]


def test_heartbeats__do_not_count_a_time_in_which_this_process_was_stopped(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(submit.time, "monotonic", lambda: now[0])
    worker = SimpleNamespace(cluster=None, scheduler_info=lambda n_workers: {"workers": {"one": {"last_seen": 1.0}}})
    heartbeats = submit._Heartbeats()
    heartbeats.check(worker)
    now[0] += 2 * submit.DEAD
    heartbeats.check(worker)
    now[0] += submit.DEAD
    heartbeats.check(worker)
    now[0] += 1
    with pytest.raises(RunError, match="no worker has answered for 600 s"):
        heartbeats.check(worker)


def test_heartbeats__name_a_silent_worker_after_half_a_minute(monkeypatch):
    now, messages = [0.0], heard(monkeypatch)
    monkeypatch.setattr(submit.time, "monotonic", lambda: now[0])
    worker = SimpleNamespace(cluster=None, scheduler_info=lambda n_workers: {"workers": {"one": {"last_seen": 1.0}}})
    heartbeats = submit._Heartbeats()
    for now[0] in (0.0, 30.0):
        heartbeats.check(worker)
        assert not messages
    now[0] = 31.0
    heartbeats.check(worker)
    assert messages == ["waiting for one, silent for 30 s"]


@pytest.mark.process
def test_submission__looks_around_while_a_result_that_left_with_its_worker_is_computed_again(monkeypatch):
    end_of, left = submit._end_of, []
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as local,
        Client(local) as client,
    ):

        async def after_its_worker_left(client, future):
            left.extend(local.workers.values())
            await left[0].close()
            while local.scheduler.workers:
                await asyncio.sleep(0.01)
            threading.Timer(7.0, local.scale, [2]).start()
            return await end_of(client, future)

        monkeypatch.setattr(submit, "_end_of", after_its_worker_left)
        *meanwhile, last = Submission(client, iter([Task(0, abs, (-3,), 0)]))
    assert (last.result, last.error, len(left)) == (3, None, 1)
    assert len(meanwhile) > 2
    assert {*meanwhile} == {None}


@pytest.mark.process
def test_submission__ends_when_the_scheduler_is_lost_while_a_result_is_read(monkeypatch):
    async def lost(client, future):
        raise asyncio.CancelledError

    monkeypatch.setattr(submit, "_end_of", lost)
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as local,
        Client(local) as client,
        pytest.raises(RunError, match="the dask scheduler is gone; rerun the same command: it resumes"),
    ):
        list(Submission(client, iter([Task(0, abs, (-3,), 0)])))


@pytest.mark.process
def test_submission__goes_on_without_a_worker_that_is_stopped(tmp_path, monkeypatch):
    warned = heard(monkeypatch)
    monkeypatch.setattr(submit, "SILENT", 2.0)
    with (
        dask.config.set({"distributed.scheduler.worker-ttl": "6s"}),
        connected(Cluster(kind="processes", workers=2), tmp_path) as client,
    ):
        address, process = min(client.run(os.getpid).items())
        psutil.Process(process).send_signal(signal.SIGSTOP)
        outcomes = [end for end in Submission(client, iter([Task(i, abs, (-i,), 2) for i in range(9)])) if end]
    assert sorted((end.label, end.result) for end in outcomes) == [(i, i) for i in range(9)]
    assert f"waiting for {address}, silent for 2 s" in warned


@pytest.mark.process
def test_connected__refuses_processes_that_cannot_reach_each_other(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "LOOPBACK", "192.0.2.77")
    with (
        pytest.raises(SatIntervalsError, match=r"processes cannot reach each other at 192.0.2.77: .*--cluster threads"),
        connected(Cluster(kind="processes", workers=1), tmp_path),
    ):
        pass


@pytest.mark.process
def test_connected__does_not_wait_for_a_host_that_nobody_knows(tmp_path):
    began = time.monotonic()
    address = "tcp://nowhere.invalid:1"
    with (
        pytest.raises(SatIntervalsError, match=f"no dask scheduler answers at {address}: "),
        connected(Cluster(kind="address", address=address), tmp_path),
    ):
        pass
    assert time.monotonic() - began < 10


@pytest.mark.process
def test_connected__says_that_it_waits_for_a_scheduler(tmp_path, monkeypatch):
    messages = heard(monkeypatch)
    monkeypatch.setattr(cluster, "_WARN_AFTER", 0.1)
    with socket.socket() as server, dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        server.bind(("127.0.0.1", 0))  # and nobody listens
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with (
            pytest.raises(SatIntervalsError, match="no dask scheduler answers at"),
            connected(Cluster(kind="address", address=address), tmp_path),
        ):
            pass
    assert f"waiting for the dask scheduler at {address}" in messages


@pytest.mark.process
def test_connected__ends_when_worker_processes_do_not_start(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "STARTING", 0.05)
    with (
        pytest.raises(RunError, match=r"the 1 worker processes did not start \(not within 0 s\): give fewer --workers"),
        connected(Cluster(kind="processes", workers=1), tmp_path),
    ):
        pass


@pytest.mark.process
def test_connected__says_how_a_worker_process_ended_that_never_worked(tmp_path, monkeypatch):
    dying = "import os, sys\nif 'spawn' in ' '.join(sys.orig_argv):\n    os._exit(3)\n"
    (tmp_path / "sitecustomize.py").write_text(dying)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with (
        pytest.raises(RunError, match=r"did not start \(a worker process ended at once, with exit status 3\): give"),
        connected(Cluster(kind="processes", workers=1), tmp_path),
    ):
        pass


@pytest.mark.process
def test_connected__names_the_settings_with_which_dask_cannot_start(tmp_path):
    (tmp_path / "file").touch()
    with (
        dask.config.set({"temporary-directory": str(tmp_path / "file" / "inside")}),
        pytest.raises(RunError, match=r"did not start \(.*Not a directory.*\): .* another DASK_TEMPORARY_DIRECTORY"),
        connected(Cluster(kind="processes", workers=1), tmp_path),
    ):
        pass
