"""The commands from outside: what they refuse and how, what they print, which files they write."""

import json
import logging
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import click
import numpy as np
import pytest
import rasterio
import yaml
from helpers import COMMAND, LOCK, OUTPUTS, PATIENCE, hashes, invoke, wait_until
from rasterio.errors import NotGeoreferencedWarning
from rio_cogeo.cogeo import cog_validate

from sat_intervals import load_config
from sat_intervals.cli import main, options
from sat_intervals.config import PRESETS, preset_text, resolved
from sat_intervals.demo import make_scene
from sat_intervals.errors import RunError
from sat_intervals.products import FLAGS, INVALID

HALF_METRE = rasterio.Affine(0.5, 0, 300000, 0, -0.5, 4800000)
NOWHERE = {"crs": None, "transform": None}


@pytest.fixture(scope="module")
def scene():
    return make_scene(200, 260)


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    """A pair and what is wrong with others, by name."""
    folder = tmp_path_factory.mktemp("images")
    left, right = scene.left, scene.right
    mask = np.zeros(left.shape, np.uint8)
    mask[:100] = 7
    write(folder / "left.tif", left)
    write(folder / "right.tif", right)
    write(folder / "lower.tif", right[:150])
    write(folder / "narrow.tif", right[:, :200])
    write(folder / "zone.tif", right, crs="EPSG:32632")
    write(folder / "metre.tif", right, transform=HALF_METRE @ rasterio.Affine.scale(2))
    write(folder / "elsewhere.tif", right, transform=rasterio.Affine.translation(40, 3) @ HALF_METRE)
    write(folder / "nowhere.tif", right, **NOWHERE)
    write(folder / "complex.tif", right.astype(np.complex64), nodata=None)
    write(folder / "bands.tif", np.stack([right * 0, right, right * 0]))
    write(folder / "empty.tif", right * 0)
    write(folder / "mask.tif", mask, nodata=None)
    write(folder / "masked.tif", mask * 0 + 1, nodata=None)
    write(folder / "half-mask.tif", mask[:100], nodata=None)
    write(folder / "pixel.tif", left[50:51, 50:51])
    write(folder / "tiny.tif", left[50:53, 50:53])
    write(folder / "strips.tif", left, blockysize=8)
    whole = (folder / "strips.tif").read_bytes()
    (folder / "cut.tif").write_bytes(whole[: len(whole) // 2])
    (folder / "nothing.tif").write_bytes(b"")
    (folder / "text.tif").write_text("no image")
    (folder / "settings.yaml").write_text(yaml.safe_dump({"disparity": search(scene)}))
    return folder


def write(path, bands, **options):
    bands = bands if bands.ndim == 3 else bands[np.newaxis]
    kind = {"count": len(bands), "height": bands.shape[1], "width": bands.shape[2], "dtype": bands.dtype}
    place = {"crs": "EPSG:32631", "transform": HALF_METRE, "nodata": 0} | options
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="GTiff", **kind, **place) as file:
            file.write(bands)


def search(scene):
    return {"minimum": scene.minimum, "maximum": scene.maximum}


def command(*arguments, **options):
    """The command in a process of its own, which may have to compile the kernels."""
    return subprocess.run(
        [COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=300, check=False, **options
    )


def matching(folder, out, *options, left="left.tif", right="right.tif", config="settings.yaml"):
    """The arguments of the command that matches two of the folder's images."""
    return ["match", folder / left, folder / right, out, "--config", folder / config, *options]


def assert_refused(result, *parts, status=2):
    """One line that says all of this, the status of a user's mistake."""
    assert result.exit_code == status, result.output
    assert re.fullmatch(r"sat-intervals: [^\n]+\n", result.stderr), result.stderr
    for part in parts:
        assert str(part) in result.stderr


def assert_nothing_final(out):
    assert not out.is_dir() or not {path.name for path in out.iterdir()} & set(OUTPUTS)


@pytest.fixture(scope="module")
def done(folder, tmp_path_factory):
    """A run with nothing out of the ordinary: its folder and what it printed."""
    out = tmp_path_factory.mktemp("done") / "out"
    return out, invoke(*matching(folder, out, "--tile-size", 64, "--set", "tiles.overlap=20"))


# ---- What is refused before a pixel is read -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--band", 4], ["left.tif has no image band 4, it has band 1 only"]),
        (["--disparity", 9, -4], ["disparity: minimum 9 is above maximum -4, swap them"]),
        (
            ["--disparity", 260, 300],
            ["disparities 260 to 300 move every pixel", "left.tif (260 columns)", "their sign"],
        ),
        (["--disparity", -300, -260], ["disparities -300 to -260 move every pixel", "right.tif (260"]),
        (["--disparity", -200, 60], ["260 columns, fewer than the 261 disparities", "search fewer"]),
        (["--disparity", -99999, 0], ["disparity.minimum is -99999, allowed: integer >= -16000"]),
        (["--disparity", 3, "far"], ["'--disparity': 'far' is not a valid integer", "match --help"]),
        (["--left-mask", "{}/half-mask.tif"], ["half-mask.tif has 100 x 260 pixels", "left.tif 200 x 260", "size"]),
        (["--right-mask", "{}/half-mask.tif"], ["half-mask.tif has 100 x 260 pixels", "right.tif 200 x 260"]),
        (["--right-mask", "{}/absent.tif"], ["absent.tif cannot be read: No such file or directory"]),
        (["--left-mask", ""], ["'--left-mask': it is empty: give a file"]),
        (["--window", 150, 0, 100, 100], ["row 150, column 0, 100 x 100 pixels: must be inside", "200 x 260 pixels"]),
        (["--window", -1, 0, 100, 100], ["row -1, column 0, 100 x 100 pixels: must be inside", "left.tif"]),
        (["--window", 0, 0, 0, 9], ["0 x 9 pixels: must be inside"]),
        (["--tile-size", 100], ["tiles.size is 100, allowed: integer >= 64, ", "multiple of 64"]),
        (["--set", "tiles.overlap=2"], ["tiles.overlap is 2, allowed: >= 4 with cost.window 7"]),
        (["--set", "tiles.overlap"], ["--set tiles.overlap: give KEY=VALUE"]),
        (
            ["--disparity", -9, 4, "--set", "disparity=5"],
            ["--disparity and --set disparity.minimum: disparity is also given as a whole"],
        ),
        (
            ["--disparity", -9, 4, "--set", "disparity.maximum=9"],
            ["--disparity and --set disparity.maximum: given twice"],
        ),
        (["--workers", 0], ["'--workers': 0 is not in the range x>=1"]),
        (["--workers", -2], ["'--workers': -2 is not in the range x>=1"]),
        (["--nodata", "none"], ["'--nodata': 'none' is neither a number nor two, LEFT,RIGHT"]),
        (["--config", "{}/absent.yaml"], ["absent.yaml: No such file or directory"]),
        (["--config", "{}"], [": Is a directory"]),
        (["--config", "{}/left.tif"], ["left.tif: "]),
        (["--unknown"], ["No such option '--unknown'", "match --help"]),
        (["third"], ["unexpected extra argument (third)"]),
    ],
    ids=lambda value: " ".join(map(str, value)),
)
def test_match__refuses_options_that_do_not_suit_the_pair(folder, tmp_path, options, says):
    options = [str(option).format(folder) for option in options]
    assert_refused(invoke(*matching(folder, tmp_path / "out", *options)), *says)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("place", [0, 1, 2])
