"""Strips finished on workers: the same bytes from any of them, resumed part by part, whatever is killed or damaged."""

import shutil
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import rasterio
from helpers import COMMAND, OUTPUTS, hashes, wait_until, write_pair

from sat_intervals.demo import make_scene
from sat_intervals.errors import RunError
from sat_intervals.products import INVALID
from sat_intervals.raster import OutputWriter
from sat_intervals.results import open_run
from sat_intervals.run import strips
from sat_intervals.run.pair import match_pair

# Four strips, two rows of the first overview and one of the second.
HEIGHT, WIDTH, PARTS = 1600, 120, 7


@pytest.fixture(scope="module")
def tall(tmp_path_factory):
    """A pair and its settings; a run that kept its tiles."""
    folder = tmp_path_factory.mktemp("tall")
    part = make_scene(HEIGHT // 8, WIDTH, seed=3)
    images = {name: np.tile(getattr(part, name), (8, 1)) for name in ("left", "right", "truth")}
    settings = write_pair(folder, replace(part, **images), tiles={"size": 320}, cluster={"workers": 2})
    match_pair(folder / "left.tif", folder / "right.tif", folder / "kept", settings, keep_tiles=True)
    return folder, settings


def matched(tall, out: Path, *, keep_tiles: bool = False, **sections):
    folder, settings = tall
    more = settings | {"cluster": settings["cluster"] | sections.pop("cluster", {})} | sections
    return match_pair(folder / "left.tif", folder / "right.tif", out, more, keep_tiles=keep_tiles)


def with_tiles(tall, out: Path) -> Path:
    """A folder of a run whose tiles are all done."""
    shutil.copytree(tall[0] / "kept" / "tiles", out / "tiles")
    return out


def parts(out: Path, kind: str = "*.json") -> dict[str, int]:
    """Times of the parts that are done, by name."""
    return {file.name: file.stat().st_mtime_ns for file in (out / "tiles" / "parts").glob(f"[!.]{kind}")}


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
    assert not parts(out, "*")  # they have the bytes of the files


@pytest.mark.parametrize("workers", [1, 3])
def test_finish_strips__gives_the_same_bytes_for_all_workers_and_tiles(tall, tmp_path, workers):
    matched(tall, tmp_path / "out", tiles={"size": 512}, cluster={"workers": workers})
    assert hashes(tmp_path / "out") == hashes(tall[0] / "kept")


def test_finish_strips__goes_on_from_the_parts_that_are_done(tall, tmp_path, monkeypatch):
    out = with_tiles(tall, tmp_path / "out")

    def fail(job, codecs, place, *rest):
        if place == (0, 2):
            raise OSError("disk gone")
        return finish(job, codecs, place, *rest)

    finish = strips.finish_strip
    with monkeypatch.context() as patch:
        patch.setattr(strips, "finish_strip", fail)
        with pytest.raises(RunError, match="rows 1024 to 1535 could not be finished: disk gone; rerun the"):
            matched(tall, out)
    before = parts(out)
    assert before
    monkeypatch.setattr(strips.Parts, "drop", lambda parts: None)
    matched(tall, out, keep_tiles=True)
    after = parts(out)
    assert len(after) == PARTS
    assert {name: after[name] for name in before} == before, "done twice"
    assert hashes(out) == hashes(tall[0] / "kept")


@pytest.mark.parametrize("by", ["workers", "command"])
def test_copy_parts__gives_the_same_bytes_as_one_after_another(tall, tmp_path, monkeypatch, by):
    copied, copy_part = [], strips.copy_part
    monkeypatch.setattr(strips, "copy_part", lambda *part: (copied.append(part), copy_part(*part))[1])
    # a store of its own may be out of the workers' reach
    store = {} if by == "workers" else {"store": str(tmp_path / "store")}
    matched(tall, tmp_path / "out", cluster=store)
    assert len(copied) == (2 * PARTS if by == "workers" else 0)
    assert hashes(tmp_path / "out") == hashes(tall[0] / "kept")


@pytest.mark.parametrize("how", ["gone", "bit"])
def test_copy_part__meets_a_damaged_part_which_is_made_again(tall, tmp_path, monkeypatch, how):
    out = with_tiles(tall, tmp_path / "out")
    copy_part = strips.copy_part

    def damaged(job, codecs, place, kind, *rest):
        if not (tmp_path / "done").exists():
            (tmp_path / "done").touch()
            (file,) = (out / "tiles" / "parts").glob(f"*_{place[0]}_{place[1]}_{kind}")
            content = bytearray(file.read_bytes())
            content[len(content) // 2] ^= 4
            file.unlink() if how == "gone" else file.write_bytes(content)
        return copy_part(job, codecs, place, kind, *rest)

    monkeypatch.setattr(strips, "copy_part", damaged)
    matched(tall, out)
    assert hashes(out) == hashes(tall[0] / "kept")


@pytest.mark.parametrize("kind", ["0_1_half", "1_0_intervals", "0_3_validity", "0_1.json"])
@pytest.mark.parametrize("how", ["gone", "cut short", "bit"])
def test_finish_strips__makes_damaged_parts_again(tall, tmp_path, monkeypatch, kind, how):
    out = with_tiles(tall, tmp_path / "out")

    def stop(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(OutputWriter, "put_together", stop)
        with pytest.raises(KeyboardInterrupt):
            matched(tall, out)
    (file,) = (out / "tiles" / "parts").glob(f"*_{kind}")
    if kind.endswith("half"):  # so that it is needed again
        next((out / "tiles" / "parts").glob("*_1_0.json")).unlink()
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.unlink() if how == "gone" else file.write_bytes(content if how == "bit" else content[:-9])
    matched(tall, out)
    assert hashes(out) == hashes(tall[0] / "kept")
    assert sorted(path.name for path in out.iterdir()) == OUTPUTS


def test_finish_strips__takes_no_parts_of_other_settings(tall, tmp_path, monkeypatch):
    out = with_tiles(tall, tmp_path / "out")
    other = with_tiles(tall, tmp_path / "other")
    monkeypatch.setattr(strips.Parts, "drop", lambda parts: None)
    matched(tall, out, keep_tiles=True)
    shutil.copytree(out / "tiles" / "parts", other / "tiles" / "parts", dirs_exist_ok=True)
    matched(tall, other, keep_tiles=True, median=None)
    assert len(parts(other)) == 2 * PARTS
    matched(tall, with_tiles(tall, tmp_path / "alone"), median=None)
    assert hashes(other) == hashes(tmp_path / "alone") != hashes(out)


@pytest.mark.parametrize("compression", ["zstd", "lerc", "none"])
def test_finish_strips__with_another_compression(tall, tmp_path, compression):
    matched(tall, with_tiles(tall, tmp_path / "out"), products={"compression": compression})
    for name in ("intervals.tif", "validity.tif"):
        with rasterio.open(tmp_path / "out" / name) as file, rasterio.open(tall[0] / "kept" / name) as kept:
            error = 0.01001 if compression == "lerc" and name == "intervals.tif" else 0
            np.testing.assert_allclose(file.read(), kept.read(), rtol=0, atol=error)
            assert file.tags() == kept.tags()


def test_finish_strip__refuses_a_worker_with_other_codecs(tall, tmp_path, monkeypatch):
    out = with_tiles(tall, tmp_path / "out")
    task = strips._task

    def of_another(*arguments):
        made = task(*arguments)
        job, _, *rest = made.arguments
        return strips.Task(made.label, made.function, (job, {"gdal": "3.9"}, *rest), 0)

    monkeypatch.setattr(strips, "_task", of_another)
    with pytest.raises(RunError, match=r"this worker compresses with .*'gdal'.*install the same version of rasterio"):
        matched(tall, out)
    assert not parts(out)


class Second:
    """``sat-intervals match`` as a process, from tiles that are all done."""

    def __init__(self, tall, out: Path, *options: str) -> None:
        folder = tall[0]
        command = [COMMAND, "match", folder / "left.tif", folder / "right.tif", out, "--quiet"]
        command += ["--config", folder / "settings.yaml", *options]
        self.process = subprocess.Popen(list(map(str, command)), stdout=subprocess.DEVNULL)

    def __enter__(self):
        return self.process

    def __exit__(self, *error) -> None:
        self.process.kill()
        self.process.wait()


@pytest.mark.process
@pytest.mark.parametrize("cluster", ["threads", "processes"])
def test_match__goes_on_after_kill_9_in_every_stage_of_its_second_half(tall, tmp_path, cluster):
    out = with_tiles(tall, tmp_path / "out")
    seen: dict[str, int] = {}
    for count in (1, 4, PARTS, "file"):
        if count == "file":  # one part is missing, so that workers copy them
            (out / "tiles" / "parts" / next(name for name in seen if name.endswith("_2_0.json"))).unlink()
            seen = parts(out)

        def reached(count=count):
            return list(out.glob(".*/files/strips-*")) if count == "file" else len(parts(out)) >= count

        with Second(tall, out, "--cluster", cluster) as process:
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
    with Second(tall, out, "--cluster", cluster) as process:
        assert process.wait(60) == 0
    assert hashes(out) == hashes(tall[0] / "kept")
    assert sorted(path.name for path in out.iterdir()) == OUTPUTS


@pytest.mark.process
def test_match__survives_kill_9_of_workers_in_its_second_half(tall, tmp_path):
    out = with_tiles(tall, tmp_path / "out")
    with Second(tall, out, "--cluster", "processes", "--workers", "2") as process:
        wait_until(lambda: parts(out) or process.poll() is not None, "a part")
        for child in psutil.Process(process.pid).children() if process.poll() is None else []:
            if "spawn_main" in " ".join(child.cmdline()):
                child.send_signal(signal.SIGKILL)
                break
        assert process.wait(60) == 0
    assert hashes(out) == hashes(tall[0] / "kept")
