"""Tiles and results in a bucket of a real S3 server: the same bytes, and nothing lost if it or a process ends."""

import json
import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from datetime import datetime
from pathlib import Path
from tempfile import gettempdir

import numpy as np
import psutil
import pytest
from helpers import COMMAND, LOCK, OUTPUTS, PATIENCE, ended, hashes, invoke, refused, started, wait_until, write_pair
from rasterio.shutil import copy
from raw import raw_pair
from services.s3 import away_from

from sat_intervals import SurfaceChoices, match_pair, open_surface
from sat_intervals import open as open_dataset
from sat_intervals.demo import make_scene
from sat_intervals.interop.export import export
from sat_intervals.raster import find_model, path_of, read_layers
from sat_intervals.store.remote import RemotePath, disk_of
from sat_intervals.workflows.demo import write_views
from sat_intervals.workflows.surface import surface

TILES = 16


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


def matching(pair: Path, out: Path, store: str | Path, *options: str) -> AbstractContextManager[subprocess.Popen]:
    """``match`` as a process, see `started`."""
    files = pair / "left.tif", pair / "right.tif", out, "--config", pair / "settings.yaml"
    return started("match", *files, "--set", f"cluster.store={store}", *options)


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
    with matching(pair, out, store, "--cluster", "processes", "--workers", "2") as first:
        wait_for_tiles(first, store, 3)
        with halted(first):
            assert "a run is active" in status_of(out)
    done = records(store)
    assert f"{len(done)} of {TILES} tiles done, 0 failed, {TILES - len(done)} left; no run" in status_of(out)
    with matching(pair, out, store, "--keep-tiles") as again:
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


def test_path_of__is_in_a_bucket_by_either_name_and_keeps_its_url(tmp_path):
    run = path_of("s3://bucket/run")
    assert (str(run), str(run / "dsm.tif"), run.name) == ("s3://bucket/run", "s3://bucket/run/dsm.tif", "run")
    assert run == path_of("/vsis3/bucket/run") == path_of(run) == (run / "dsm.tif").parent
    assert run.with_suffix(".geom").gdal_name == "/vsis3/bucket/run.geom"
    assert disk_of(run).parents[1] == Path(gettempdir())
    assert type(path_of("https://host/run")) is type(path_of("/vsizip/a.zip/b")) is type(tmp_path)


def test_stat__has_the_time_of_a_store_that_names_it_otherwise(tmp_path):
    file = RemotePath("memory://bucket/there.tif")
    (tmp_path / "new").write_bytes(b"0123456789")
    file.upload(tmp_path / "new")
    assert abs(file.stat().st_mtime - (tmp_path / "new").stat().st_mtime) < PATIENCE
    assert (file.is_file(), file.is_dir(), file.parent.is_dir(), file.parent.stat().st_mtime) == (True, False, True, 0)
    with file.open() as stream:
        assert (stream.seek(7), stream.read(), stream.tell()) == (7, b"789", 10)
    with pytest.raises(OSError, match="not opened as 'w'"):
        file.open("w")


@pytest.mark.parametrize(
    ("store", "says"),
    [
        ("s3://no-such-bucket/tiles", "The specified bucket does not exist"),
        ("nothing://bucket/tiles", "Protocol not known: nothing"),
    ],
)
def test_match__refuses_a_store_that_cannot_be_used(bucket, pair, tmp_path, store, says):
    with matching(pair, tmp_path / "out", store) as process:
        status, output = ended(process)
    assert status == 2
    assert re.match(rf"sat-intervals: {store}/\w{{32}} cannot be used: {says}", output)
    assert len(output.splitlines()) == 1
    assert [file.name for file in (tmp_path / "out").iterdir()] == [LOCK]


# Nothing is tried again where the server is away.
AT_ONCE = {"GDAL_HTTP_MAX_RETRY": "0", "AWS_MAX_ATTEMPTS": "1"}
RASTERS = "intervals.tif", "validity.tif"