def test_match__refuses_empty_names(folder, tmp_path, place):
    arguments = matching(folder, tmp_path / "out")
    arguments[1 + place] = ""
    assert_refused(invoke(*arguments), f"'{('LEFT', 'RIGHT', 'OUT')[place]}': it is empty: give a file or folder")


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("{}/left.tif", "left.tif is not a folder: choose another"),
        ("{}/left.tif/out", "left.tif/out cannot be written: Not a directory: choose another folder"),
        ("/proc/out", "/proc/out cannot be written: "),
        ("{}/" + 300 * "o", "cannot be read: File name too long: choose another folder"),
    ],
    ids=["file", "below a file", "proc", "long"],
)
def test_match__refuses_an_output_that_cannot_be_written(folder, place, says):
    if place.startswith("/proc") and not Path("/proc").is_dir():
        pytest.skip("no /proc here")
    before = sorted(folder.iterdir())
    assert_refused(invoke(*matching(folder, place.format(folder))), says)
    assert sorted(folder.iterdir()) == before


# ---- What shows itself on the way -----------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "options", "says"),
    [
        ({"left": "empty.tif"}, [], "all pixels of {0}/empty.tif are no data or masked"),
        ({"right": "empty.tif"}, [], "all pixels of {0}/empty.tif are no data or masked"),
        ({}, ["--left-mask", "{0}/masked.tif"], "all pixels of {0}/left.tif are no data or masked"),
        ({}, ["--disparity", 259, 259], "nowhere do both images have 7 x 7 usable pixels"),
        (
            {"left": "pixel.tif", "right": "pixel.tif"},
            ["--disparity", 0, 0],
            "nowhere do both images have 7 x 7 usable pixels",
        ),
        (
            {"left": "tiny.tif", "right": "tiny.tif"},
            ["--disparity", 0, 1],
            "nowhere do both images have 7 x 7 usable pixels",
        ),
        ({}, ["--window", 0, 0, 1, 1], "nowhere do both images have 7 x 7 usable pixels"),
    ],
    ids=["left", "right", "mask", "range", "pixel", "tiny", "window"],
)
def test_match__says_why_no_pixel_can_be_matched(folder, tmp_path, arguments, options, says):
    options = [str(option).format(folder) for option in options]
    result = invoke(*matching(folder, tmp_path / "out", "--quiet", *options, **arguments))
    assert_refused(result, "no pixel of ", says.format(folder), "check no-data values, masks, window and search range")
    assert result.stdout == ""
    assert_nothing_final(tmp_path / "out")


