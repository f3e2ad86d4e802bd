"""Tiles in a bucket of a real S3 server: the same bytes, and nothing lost if a process is killed."""

import json
import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

import psutil
import pytest
from helpers import COMMAND, OUTPUTS, PATIENCE, hashes, wait_until, write_pair

from sat_intervals import match_pair
from sat_intervals.demo import make_scene

TILES = 16
LOCK = ".sat-intervals.lock"


def s3():
    """A client other than the tested one."""
    import boto3

    return boto3.client("s3")


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> Path:
    """A folder with left.tif, right.tif, settings.yaml of 4 x 4 tiles, and the run with its tiles on the disk."""
    folder = tmp_path_factory.mktemp("pair")
    settings = write_pair(folder, make_scene(400, 500, seed=3), tiles={"size": 128, "overlap": 20})
    match_pair(folder / "left.tif", folder / "right.tif", folder / "undisturbed", settings)
    return folder


@contextmanager
def started(pair: Path, out: Path, store: str | Path, *options: str) -> Iterator[subprocess.Popen]:
    """``match`` as a process of its own that does not outlive the test."""
    command = [COMMAND, "match", pair / "left.tif", pair / "right.tif", out, "--config", pair / "settings.yaml"]
    command += ["--set", f"cluster.store={store}", "--quiet", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def ended(process: subprocess.Popen) -> tuple[int, str]:
    output, _ = process.communicate(timeout=PATIENCE)
    return process.returncode, output


def objects(store: str) -> dict[str, datetime]:
    """Names in a store, with the times they were written."""
    prefix = store.removeprefix("s3://bucket/") + "/"
    pages = s3().get_paginator("list_objects_v2").paginate(Bucket="bucket", Prefix=prefix)
    found = (item for page in pages for item in page.get("Contents", []))
    return {item["Key"].removeprefix(prefix): item["LastModified"] for item in found}


def records(store: str) -> dict[str, datetime]:
    return {name: when for name, when in objects(store).items() if "/tiles/" in name}


def wait_for_tiles(process: subprocess.Popen, store: str, count: int) -> None:
    wait_until(lambda: len(records(store)) >= count or process.poll() is not None, f"{count} tiles")
    assert process.poll() is None, process.stdout.read()


@contextmanager
def halted(process: subprocess.Popen) -> Iterator[list[psutil.Process]]:
    """A running run whose two workers are stopped; all processes are killed at the end."""
    workers = [child for child in psutil.Process(process.pid).children() if "spawn_main" in " ".join(child.cmdline())]
    for worker in workers:
        worker.suspend()
    try:
        yield workers
    finally:
        process.kill()
        for worker in workers:
            with suppress(psutil.NoSuchProcess):
                worker.kill()
        psutil.wait_procs(workers, 10)


def assert_complete(pair: Path, out: Path, *others: str) -> None:
    assert hashes(out) == hashes(pair / "undisturbed")
    assert sorted(path.name for path in out.iterdir()) == sorted([LOCK, *OUTPUTS, *others])


def status_of(out: Path) -> str:
    return subprocess.run([COMMAND, "status", out], capture_output=True, text=True, check=True).stdout


def test_match__in_a_bucket_goes_on_after_kill_9(bucket, pair, tmp_path):
    store, out = f"{bucket}/killed", tmp_path / "out"
    with started(pair, out, store, "--cluster", "processes", "--workers", "2") as first:
        wait_for_tiles(first, store, 3)
        with halted(first):
            assert "a run is active" in status_of(out)
    done = records(store)
    assert f"{len(done)} of {TILES} tiles done, 0 failed, {TILES - len(done)} left; no run" in status_of(out)
    with started(pair, out, store, "--keep-tiles") as again:
        assert ended(again) == (0, "")
    after = records(store)
    assert {name: after[name] for name in done} == done, "tiles done twice"
    assert len(after) == TILES
    assert_complete(pair, out, "tiles")


def test_match__reads_images_in_a_bucket_and_knows_them_by_size_and_etag(bucket, pair, tmp_path, monkeypatch):
    # what GDAL calls the address of the service
    monkeypatch.setenv("AWS_S3_ENDPOINT", os.environ["AWS_ENDPOINT_URL"].removeprefix("http://"))
    monkeypatch.setenv("AWS_HTTPS", "NO")
    monkeypatch.setenv("AWS_VIRTUAL_HOSTING", "FALSE")
    for side in ("left", "right"):
        s3().upload_file(str(pair / f"{side}.tif"), "bucket", f"images/{side}.tif")
    command = [COMMAND, "match", f"{bucket}/images/left.tif", "/vsis3/bucket/images/right.tif", tmp_path / "out"]
    subprocess.run([*command, "--config", pair / "settings.yaml", "--quiet"], check=True)
    assert_complete(pair, tmp_path / "out")
    inputs = json.loads((tmp_path / "out" / "run.json").read_text())["inputs"]
    for side in ("left", "right"):
        shown = s3().head_object(Bucket="bucket", Key=f"images/{side}.tif")
        assert (inputs[side]["bytes"], inputs[side]["etag"]) == (shown["ContentLength"], shown["ETag"])


@pytest.mark.parametrize(
    ("store", "says"),
    [
        ("s3://no-such-bucket/tiles", "The specified bucket does not exist"),
        ("nothing://bucket/tiles", "Protocol not known: nothing"),
    ],
)
def test_match__refuses_a_store_that_cannot_be_used(bucket, pair, tmp_path, store, says):
    with started(pair, tmp_path / "out", store) as process:
        status, output = ended(process)
    assert status == 2
    assert re.match(rf"sat-intervals: {store}/\w{{32}} cannot be used: {says}", output)
    assert len(output.splitlines()) == 1
    assert [file.name for file in (tmp_path / "out").iterdir()] == [LOCK]