def upload(folder: Path, url: str) -> list[str]:
    """Copy the files of a folder to a bucket; return their URLs."""
    files = sorted(folder.iterdir())
    for file in files:
        s3().upload_file(str(file), "bucket", f"{url.removeprefix('s3://bucket/')}/{file.name}")
    return [f"{url}/{file.name}" for file in files]


def contents(url: str) -> dict[str, bytes]:
    """The files in a folder of a bucket, not those of its folders."""
    prefix = url.removeprefix("s3://bucket/")
    names = [name for name in objects(url) if "/" not in name]
    return {name: s3().get_object(Bucket="bucket", Key=f"{prefix}/{name}")["Body"].read() for name in names}


def assert_same(url: str, folder: Path, *names: str) -> None:
    there = contents(url)
    assert {name: there[name] == (folder / name).read_bytes() for name in names} == dict.fromkeys(names, True)


def test_surface__from_bucket_to_bucket_gives_the_bytes_of_a_local_run_though_a_worker_is_killed(bucket, tmp_path):
    raw_pair(tmp_path / "raw", make_scene(120, 160, seed=3))
    settings = tmp_path / "settings.yaml"
    settings.write_text("disparity: {minimum: -20, maximum: 20}\ntiles: {size: 128}\n")
    options = "--config", settings, "--resolution", "0.5", "--quiet"
    assert invoke("surface", *sorted((tmp_path / "raw").iterdir()), tmp_path / "out", *options).exit_code == 0
    out = f"{bucket}/raw-out"
    command = [COMMAND, "surface", *upload(tmp_path / "raw", f"{bucket}/raw"), out, *options]
    with subprocess.Popen([*command, "--cluster", "processes", "--workers", "2"], stderr=subprocess.DEVNULL) as process:
        wait_until(lambda: records(out) or process.poll() is not None, "a tile")
        workers = psutil.Process(process.pid).children()
        next(worker for worker in workers if "spawn_main" in " ".join(worker.cmdline())).kill()
        assert process.wait(PATIENCE) == 0
    names = "left.tif", "right.tif", "left_grid.tif", "right_grid.tif", *RASTERS
    assert_same(out, tmp_path / "out", *names)
    assert sorted(objects(out)) == sorted([*names, "dsm.tif", "geometry.json", "rectify.json", "run.json"])
    np.testing.assert_array_equal(read_layers(f"{out}/dsm.tif"), read_layers(tmp_path / "out" / "dsm.tif"))
    for name in ("status", "plot", "stac", "project", "report"):
        assert invoke(name, out).exit_code == 0
    assert {"overview.png", "stac.json", "project.qgz", "width.vrt", "report.html"} <= objects(out).keys()
    known = open_dataset(out)["disparity"].notnull().sum(), open_surface(f"{out}/dsm.tif")["height"].notnull().sum()
    assert all(known)


def test_surface__of_many_in_a_bucket_has_the_bytes_of_a_local_folder(bucket, tmp_path):
    images, _ = write_views(tmp_path, 120, 130, 3, 1)
    urls = upload(tmp_path, f"{bucket}/many")[: len(images)]
    surface(urls, tmp_path / "out", resolution=0.5, choices=SurfaceChoices(ortho=True))
    spread = {"preset": "many", "tiles": {"size": 64}, "cluster": {"kind": "processes", "workers": 2}}
    surface(urls, f"{bucket}/many-out", spread, resolution=0.5, choices=SurfaceChoices(ortho=True))
    assert_same(f"{bucket}/many-out", tmp_path / "out", "dsm.tif", "ortho.tif", "validity.tif")
    assert sorted(objects(f"{bucket}/many-out")) == ["dsm.tif", "ortho.tif", "run.json", "validity.tif"]