def test_match__shows_a_traceback_only_when_asked(folder, tmp_path):
    arguments = matching(folder, tmp_path / "out", right="lower.tif")
    assert_refused(invoke(*arguments))
    shown = invoke(*arguments, "--debug")
    assert shown.exit_code == 2
    assert "Traceback (most recent call last)" in shown.stderr
    assert shown.stderr.splitlines()[-1].startswith("sat-intervals: ")


@pytest.mark.parametrize(
    ("error", "status", "says"),
    [
        (OSError(28, "No space left on device", "/there/file"), 1, "/there/file: No space left on device"),
        (OSError(28, "No space left on device"), 1, "sat-intervals: No space left on device"),
        (
            OSError(12, "Cannot allocate memory"),
            1,
            "not enough memory: choose a smaller --tile-size or fewer --workers",
        ),
        (MemoryError("9 GB"), 1, "not enough memory: choose a smaller --tile-size or fewer --workers (9 GB)"),
        (ZeroDivisionError("by zero"), 1, "ZeroDivisionError: by zero (this should not happen; --debug shows where)"),
    ],
)
def test_match__tells_what_nobody_foresaw_in_one_line(folder, tmp_path, monkeypatch, error, status, says):
    def fail(*arguments, **options):
        raise error

    monkeypatch.setattr("sat_intervals.run.pair.match_pair", fail)
    assert_refused(invoke(*matching(folder, tmp_path / "out")), says, status=status)


# ---- What is logged ---------------------------------------------------------------------------------------------
LINE = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (?:DEBUG  |INFO   |WARNING|ERROR  ) (\S+): (.*)"
# dask adds a traceback if a worker is gone before the scheduler has sent it its last message.
RECORD = rf"{LINE}\n(?:Traceback \(most recent call last\):\n(?:(?!\d{{4}}-).*\n)*)?"


def logged(text):
    """Logger and message of every line that has them."""
    return re.findall(f"^{LINE}$", text, re.MULTILINE)


