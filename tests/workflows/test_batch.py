"""Batches, plans and states of runs, through the library and the command."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import yaml
from helpers import LOCK, PLACE, hashes, invoke

from sat_intervals.config import ConfigError, load_config
from sat_intervals.config.batch import PairOfBatch, read_batch
from sat_intervals.demo import make_scene
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.sgm import LAST
from sat_intervals.match.memory import fitted, tile_bytes
from sat_intervals.raster import write_layer
from sat_intervals.results import open_run
from sat_intervals.run.checks import fitted_to_jobs
from sat_intervals.run.job import open_job
from sat_intervals.run.pair import match_jobs, match_pair
from sat_intervals.run.plan import plan
from sat_intervals.run.workers import Outcome, parse_memory
from sat_intervals.store.lock import locked
from sat_intervals.workflows.batch import match_batch


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    for seed in (1, 2):
        scene = make_scene(80, 140, seed=seed)
        for side in ("left", "right"):
            write_layer(folder / f"{side}{seed}.tif", getattr(scene, side), 0, PLACE)
    return folder


def rows(folder, *, broken=False):
    lines = ["name,left,right,minimum,maximum,preset,sgm.p2"]
    lines += [f"pair{seed},left{seed}.tif,right{seed}.tif,-18,40,paper,{24 + seed}" for seed in (1, 2)]
    if broken:
        lines.insert(1, "broken,left1.tif,nowhere.tif,-18,40,paper,")
    (folder / "pairs.csv").write_text("\n".join(lines) + "\n")
    return folder / "pairs.csv"


def test_match_batch__gives_every_pair_what_match_pair_gives(images, tmp_path):
    report = match_batch(read_batch(rows(images)), tmp_path / "batch", {"tiles": {"size": 64, "overlap": 20}})
    assert {name: end["state"] for name, end in report.items()} == {"pair1": "done", "pair2": "done"}
    for seed in (1, 2):
        settings = {
            "preset": "paper",
            "disparity": {"minimum": -18, "maximum": 40},
            "sgm": {"p2": 24 + seed},
            "tiles": {"size": 64, "overlap": 20},
        }
        match_pair(images / f"left{seed}.tif", images / f"right{seed}.tif", tmp_path / f"alone{seed}", settings)
        assert hashes(tmp_path / "batch" / f"pair{seed}") == hashes(tmp_path / f"alone{seed}")
        assert not (tmp_path / "batch" / f"pair{seed}" / "tiles").exists()


@pytest.mark.peer("shareloc")
def test_match_batch__keeps_the_counts_of_a_pair_whose_surface_fails(images, tmp_path):
    pair = replace(read_batch(rows(images))[0], resolution=1.0, sensors=("no.tif",) * 4)
    end = match_batch([pair], tmp_path / "batch")[pair.name]
    assert (end["state"], end["error"].partition(":")[0]) == ("failed", "no.tif")
    assert end["counts"] == json.loads((tmp_path / "batch" / pair.name / "run.json").read_text())["counts"]


@pytest.mark.parametrize("text", ["mine", '{"notes": {"state": "mine"}}'])
def test_match_batch__keeps_a_report_that_is_not_of_a_batch(images, tmp_path, text):
    (tmp_path / "batch.json").write_text(text)
    with pytest.raises(SatIntervalsError, match=r"batch\.json is not the report of a batch: move it away and rerun"):
        match_batch(read_batch(rows(images)), tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"batch.json", LOCK}
    assert (tmp_path / "batch.json").read_text() == text


@pytest.mark.parametrize("place", ["option", "config"])
def test_match_batch__takes_a_preset_of_all_pairs_or_of_one(images, tmp_path, place):
    lines = ["name,left,right,minimum,maximum,preset", "one,left1.tif,right1.tif,-18,40,"]
    lines += ["two,left2.tif,right2.tif,-18,40,paper"]
    (images / "presets.csv").write_text("\n".join(lines) + "\n")
    config, overrides = {"tiles": {"size": 64, "overlap": 20}}, {}
    (overrides if place == "option" else config)["preset"] = "satellite"
    report = match_batch(read_batch(images / "presets.csv"), tmp_path, config, overrides=overrides)
    assert {name: end["state"] for name, end in report.items()} == {"one": "done", "two": "done"}
    settings = [open_run(tmp_path / name).config for name in ("one", "two")]
    assert [(one.preset, one.sgm.p2) for one in settings] == [("satellite", 144), ("paper", 32)]


def test_batch__goes_on_after_a_failing_pair_and_then_does_only_what_is_missing(images, tmp_path):
    arguments = [
        "batch",
        str(rows(images, broken=True)),
        str(tmp_path / "out"),
        "--tile-size",
        "64",
        "--set",
        "tiles.overlap=20",
    ]
    first = invoke(*arguments)
    assert first.exit_code == 1
    assert "1 of 3 pairs failed" in first.stderr
    assert "nowhere.tif" in first.stderr
    shown = invoke("status", tmp_path / "out")
    assert shown.stdout.startswith(f"{tmp_path / 'out' / 'broken'}: failed: {images / 'nowhere.tif'}")
    written = (tmp_path / "out" / "pair1" / "intervals.tif").stat().st_mtime_ns
    rows(images)
    second = invoke(*arguments)
    assert second.exit_code == 0
    assert (tmp_path / "out" / "pair1" / "intervals.tif").stat().st_mtime_ns == written
    report = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert {end["state"] for end in report.values()} == {"done before"}
    shown = invoke("status", tmp_path / "out")
    assert shown.stdout == "".join(f"{tmp_path / 'out' / name}: complete\n" for name in report)


def write_ranges(file, like, minimum):
    """Write the same range for all pixels of an image."""
    with rasterio.open(like) as left:
        shape = left.shape
    kind = {"height": shape[0], "width": shape[1], "count": 2, "dtype": "int16", "transform": PLACE.transform}
    with rasterio.open(file, "w", "GTiff", **kind) as dataset:
        dataset.write(np.stack([np.full(shape, minimum, np.int16), np.full(shape, 9, np.int16)]))


def test_match_batch__does_not_take_a_result_for_that_of_other_ranges(images, tmp_path):
    pairs = [PairOfBatch("pair1", str(images / "left1.tif"), str(images / "right1.tif"))]
    file = tmp_path / "ranges.tif"

    def states(minimum):
        write_ranges(file, images / "left1.tif", minimum)
        return match_batch(pairs, tmp_path / "out", {"disparity": {"grid": str(file)}})["pair1"]

    assert [states(minimum)["state"] for minimum in (-4, -4, -6)] == ["done", "done before", "failed"]
    assert "already holds another run: settings.disparity.minimum was -4, now -6" in states(-6)["error"]
    write_ranges(file, images / "left1.tif", -4)
    with rasterio.open(file, "r+") as dataset:
        dataset.write(np.full((1, 64, 64), -2, np.int16), [1], window=((0, 64), (0, 64)))  # the hull is the same
    report = match_batch(pairs, tmp_path / "out", {"disparity": {"grid": str(file)}})
    assert "already holds a run of other local ranges or of another version" in report["pair1"]["error"]


def test_match_batch__holds_the_folders_of_its_pairs(images, tmp_path):
    with locked(tmp_path / "pair1"):
        report = match_batch(read_batch(rows(images)), tmp_path)
    assert {name: end["state"] for name, end in report.items()} == {"pair1": "failed", "pair2": "done"}
    assert "another run is active" in report["pair1"]["error"]


def test_match_batch__refuses_a_folder_where_another_batch_is_active(images, tmp_path):
    with locked(tmp_path), pytest.raises(SatIntervalsError, match="another run is active"):
        match_batch(read_batch(rows(images)), tmp_path)


def test_match_batch__keeps_the_tiles_of_equal_pairs_apart(images, tmp_path):
    pair = PairOfBatch("first", str(images / "left1.tif"), str(images / "right1.tif"))
    config = {"disparity": {"minimum": -18, "maximum": 40}, "cluster": {"store": str(tmp_path / "store")}}
    report = match_batch([pair, replace(pair, name="second")], tmp_path / "out", config, keep_tiles=True)
    assert {end["state"] for end in report.values()} == {"done"}
    assert sorted(file.name.partition("-")[0] for file in (tmp_path / "store").iterdir()) == ["first", "second"]


def test_status__of_a_batch_goes_on_after_a_pair_without_a_run(images, tmp_path):
    match_batch(read_batch(rows(images)), tmp_path)
    shutil.rmtree(tmp_path / "pair1")
    result = invoke("status", tmp_path)
    assert result.stdout == f"{tmp_path / 'pair1'}: done\n{tmp_path / 'pair2'}: complete\n"


class SlowTraces:
    """Workers that trace states of the last wavefront only when nothing else is left to do; see `Workers`."""

    traced = 0

    def outcomes(self, tasks):
        others, slow = [], []
        while True:
            while len(others) < 4 and (task := next(tasks, None)) is not None:
                (slow if task.label[1].wavefront == LAST else others).append(task)
            if not others and not slow:
                return
            task = others.pop(0) if others else slow.pop()
            self.traced += task.label[1].wavefront == LAST
            yield Outcome(task.label, task.function(*task.arguments), None)


def test_match_jobs__yields_a_job_once_when_nothing_of_it_is_under_way(images, tmp_path):
    """Steps may still be traced whose blocks have been matched meanwhile: the job would be yielded again."""
    settings = {"disparity": {"minimum": -18, "maximum": 40}, "tiles": {"size": 64}}
    job, workers = open_job(images / "left1.tif", images / "right1.tif", tmp_path, settings), SlowTraces()
    job.begin()
    traced = [workers.traced for _ in match_jobs(workers, [job], lambda stage, done, total: None)]
    assert traced == [workers.traced]
    assert traced[0] > 0
    assert not job.waiting()


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("a.csv", "name,left\nx,l.tif\n", "row 1 lacks right"),
        ("a.csv", "name,left,right\nx,l,r\nx,l,r\n", "a.csv: 2 pairs or runs are called x"),
        ("a.csv", "name,left,right\nx,l,r,1\n", "more values than columns"),
        ("a.csv", "name,left,right\n../x,l,r\n", "row 1: name '../x' cannot be a folder's name"),
        ("a.csv", "name,left,right\nx,l,r\nlogs,l,r\n", "row 2: name 'logs' cannot be"),
        ("a.csv", "name,left,right,sgm.p2\nx,l,r,[3\n", r"row 1: sgm.p2 is '\[3': while parsing"),
        ("a.csv", "name,left,right,sgm,sgm.p2\nx,l,r,null,3\n", "sgm.p2 is '3': sgm is also given as a whole"),
        ("a.csv", "name,left,right,sgm.p2,sgm\nx,l,r,3,null\n", "sgm is 'null': parts of sgm are also given"),
        ("a.csv", "name,left,right,sgm.p2,sgm.p2\nx,l,r,1,2\n", "column sgm.p2 appears twice"),
        ("a.csv", "name,left,right,cluster.kind\nx,l,r,slurm\n", "row 1: all pairs share one cluster"),
        ("a.csv", "name,left,right,band_right\nx,l,r,2\n", r"row 1: unknown column 'band_right', .*right_band.*, sgm"),
        ("a.csv", 'name,left,right\n"x\ny",l,r\n', r"row 1: name 'x\\ny' cannot be"),
        ("a.yaml", "- {name: x, left: l, left: m, right: r}", "key 'left' appears twice"),
        ("a.yaml", "- {name: 2024-13-45, left: l, right: r}", "cannot be read"),
        ("a.yaml", "[" * 1000, "cannot be read"),
        ("a.yaml", "just: text\n", "holds no pairs"),
        ("a.yaml", "- [", "cannot be read"),
        ("a.json", "[]", "holds no pairs"),
    ],
)
def test_read_batch__says_what_is_wrong(tmp_path, name, text, problem):
    (tmp_path / name).write_text(text)
    with pytest.raises(SatIntervalsError, match=problem) as caught:
        read_batch(tmp_path / name)
    assert name in str(caught.value)


def test_read_batch__reads_the_same_pairs_from_every_kind_of_file(tmp_path):
    row = {"name": "a", "left": "l.tif", "right": "https://host/r.tif", "minimum": -3, "sgm": {"p1": 7}, "median": None}
    (tmp_path / "b.json").write_text(json.dumps([row]))
    (tmp_path / "b.yaml").write_text("- {name: a, left: l.tif, right: 'https://host/r.tif', minimum: -3, sgm.p1: 7}\n")
    (tmp_path / "b.csv").write_text("name,left,right,minimum,sgm.p1\na,l.tif,https://host/r.tif,-3,7\n")
    # as spreadsheets write it
    (tmp_path / "c.csv").write_text(
        "\ufeffName; Left;RIGHT ;minimum;sgm.p1\r\n;;;;\r\na; l.tif;https://host/r.tif ;-3;7\r\n;;;;\r\n"
    )
    (tmp_path / "d.csv").write_text("name, left, right, minimum, sgm.p1\n\na, l.tif, https://host/r.tif, -3, 7\n")
    files = ("b.json", "b.yaml", "b.csv", "c.csv", "d.csv")
    batches = [read_batch(tmp_path / name) for name in files]
    assert all(batch == batches[0] for batch in batches)
    pair = batches[0][0]
    assert (pair.left, pair.right) == (str(tmp_path / "l.tif"), "https://host/r.tif")
    assert pair.settings == {"disparity": {"minimum": -3}, "sgm": {"p1": 7}}


SETTINGS = load_config({"disparity": {"minimum": -31, "maximum": 32}})


def test_fitted__takes_the_largest_tile_that_fits():
    for memory in (10**9, 5 * 10**8, 4 * 10**8):
        size = fitted(SETTINGS, memory).tiles.size
        base = fitted(SETTINGS, 10**10).tiles.size
        assert size <= base == SETTINGS.tiles.size
        assert tile_bytes(SETTINGS, size) < memory
        assert size == base or tile_bytes(SETTINGS, size + 64) > memory - 3 * 10**8
    with pytest.raises(ConfigError, match=r"need .* MB, but 300 MB are given"):
        fitted(SETTINGS, 3 * 10**8)


def test_fitted_to_jobs__counts_the_tiles_that_wait_in_the_size_that_fits():
    def size(memory, **cluster):
        jobs = {"kind": "slurm", "memory": memory, **cluster}
        return fitted_to_jobs(load_config({"disparity": {"minimum": -63, "maximum": 64}, "cluster": jobs})).tiles.size

    for memory in ("450MB", "600MB", "1GB"):
        waiting = size(memory, store="memory://tiles")
        assert 64 <= waiting <= size(memory)
    assert size("600MB", store="memory://tiles") > 300
    with pytest.raises(ConfigError, match="but 90 MB are given"):
        size("100MB", store="memory://tiles")


@pytest.mark.parametrize(
    ("text", "count"), [("4GB", 4 * 10**9), ("512 MiB", 2**29), ("3e9", 3 * 10**9), ("1.5g", 15 * 10**8)]
)
def test_parse_memory__reads_figures_with_units(text, count):
    assert parse_memory(text) == count


@pytest.mark.parametrize(
    "text", ["much", "4 bananas", "", "GB", "1.2.3GB", "1e400", "nan", "-4GB", "0", "0GB", "0.5", "4"]
)
def test_parse_memory__refuses_what_is_none(text):
    with pytest.raises(ConfigError, match=f"^memory {text!r}: give a figure with a unit, such as 4GB or 512MiB$"):
        parse_memory(text)


def test_plan__counts_tiles_and_the_work_of_overlaps(images):
    config = {"disparity": {"minimum": -18, "maximum": 40}, "tiles": {"size": 64, "overlap": 10}}
    made = plan(images / "left1.tif", images / "right1.tif", config, workers=2)
    # 80 x 140 px: 2 x 3 tiles; a patch is as wide as core and overlaps, its sweeps see half of the rows behind it
    widths, heights = [74, 84, 22], [64 + 5, 16 + 5]
    assert made.tiles == 6
    assert made.extra_work == pytest.approx(sum(widths) * sum(heights) / (80 * 140) - 1)
    assert made.seconds > 0


def test_plan__keeps_out_of_the_store_of_the_run(images, tmp_path):
    store = tmp_path / "store"
    config = {"disparity": {"minimum": -18, "maximum": 40}, "cluster": {"store": str(store)}}
    plan(images / "left1.tif", images / "right1.tif", config, workers=1)
    assert not store.exists()


def test_plan__prints_what_a_run_will_take(images):
    pair = [str(images / "left1.tif"), str(images / "right1.tif"), "--disparity", "-18", "40"]
    result = invoke("plan", *pair, "--memory", "400MB", "--workers", "3")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("preparing kernels")
    assert re.search(r"search range: +-18 to 40 px\n", result.stdout)
    assert "expected time, 3 tiles at once" in result.stdout
    assert "smaller than set, to fit: give --tile-size " in result.stdout
    assert re.search(r"memory of a worker: +\d+ MB, fits in 400 MB\n", result.stdout)
    assert re.search(r"with 3 tiles at once: +\d+ MB, does not fit in 400 MB: give --workers [12]\n", result.stdout)
    refused = invoke("plan", *pair, "--memory", "100MB")
    assert refused.exit_code == 2
    assert "but 100 MB are given" in refused.stderr


def test_plan__counts_the_jobs_of_a_batch_system_and_reads_images_as_match_does(images, tmp_path):
    bands = tmp_path / "bands.tif"
    with rasterio.open(images / "left1.tif") as file, rasterio.open(bands, "w", **file.profile | {"count": 2}) as copy:
        copy.write(np.stack([file.read(1), file.read(1)]))
    cluster = {"kind": "slurm", "jobs": 4, "maximum_jobs": 8, "cores": 3, "memory": "1GB"}
    settings = tmp_path / "settings.yaml"
    settings.write_text(yaml.safe_dump({"disparity": {"minimum": -18, "maximum": 40}, "cluster": cluster}))
    arguments = ["plan", str(bands), str(images / "right1.tif"), "--config", str(settings), "--band", "1"]
    result = invoke(*arguments, "--window", "20", "0", "60", "140", "--tile-size", "512")
    assert result.exit_code == 0, result.stderr
    assert "24 tiles at once" in result.stdout
    assert "with 3 tiles at once" in result.stdout
    assert "1 of 512 px" in result.stdout


def test_plan__takes_another_sample_where_the_centre_holds_no_data_and_refuses_what_match_does(
    images, tmp_path, monkeypatch
):
    for side in ("left", "right"):
        with rasterio.open(images / f"{side}1.tif") as file:
            image = np.tile(file.read(1), (9, 5))[:700, :700]
        image[90:610, 90:610] = 0
        write_layer(tmp_path / f"{side}.tif", image, 0, PLACE)
    config = {"disparity": {"minimum": -18, "maximum": 40}}
    assert plan(tmp_path / "left.tif", tmp_path / "right.tif", config, workers=1).seconds > 0
    huge = {"disparity": {"minimum": -6000, "maximum": 6000}, "tiles": {"size": 4096}}
    write_layer(tmp_path / "wide.tif", np.ones((64, 13000), np.uint8), 0, PLACE)
    monkeypatch.setattr("sat_intervals.match.memory.usable_memory", lambda: 2 * 10**9)
    with pytest.raises(SatIntervalsError, match="GB, this process may use"):
        plan(tmp_path / "wide.tif", tmp_path / "wide.tif", huge)


def test_status__tells_done_and_failed_tiles_from_the_store(images, tmp_path):
    out = tmp_path / "out"
    settings = {"disparity": {"minimum": -18, "maximum": 40}, "tiles": {"size": 64}}
    assert invoke("status", out).exit_code == 2
    match_pair(images / "left1.tif", images / "right1.tif", out, settings, keep_tiles=True)
    assert invoke("status", out).stdout == f"{out}: complete\n"
    (out / "run.json").unlink()
    for name in ("0_1", "1_1"):
        (out / "tiles" / "tiles" / f"{name}.npz").unlink()
    open_job(images / "left1.tif", images / "right1.tif", out, settings).store.write("failures", "0_1", reason="full")
    result = invoke("status", out)
    assert "4 of 6 tiles done, 1 failed, 1 left; no run is active" in result.stdout
    assert "; 21 path states are handed on\n" in result.stdout  # 5 tiles in three wavefronts, 6 with their matching
    assert "tile 0_1: full" in result.stdout
