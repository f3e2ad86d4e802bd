"""Strips finished on workers: the same bytes from any of them, resumed part by part, whatever is killed or damaged."""

import errno
import shutil
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
import rasterio
from helpers import LOCK, OUTPUTS, PLACE, ended, hashes, invoke, started, wait_until, write_pair

import sat_intervals
from sat_intervals.config import Cluster, load_config
from sat_intervals.demo import make_scene
from sat_intervals.errors import RunError, SatIntervalsError
from sat_intervals.match.memory import strip_bytes
from sat_intervals.products import INVALID
from sat_intervals.raster import BLOCK, OutputError, OutputWriter, read_layers, write_layer
from sat_intervals.results import open_run
from sat_intervals.run import pair, strips
from sat_intervals.run import parts as parts_of_files
from sat_intervals.run.checks import check_tiles
from sat_intervals.run.job import open_job
from sat_intervals.run.pair import match_pair
from sat_intervals.store.tiles import DamagedTilesError
from sat_intervals.tiling import Window

# Four strips, two rows of the first overview and one of the second.
HEIGHT, WIDTH, PARTS = 1600, 80, 7


@pytest.fixture(scope="module")
def tall(tmp_path_factory):
    """A pair and its settings; a run that kept its tiles."""
    folder = tmp_path_factory.mktemp("tall")
    part = make_scene(HEIGHT // 8, WIDTH, seed=3)
    images = {name: np.tile(getattr(part, name), (8, 1)) for name in ("left", "right", "truth")}
    settings = write_pair(folder, replace(part, **images), tiles={"size": 320}, cluster={"workers": 2})
    match_pair(folder / "left.tif", folder / "right.tif", folder / "kept", settings, keep_tiles=True)
    return folder, settings


def matched(tall, out: Path, *, keep_tiles: bool = False, progress=lambda *how: None, **sections):
    folder, settings = tall
    more = settings | {"cluster": settings["cluster"] | sections.pop("cluster", {})} | sections
    return match_pair(folder / "left.tif", folder / "right.tif", out, more, keep_tiles=keep_tiles, progress=progress)


def with_tiles(tall, out: Path) -> Path:
    """A folder of a run whose tiles are all done."""
    shutil.copytree(tall[0] / "kept" / "tiles", out / "tiles")
    return out


@pytest.fixture(scope="module")
def stopped(tall):
    """A folder of a run that was stopped when all its parts were done."""

    def stop(*arguments):
        raise KeyboardInterrupt

    out = with_tiles(tall, tall[0] / "stopped")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OutputWriter, "assemble", stop)
        with pytest.raises(KeyboardInterrupt):
            matched(tall, out)
    return out


def parts(out: Path) -> dict[str, int]:
    """Times of the parts that are done, by name."""
    return {file.stem: file.stat().st_mtime_ns for file in (out / "tiles" / "parts").glob("[!.]*.npz")}


def test_finish_strips__gives_the_counts_and_overviews_of_the_whole(tall):
    out = tall[0] / "kept"
    report = open_run(out).report
    with rasterio.open(out / "validity.tif") as file:
        validity = file.read(1)
        assert file.overviews(1) == [2, 4]
    assert report["counts"]["pixels"] == HEIGHT * WIDTH
    assert report["counts"]["valid"] == (validity & INVALID == 0).sum()
    for level, factor in ((0, 2), (1, 4)):
        with rasterio.open(out / "validity.tif", overview_level=level) as file:
            np.testing.assert_array_equal(file.read(1), validity[::factor, ::factor])
    assert not parts(out)  # they have the bytes of the files


@pytest.mark.parametrize("workers", [1, 3])
def test_finish_strips__gives_the_same_bytes_for_all_workers_and_tiles(tall, tmp_path, workers):
    matched(tall, tmp_path / "out", tiles={"size": 512}, cluster={"workers": workers})
    assert hashes(tmp_path / "out") == hashes(tall[0] / "kept")


def test_finish_strips__goes_on_from_the_parts_that_are_done(tall, tmp_path, monkeypatch):
    out = with_tiles(tall, tmp_path / "out")

    def fail(job, strip, scale):
        if strip.row == 2 * BLOCK:
            raise OSError("disk gone")
        return finish(job, strip, scale)

    finish = strips.finish_strip
    with monkeypatch.context() as patch:
        patch.setattr(strips, "finish_strip", fail)
        with pytest.raises(RunError, match="rows 1024 to 1535 could not be finished: disk gone; rerun the"):
            matched(tall, out)
    before = parts(out)
    assert before
    monkeypatch.setattr(pair, "end_tiles", lambda job, keep_tiles: None)
    matched(tall, out)
    after = parts(out)
    assert len(after) == PARTS
    assert {name: after[name] for name in before} == before, "done twice"
    assert hashes(out) == hashes(tall[0] / "kept")