@pytest.mark.process
@pytest.mark.parametrize("cluster", ["threads", "processes"])
def test_debug__shows_stages_tiles_and_workers_and_what_dask_says(folder, tmp_path, cluster):
    options = ["--quiet", "--tile-size", 128, "--cluster", cluster, "--workers", 2, "--debug"]
    result = command(*matching(folder, tmp_path / "out", *options))
    assert (result.returncode, result.stdout) == (0, "")
    words = logged(result.stderr)
    assert re.fullmatch(f"(?:{RECORD})*", result.stderr)
    for stage in ("start", "kernels", "tiles", "bands", "files"):
        assert [message for _, message in words if re.fullmatch(rf"stage {stage} begins", message)]
        assert [message for _, message in words if re.fullmatch(rf"stage {stage} ended after \d+\.\d s", message)]
    tiles = [f"{row}_{column}" for row in range(2) for column in range(3)]
    done = [message for name, message in words if name == "sat_intervals.run.pair"]
    of_tiles = [message for message in done if re.search(r"tile \d_\d done$", message)]
    assert sorted(of_tiles) == [f"{tmp_path / 'out'}: tile {tile} done" for tile in tiles]
    assert len(done) >= 6 + 3 * 5  # three wavefronts, each without the tile where it ends
    took = [re.match(r"tile (\d_\d): read \d+\.\d\d s, match \d+\.\d\d s", message) for _, message in words]
    assert sorted(match[1] for match in took if match) == tiles
    joined = [message for name, message in words if re.fullmatch(r"worker \S+ joined", message)]
    assert len(joined) == (2 if cluster == "processes" else 0)
    assert ("distributed.scheduler" in {name for name, _ in words}) is (cluster == "processes")
    assert re.fullmatch(r"sat-intervals match ended after \d+\.\d s", words[-1][1])


@pytest.mark.process
def test_log_file__keeps_what_debug_shows_and_what_it_held(folder, tmp_path):
    log = tmp_path / "run.log"
    log.write_text("2026-01-31 12:00:00,000 INFO    mine: before\n")
    options = ["--quiet", "--tile-size", 64, "--set", "tiles.overlap=5", "--cluster", "processes", "--workers", 1]
    arguments = matching(folder, tmp_path / "out", *options, "--log-file", log, left="cut.tif")
    result = command(*arguments)
    assert (result.returncode, result.stdout) == (1, "")
    assert all(line.startswith(("sat-intervals: ", "  tile ")) for line in result.stderr.splitlines())
    kept = log.read_text()
    assert kept.startswith("2026-01-31 12:00:00,000 INFO    mine: before\n2")
    words = logged(kept)
    assert {"sat_intervals.run.tile", "sat_intervals.run.submit", "distributed.scheduler"} <= {
        name for name, _ in words
    }
    assert len([message for _, message in words if message.endswith("tile 3_4 done")]) == 0
    assert len([message for _, message in words if "tile 3_4 failed: " in message]) == 1
    retries = load_config(folder / "settings.yaml").cluster.retries
    tries = [message for _, message in words if message.startswith("tile 3_4 failed; ")]
    assert tries == [f"tile 3_4 failed; it is tried again at most {retries} times"] * (1 + retries)
    assert "Traceback (most recent call last)" in kept
    assert "\nsat_intervals.errors.RunError: " in kept
    command(*arguments)
    assert log.read_text().startswith(kept)
    assert len(log.read_text()) > len(kept)


def test_match__says_a_warning_once_where_a_library_has_set_up_logging(folder, tmp_path, capfd):
    handler = logging.StreamHandler()
    logging.root.addHandler(handler)
    try:
        result = invoke(*matching(folder, tmp_path / "out", "--disparity", 0, 9, "--log-file", tmp_path / "log"))
    finally:
        logging.root.removeHandler(handler)
    assert result.exit_code == 0
    assert result.stderr.count("try --disparity") == 1
    assert "try --disparity" not in capfd.readouterr().err
    assert (tmp_path / "log").read_text().count("try --disparity") == 1


@pytest.mark.parametrize("options", [[], ["--debug"], ["--debug", "--log-file", "run.log"]])
def test_commands__leave_logging_as_it_was(folder, tmp_path, monkeypatch, options):
    """Whether they succeed or fail."""

    def fail(*arguments, **options):
        logging.getLogger("sat_intervals.run.pair").warning("two\nlines")
        raise RunError("in vain")

    def state():
        loggers = map(logging.getLogger, ("root", "sat_intervals", "distributed", "asyncio"))
        return [(logger.level, logger.handlers[:], logger.filters[:]) for logger in loggers]

    monkeypatch.chdir(tmp_path)
    before = state()
    assert invoke(*matching(folder, tmp_path / "out"), *options).exit_code == 0
    monkeypatch.setattr("sat_intervals.run.pair.match_pair", fail)
    assert invoke(*matching(folder, tmp_path / "out"), *options).exit_code == 1
    assert state() == before