def test_read_model__finds_those_of_images_in_a_bucket(bucket, tmp_path):
    from sat_intervals.heights.models import read_model  # of the extra `dsm`

    place = np.array([1.451]), np.array([43.599]), np.array([30.0])
    raw, _ = raw_pair(tmp_path / "raw", make_scene(60, 80, seed=3))
    expected = read_model(raw).inverse_loc(*place)
    for kind in ("RPB", "RPCTXT"):
        (tmp_path / kind).mkdir()
        copy(str(raw), str(tmp_path / kind / "raw.tif"), driver="GTiff", PROFILE="BASELINE", **{kind: "YES"})
        urls = upload(tmp_path / kind, f"{bucket}/{kind}")
        model = find_model(next(url for url in urls if url.endswith(".tif")))
        assert model in urls
        assert not model.endswith(".tif")
        np.testing.assert_allclose(read_model(model).inverse_loc(*place), expected, rtol=0, atol=1e-9)
    url, _ = upload(tmp_path / "raw", f"{bucket}/tags")
    assert find_model(url) == url
    np.testing.assert_array_equal(read_model(url).inverse_loc(*place), expected)


def test_match__publishes_whole_files_alone_while_the_server_is_away_and_resumes(bucket, pair, monkeypatch):
    out = f"{bucket}/away"
    command = [COMMAND, "match", pair / "left.tif", pair / "right.tif", out, "--config", pair / "settings.yaml"]
    for name, value in AT_ONCE.items():
        monkeypatch.setenv(name, value)
    requests = {
        "/tiles/1_1.npz": set(),
        "/parts/0_0.npz": set(),
        "PUT /bucket/away/intervals.tif": set(),
        "PUT /bucket/away/validity.tif": {"intervals.tif"},
        "GET /bucket/away/intervals.tif": {"intervals.tif"},  # compared with the new one
    }
    for request, kept in requests.items():
        with away_from(request) as address, monkeypatch.context() as patch:
            patch.setenv("AWS_ENDPOINT_URL", address)
            result = subprocess.run(
                [*command, "--quiet", "--set", "cluster.retries=0"], capture_output=True, text=True, timeout=PATIENCE
            )
        assert (result.returncode, result.stdout, result.stderr.count("\n")) == (1, "", 1), result.stderr
        assert "rerun the same command" in result.stderr
        assert contents(out).keys() == kept
    done = records(out)
    assert len(done) == TILES
    subprocess.run([*command, "--quiet", "--keep-tiles"], check=True)
    assert records(out) == done, "tiles done twice"
    assert_same(out, pair / "undisturbed", *RASTERS)


def test_match__treats_files_in_a_bucket_like_those_on_a_disk(bucket, pair, tmp_path):
    out = f"{bucket}/there"
    command = ["match", pair / "left.tif", pair / "right.tif", out, "--config", pair / "settings.yaml", "--quiet"]
    s3().put_object(Bucket="bucket", Key="there/intervals.tif", Body=b"the user's")
    refused(command, f"{out}/intervals.tif exists and is of no complete run")
    assert contents(out) == {"intervals.tif": b"the user's"}
    assert invoke(*command, "--overwrite").exit_code == 0
    assert_same(out, pair / "undisturbed", *RASTERS)
    assert invoke("evaluate", out, "--truth", pair / "truth.tif").exit_code == 0
    assert [str(file) for file in export(out, "s2p", f"{out}/s2p")][:1] == [f"{out}/s2p/rectified_disp.tif"]
    assert "s2p/rectified_mask.png" in objects(out)
    refused([*command, "--set", "median.size=5"], f"{out} already holds another run: settings.median")
    assert "already complete" in invoke(*command).stderr
    upload(pair / "undisturbed", f"{bucket}/inside")
    inside = f"{bucket}/inside/intervals.tif"
    refused(
        ["match", inside, pair / "right.tif", f"{bucket}/inside", "--band", "1", *command[4:]], inside, "is an input"
    )
    refused(["dsm", out, "--resolution", "1"], f"{out} has no sensor models and grids yet")