def test_match_pair__names_the_file_that_cannot_be_written(tall, tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    out = with_tiles(tall, tmp_path / "out")
    with monkeypatch.context() as patch:
        patch.setattr(parts_of_files, "copy_part", full)
        message = "out/intervals.tif could not be written: No space left on device: free disk space and rerun the"
        with pytest.raises(RunError, match=message):
            matched(tall, out, cluster={"retries": 0})
    assert not list(out.glob("*.tif*"))
    matched(tall, out)
    assert hashes(out) == hashes(tall[0] / "kept")


def test_finish_strips__takes_no_parts_of_other_settings(tall, stopped, tmp_path):
    out = shutil.copytree(stopped, tmp_path / "out")
    assert len(parts(out)) == PARTS
    matched(tall, out, median=None)
    matched(tall, with_tiles(tall, tmp_path / "alone"), median=None)
    assert hashes(out) == hashes(tmp_path / "alone") != hashes(tall[0] / "kept")


def test_finish_strips__with_zstd(tall, tmp_path):
    matched(tall, with_tiles(tall, tmp_path / "out"), products={"compression": "zstd"})
    for name in ("intervals.tif", "validity.tif"):
        with rasterio.open(tmp_path / "out" / name) as file, rasterio.open(tall[0] / "kept" / name) as kept:
            np.testing.assert_array_equal(file.read(), kept.read())
            assert file.tags() == kept.tags()


def test_make_part__refuses_a_worker_with_other_codecs(tall, tmp_path, monkeypatch):
    out = with_tiles(tall, tmp_path / "out")
    make = parts_of_files.make_part
    monkeypatch.setattr(parts_of_files, "make_part", lambda parts, *rest: make(replace(parts, codecs={}), *rest))
    with pytest.raises(RunError, match=r"this worker compresses with .*'gdal'.*install the same versions of"):
        matched(tall, out)
    assert not parts(out)


def test_finish_strips__of_least_squares_are_equal_for_any_tiling(tmp_path, unrendered):
    """Two strips, whose fits need rows of both images above and below; the fifth band has their deviations."""
    settings = write_pair(tmp_path, make_scene(BLOCK + 90, 90, seed=2), preset="satellite", products={"sigma": True})
    for side, rows in (("left", slice(200, 230)), ("right", slice(300, 340))):
        with rasterio.open(tmp_path / f"{side}.tif", "r+") as file:
            pixels = file.read(1)
            pixels[rows, 40:70] = 0  # no data
            file.write(pixels, 1)
    found = {}
    for size in (64, 1024):
        out = tmp_path / str(size)
        match_pair(tmp_path / "left.tif", tmp_path / "right.tif", out, settings | {"tiles": {"size": size}})
        found[size] = hashes(out)
    assert found[64] == found[1024]
    more = {"products": {"keep_rejected": True}, "median": None, "interval": {"alpha": 0.9}}
    part, ends = Window(20, 10, BLOCK + 40, 70), [tmp_path / "few", tmp_path / "many"]
    for end, size in zip(ends, (1024, 64), strict=True):
        sections = settings | more | {"tiles": {"size": size}}
        match_pair(tmp_path / "left.tif", tmp_path / "right.tif", end, sections, window=part)
    assert hashes(ends[0]) == hashes(ends[1])
    disparity, lower, upper, _, sigma = read_layers(out / "intervals.tif")
    valid = read_layers(out / "validity.tif")[0] & INVALID == 0
    assert 0.8 < np.isfinite(sigma[valid]).mean() < 1
    assert (sigma[np.isfinite(sigma)] >= 0).all()
    assert np.isnan(sigma[~valid]).all()
    assert ((lower <= disparity) & (disparity <= upper))[valid].all()
    run = open_run(out)
    assert run.read_bands(Window(0, 0, 5, 5)).confidence.shape == (5, 5)
    np.testing.assert_array_equal(sat_intervals.open(out)["sigma"].values, sigma)
    for command in (["project"], ["stac"], ["plot", "--dpi", 30], ["report"]):
        assert invoke(*command[:1], out, *command[1:]).exit_code == 0
    images = (np.ma.masked_equal(read_layers(tmp_path / f"{side}.tif")[0], 0) for side in ("left", "right"))
    whole = sat_intervals.match_arrays(*images, settings)
    for name, band in zip(
        ("disparity", "lower", "upper", "confidence", "sigma"), read_layers(out / "intervals.tif"), strict=True
    ):
        np.testing.assert_array_equal(whole[name], band)
    with pytest.raises(SatIntervalsError, match=r"products.sigma needs refinement.method least_squares"):
        load_config({"preset": "paper", "products": {"sigma": True}})


# ---- Memory and space -------------------------------------------------------------------------------------------
def wide_job(folder: Path):
    write_layer(folder / "wide.tif", np.ones((600, 5000), np.uint8), 0, PLACE)
    search = {"minimum": 0, "maximum": 3}
    settings = {"preset": "paper", "disparity": search, "tiles": {"overlap": 100}}  # no path states
    return open_job(folder / "wide.tif", folder / "wide.tif", folder / "out", settings)


def test_strip_bytes__bounds_what_writing_a_strip_takes(tmp_path):
    job = wide_job(tmp_path)
    noise = np.random.default_rng(0).integers(0, 1 << 10, (4, BLOCK, 5000))
    rasters = [noise.astype(np.float32) / 8, noise[:1].astype(np.uint16)]
    bands = sum(raster.nbytes for raster in rasters)
    del noise
    job.begin()
    tracemalloc.start()
    parts_of_files.write_part(strips.parts_of(job), (0, 0), rasters)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    most = strip_bytes(BLOCK, 5000, job.config)
    assert 0.5 * most < bands + peak < most


def test_check_tiles__refuses_strips_that_do_not_fit(monkeypatch):
    config, wide = (
        load_config({"preset": "paper", "disparity": {"minimum": 0, "maximum": 3}, "tiles": {"size": 64}}),
        Window(0, 0, 900, 99999),
    )
    monkeypatch.setattr("sat_intervals.match.memory.usable_memory", lambda: 2 * 10**9)
    check_tiles(config.model_copy(update={"cluster": Cluster(workers=1)}), wide)
    with pytest.raises(
        SatIntervalsError, match=r"512 x 99999 pixels, 2 at once, need 3.1 GB, this process may use 2.0 GB"
    ):
        check_tiles(config.model_copy(update={"cluster": Cluster(workers=8)}), wide)
    jobs = Cluster(kind="slurm", memory="2GB", cores=1)
    check_tiles(config.model_copy(update={"cluster": jobs.model_copy(update={"memory": "3GB"})}), wide)
    with pytest.raises(
        SatIntervalsError, match=r"512 x 99999 pixels, 1 at once, need 18\d\d MB, but 1800 MB are given"
    ):
        check_tiles(config.model_copy(update={"cluster": jobs}), wide)


def test_begin__refuses_a_disk_without_room_for_tiles_parts_and_files(tmp_path, monkeypatch):
    job = wide_job(tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda place: SimpleNamespace(free=80 * 10**6))
    with pytest.raises(OutputError, match=r"has 80.0 MB free, tiles, files and their parts may need 150.0 MB"):
        job.begin()
    replace(job, has_files=False).begin()


def test_status__counts_strips(tall, tmp_path, monkeypatch):
    out = with_tiles(tall, tmp_path / "out")
    finish = strips.finish_strip

    def first_only(job, strip, scale):
        if strip.row:
            raise DamagedTilesError("not made")
        return finish(job, strip, scale)

    monkeypatch.setattr(strips, "finish_strip", first_only)
    with pytest.raises(DamagedTilesError):
        matched(tall, out)
    result = invoke("status", out)
    assert "5 of 5 tiles done, 0 failed, 0 left, 1 of 4 strips done; no run is active" in result.output


@pytest.mark.process
@pytest.mark.parametrize("cluster", ["threads", "processes"])
def test_match__goes_on_after_kill_9_in_every_stage_of_its_second_half(tall, tmp_path, cluster):
    folder, out = tall[0], with_tiles(tall, tmp_path / "out")
    command = "match", folder / "left.tif", folder / "right.tif", out, "--config", folder / "settings.yaml"
    seen: dict[str, int] = {}
    for count in (1, 4, PARTS, "file"):

        def reached(count=count):
            return list(out.glob(".validity.tif.part")) if count == "file" else len(parts(out)) >= count

        with started(*command, "--cluster", cluster) as process:
            wait_until(lambda: reached() or process.poll() is not None, f"{count}")
            children = psutil.Process(process.pid).children() if process.poll() is None else []
            process.kill()
            process.wait()
            psutil.wait_procs(children, 10)
        if (out / "run.json").exists():  # it was faster
            break
        assert not {path.name for path in out.iterdir()} & set(OUTPUTS)
        now = parts(out)
        assert {name: now[name] for name in seen} == seen, "done twice"
        seen = now
    with started(*command, "--cluster", cluster) as process:
        assert ended(process, 60)[0] == 0
    assert hashes(out) == hashes(tall[0] / "kept")
    assert sorted(path.name for path in out.iterdir()) == [LOCK, *OUTPUTS]