def test_match__shows_a_warning_in_a_line(folder, tmp_path, monkeypatch):
    def warn(*arguments, **options):
        log = logging.getLogger("sat_intervals.run.pair")
        log.info("nobody asked")
        log.warning("%d doubts", 3)
        raise RunError("in vain")

    monkeypatch.setattr("sat_intervals.run.pair.match_pair", warn)
    arguments = matching(folder, tmp_path / "out")
    assert invoke(*arguments).stderr == "warning: 3 doubts\nsat-intervals: in vain\n"
    words = logged(invoke(*arguments, "--debug").stderr)
    assert words == [
        ("sat_intervals.cli.logs", "main match begins"),
        ("sat_intervals.run.pair", "nobody asked"),
        ("sat_intervals.run.pair", "3 doubts"),
        ("sat_intervals.cli.logs", "main match failed"),
    ]


def test_log_file__that_cannot_be_written_is_refused(folder, tmp_path):
    log = tmp_path / "none" / "run.log"
    result = invoke(*matching(folder, tmp_path / "out", "--log-file", log))
    assert_refused(result, f"{log} cannot be written: No such file or directory: choose another --log-file")
    assert not (tmp_path / "out").exists()


def test_log_file__on_a_full_disk_does_not_stop_the_run(folder, tmp_path):
    result = invoke(*matching(folder, tmp_path / "out", "--log-file", "/dev/full"))
    assert result.exit_code == 0, result.output
    assert result.stderr == "sat-intervals: /dev/full: No space left on device: the log ends here\n"


# ---- A run that is ended ----------------------------------------------------------------------------------------
def ended_by(number, arguments, out, *, together=False):
    """The command, sent a signal when its first tile is done: status, stdout, stderr."""
    arguments = [COMMAND, *map(str, arguments)]
    with subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            wait_for_a_tile(process, out)
            (os.killpg if together else os.kill)(process.pid, number)
            said = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    return process.returncode, *said


def wait_for_a_tile(process, out):
    wait_until(lambda: list(out.glob("tiles/tiles/[0-9]*.npz")) or process.poll() is not None, "a tile")
    assert process.poll() is None, process.communicate()


@pytest.mark.process
@pytest.mark.parametrize(
    ("number", "word", "status"), [(signal.SIGINT, "interrupted", 130), (signal.SIGTERM, "terminated", 143)]
)
def test_match__ended_by_a_signal_leaves_tiles_and_the_next_try_goes_on(folder, tmp_path, done, number, word, status):
    out = tmp_path / "out"
    arguments = matching(folder, out, "--tile-size", 64, "--set", "tiles.overlap=20", "--workers", 1)
    returned, _, errors = ended_by(number, arguments, out)
    assert (returned, errors) == (status, f"sat-intervals: {word}; rerun the same command: it resumes\n")
    assert sorted(path.name for path in out.iterdir()) == [LOCK, "tiles"]
    before = {path: path.stat().st_mtime_ns for path in out.glob("tiles/tiles/[0-9]*.npz")}
    again = command(*arguments, "--keep-tiles", "--quiet")
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert hashes(out) == hashes(done[0])


@pytest.mark.process
def test_match__interrupted_at_a_terminal_hears_nothing_of_its_workers(folder, tmp_path):
    """A terminal sends Ctrl-C to every process of the group."""
    out = tmp_path / "out"
    arguments = matching(folder, out, "--tile-size", 64, "--cluster", "processes", "--workers", 2)
    returned, _, errors = ended_by(signal.SIGINT, arguments, out, together=True)
    assert returned == 130
    assert "sat-intervals: interrupted; rerun the same command" in errors
    assert "Traceback" not in errors
    assert "Ctrl" not in errors
    assert_nothing_final(out)


# ---- What a run prints ------------------------------------------------------------------------------------------
def test_match__prints_plain_lines_and_a_table(done):
    out, result = done
    assert (result.exit_code, result.stderr) == (0, "")
    assert "\x1b" not in result.stdout
    lines = result.stdout.splitlines()
    assert lines[0].startswith("comparing rows")
    stages = ["matching tiles: 20", "postprocessing rows: 200", "writing files: 2"]
    assert [line for line in lines if line.startswith(("matching", "postprocessing", "writing"))] == stages
    assert lines[-4:-1] == [str(out / name) for name in ("intervals.tif", "validity.tif", "run.json")]
    assert lines[-1] == f"next: sat-intervals report {out}"
    report = json.loads((out / "run.json").read_text())
    assert set(report["counts_meaning"]) <= set(report["counts"])
    assert report["counts"]["flags"]["regularized"] >= report["counts"]["low_confidence"] > 0
    share = 100 * report["counts"]["valid"] / report["counts"]["pixels"]
    assert re.search(rf"^valid pixels +{share:.1f} %$", result.stdout, re.MULTILINE)
    assert re.search(r"^median interval width +\d+\.\d\d px$", result.stdout, re.MULTILINE)
    for cause in ("no data or border", "occlusion", "mismatch", "low confidence, of valid pixels"):
        assert re.search(rf"^ *{cause} +\d+\.\d %$", result.stdout, re.MULTILINE)
    assert re.search(r"^time +\d+\.\d s$", result.stdout, re.MULTILINE)


def test_match__warns_of_results_among_the_images(folder, tmp_path):
    here = shutil.copytree(folder, tmp_path / "here")
    result = invoke(*matching(here, here, "--quiet", "--overwrite"))
    assert result.exit_code == 0
    assert result.stderr == f"warning: {here} also holds the images: write to another folder\n"


@pytest.mark.process
def test_match__draws_a_bar_on_a_terminal(folder, tmp_path):
    ours, theirs = pty.openpty()
    arguments = matching(folder, tmp_path / "out", "--tile-size", 64, "--set", "tiles.overlap=20")
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100"}
    with subprocess.Popen(
        [COMMAND, *map(str, arguments)], stdout=theirs, stderr=theirs, stdin=theirs, env=environment
    ) as process:
        os.close(theirs)
        shown = b"".join(iter(lambda: read_terminal(ours), b"")).decode()
        assert process.wait(PATIENCE) == 0
    os.close(ours)
    assert "━" in shown
    assert re.search(r"matching tiles[^\n]*━[^\n]*\d+/20", shown)
    after = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)[-2000:]
    assert "valid pixels" in after
    assert after.rstrip().splitlines()[-1].startswith("next: sat-intervals report")


def read_terminal(terminal):
    try:
        return os.read(terminal, 1 << 16)
    except OSError:  # how Linux says that the other side is closed
        return b""


# ---- What files others find -------------------------------------------------------------------------------------
def test_match__writes_what_rasterio_reads(folder, done):
    out, _ = done
    with rasterio.open(out / "intervals.tif") as file, rasterio.open(folder / "left.tif") as left:
        assert file.descriptions == ("disparity", "lower", "upper", "confidence")
        assert file.units == ("px", "px", "px", None)
        assert file.dtypes == ("float32",) * 4
        assert all(np.isnan(nodata) for nodata in file.nodatavals)
        assert (file.shape, file.crs, file.transform) == (left.shape, left.crs, left.transform)
        assert file.compression.name == "deflate"
        assert all(height <= 512 and width <= 512 for height, width in file.block_shapes)
        disparity, lower, upper, confidence = file.read()
    with rasterio.open(out / "validity.tif") as file:
        assert (file.count, file.dtypes, file.descriptions) == (1, ("uint16",), ("validity",))
        assert (file.crs, file.transform) == ("EPSG:32631", HALF_METRE)
        assert file.nodata is None
        tags = file.tags(1)
        assert all(flag.meaning in tags[f"bit_{flag.bit:02}"] for flag in FLAGS)
        validity = file.read(1)
    valid = validity & INVALID == 0
    for band in (disparity, lower, upper):
        np.testing.assert_array_equal(np.isfinite(band), valid)
    assert (lower[valid] <= disparity[valid]).all()
    assert (disparity[valid] <= upper[valid]).all()
    assert (confidence[valid] >= 0).all()
    assert (confidence[valid] <= 1).all()
    assert valid.mean() > 0.7


@pytest.mark.parametrize("name", ["intervals.tif", "validity.tif"])
def test_match__writes_what_rio_cogeo_takes_for_valid(done, name):
    assert cog_validate(done[0] / name, strict=True) == (True, [], [])


@pytest.mark.parametrize("right", ["elsewhere.tif", "narrow.tif", "nowhere.tif"])
def test_match__takes_right_images_of_another_origin_width_or_none(folder, tmp_path, right):
    assert invoke(*matching(folder, tmp_path / "out", right=right)).exit_code == 0
    with rasterio.open(tmp_path / "out" / "intervals.tif") as file:
        assert (file.crs, file.transform, file.shape) == ("EPSG:32631", HALF_METRE, (200, 260))
        assert np.isfinite(file.read(1)).mean() > 0.4


def test_match__takes_the_band_asked_for_of_each_image(folder, tmp_path, scene, done):
    write(tmp_path / "left.tif", np.stack([scene.left * 0, scene.left]))
    arguments = matching(folder, tmp_path / "out", left=tmp_path / "left.tif", right="bands.tif")
    result = invoke(*arguments, "--band", 2, "--tile-size", 64, "--set", "tiles.overlap=20")
    assert result.exit_code == 0, result.output
    assert hashes(tmp_path / "out") == hashes(done[0])


def test_match__command_line_wins_over_the_file(folder, tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "disparity: {minimum: -5, maximum: 5}\ntiles: {size: 128}\ninterval: {alpha: 0.8}"
    )
    arguments = matching(folder, tmp_path / "out", "--disparity", -3, 4, config=tmp_path / "mine.yaml")
    assert invoke(*arguments, "--set", "tiles.overlap=7").exit_code == 0
    settings = json.loads((tmp_path / "out" / "run.json").read_text())["settings"]
    assert settings["disparity"].items() >= {"minimum": -3, "maximum": 4}.items()
    assert settings["tiles"] == {"size": 128, "overlap": 7}
    assert settings["interval"]["alpha"] == 0.8


# ---- The other commands -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "preset",
    [
        pytest.param(name, marks=pytest.mark.peer("onnxruntime", "mc_cnn") if "mccnn" in name else ())
        for name in PRESETS
        if name != "many"
    ],
)
def test_config__prints_settings_that_match_takes(folder, tmp_path, preset):
    result = invoke("config", "--preset", preset)
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == preset_text(preset)
    (tmp_path / "preset.yaml").write_text(result.stdout)
    settings = load_config(tmp_path / "preset.yaml", {"disparity": {"minimum": -9, "maximum": 9}})
    options = "--window", 60, 80, 70, 90, "--disparity", -9, 9
    arguments = matching(folder, tmp_path / "out", *options, config=tmp_path / "preset.yaml")
    result = invoke(*arguments)
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert load_config(report["settings"]) == resolved(settings)


def test_match__refuses_the_preset_of_many_images(folder, tmp_path):
    assert invoke("config", "--preset", "many").stdout == preset_text("many")
    arguments = "match", folder / "left.tif", folder / "right.tif", tmp_path / "out", "--preset", "many"
    assert_refused(
        invoke(*arguments), "cost.method is sweep, which compares many images: use surface with three or more"
    )


def test_config__prints_the_defaults_without_options():
    assert invoke("config").stdout == preset_text("satellite")
    assert_refused(
        invoke("config", "--preset", "sea"), "'--preset': 'sea' is not one of 'satellite', 'satellite-mccnn', "
    )


def test_options__offer_the_presets_of_the_settings():
    assert options.PRESETS == PRESETS


def test_demo__makes_a_scene_matches_it_and_tells_how_often_the_interval_holds(tmp_path):
    out = tmp_path / "out"
    arguments = ("demo", out, "--size", 150, 180, "--seed", 4)
    result = invoke(*arguments)
    assert result.exit_code == 0
    assert result.stderr == ""  # no warning, though much of a small scene lies beside the images' borders
    assert sorted(path.name for path in out.iterdir()) == sorted([LOCK, *OUTPUTS, "left.tif", "right.tif", "truth.tif"])
    lines = result.stdout.splitlines()
    held = next(line for line in lines if line.startswith("The interval contains"))
    found = re.fullmatch(
        r"The interval contains the truth for (\d+\.\d) % of (\d+) pixels, at a mean width of (\d+\.\d\d) px\.", held
    )
    scene = make_scene(150, 180, seed=4)
    with rasterio.open(out / "truth.tif") as file:
        np.testing.assert_array_equal(file.read(1), scene.truth)
    with rasterio.open(out / "intervals.tif") as file:
        assert (file.crs, file.res) == ("EPSG:32631", (0.5, 0.5))
        _, lower, upper, _ = file.read()
    judged = np.isfinite(lower) & np.isfinite(scene.truth)
    holds = (lower <= scene.truth) & (scene.truth <= upper)
    assert int(found[2]) == judged.sum()
    assert float(found[1]) == pytest.approx(100 * holds[judged].mean(), abs=0.051)
    assert float(found[1]) > 80
    before = hashes(out)
    other = invoke(*arguments[:-1], 5)
    assert_refused(other, f"{out / 'left.tif'} exists: choose another name or --overwrite")
    assert invoke(*arguments, "--overwrite", "--quiet").stdout == ""
    assert hashes(out) == before


COMMANDS = [(), *((name,) for name in sorted(main.commands))]


@pytest.mark.parametrize("name", COMMANDS, ids=lambda name: " ".join(name) or "sat-intervals")
def test_help__tells_every_option(name):
    result = invoke(*name, "--help")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "\\b" not in result.stdout
    asked = main.commands[name[0]] if name else main
    for parameter in asked.params:
        if isinstance(parameter, click.Option):
            assert parameter.help, parameter.name
            assert parameter.opts[0] in result.stdout
    assert all(len(line) <= 80 for line in result.stdout.splitlines())


def test_help__waits_for_no_library():
    """What makes a command slow to start: none of it is imported for help, or to refuse an argument."""
    slow = {"numba", "dask", "distributed", "rasterio", "xarray", "pydantic", "numpy", "rich"}
    code = (
        "import sys\nfrom sat_intervals.cli import main\n"
        "for arguments in (['--help'], ['match', '--help'], ['match', 'left']):\n"
        "    try: main(arguments)\n    except SystemExit: pass\n"
        f"print(*{slow!r} & sys.modules.keys(), file=sys.stderr, end='')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stderr.splitlines()[-1].startswith("sat-intervals: Missing argument 'RIGHT'")


def test_version__is_that_of_the_package():
    from sat_intervals import __version__

    assert command("--version").stdout == f"sat-intervals, version {__version__}\n"


def test_commands__are_guessed_at():
    assert_refused(invoke("mach"), "No such command 'mach'", "'match'", "--help")


@pytest.mark.peer("shareloc")
@pytest.mark.parametrize("command", ["triangulate", "export", "evaluate", "calibrate", "reference"])
def test_commands_of_a_pair__refuse_a_run_of_many_images(command, swept, tmp_path):
    options = {
        "export": [tmp_path / "to", "--to", "otb"],
        "calibrate": ["--output", tmp_path / "calibration.yaml"],
        "reference": ["--heights", swept / "dsm.tif", "--ellipsoid"],
    }
    before = {file: file.read_bytes() for file in swept.glob("*.*")}
    done = invoke(command, swept, *options.get(command, []))
    assert done.exit_code == 2
    assert f"{swept} is the surface of 3 images, without disparities of a pair: use " in done.output
    assert done.output.count("\n") == 1
    assert not list(tmp_path.iterdir())
    assert {file: file.read_bytes() for file in swept.glob("*.*")} == before


@pytest.mark.peer("shareloc")
def test_status__of_many_images_is_complete(swept):
    assert invoke("status", swept).output == f"{swept}: complete\n"


@pytest.mark.peer("shareloc")
def test_match__refuses_the_folder_of_many_images(swept, folder):
    done = invoke("match", folder / "left.tif", folder / "right.tif", swept, "--disparity", -20, 20)
    assert done.exit_code == 2
    assert f"{swept} already holds another run" in done.output
    assert "Traceback" not in done.output
