"""The table of `make bench`: this project, Pandora with libSGM and OpenCV on the same pair, in one run, with ratios.

Everything is measured in processes of their own, one after another, on one pinned core unless two workers are said;
of five runs after one that is not counted the median is given. Figures of another machine mean little: ratios do.
"""

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import rasterio
from candidates import make_pair, search_range

from sat_intervals.demo import PIXEL, make_scene

sys.path.append(str(Path(__file__).parents[1]))
from raw import raw_pair

HERE = Path(__file__).parent
CORES = sorted(os.sched_getaffinity(0))
RUNS = 5


def run(command, cores, environment=None):
    """Seconds, peak memory of the largest process in MB, and processor seconds of a command; and what it printed."""
    started = time.perf_counter()
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # what peers say of themselves
        text=True,
        env=os.environ | (environment or {}),
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
    )
    printed = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"failed with status {process.returncode}: {' '.join(map(str, command))}")
    return time.perf_counter() - started, usage.ru_maxrss / 1024, usage.ru_utime + usage.ru_stime, printed


def candidate(name, size, disparities, runs=RUNS, core=CORES[0]):
    """Median seconds, peak memory and seconds outside the network of MC-CNN of one candidate on one core."""
    command = [sys.executable, HERE / "candidates.py", name, size, size, disparities, runs]
    *_, printed = run([str(part) for part in command], [core])
    result = json.loads(printed.splitlines()[-1])
    outside = [whole - network for whole, network in zip(result["seconds"], result["network"], strict=True)]
    return statistics.median(result["seconds"]), result["megabytes"], statistics.median(outside)


def scaling():
    """How many times as fast two independent `match_arrays` on two cores are as one after another."""
    with ThreadPoolExecutor(2) as threads:
        both = list(threads.map(lambda core: candidate("ours", 2000, 64, 2 * RUNS, core)[0], CORES[:2]))
    return 2 * candidate("ours", 2000, 64)[0] / max(both)


def write_pair(folder, size):
    """A pair of ``size x size`` pixels as GeoTIFFs."""
    paths = []
    for side, image in zip(("left", "right"), make_pair(size, size), strict=True):
        paths.append(folder / f"{side}{size}.tif")
        kind = {"height": size, "width": size, "count": 1, "dtype": "uint16", "nodata": 0, "tiled": True}
        place = {"crs": "EPSG:32631", "transform": rasterio.Affine(0.5, 0, 300000, 0, -0.5, 4800000)}
        with rasterio.open(paths[-1], "w", driver="GTiff", **place, **kind) as file:
            file.write(image, 1)
    return paths


# Prints the processor time of the command itself, without its workers, from the first strip on, and the bytes it wrote.
CLIENT = """
import json, sys, time
from pathlib import Path
from sat_intervals import match_pair
def progress(stage, done, total):
    if stage in ("bands", "files"):
        marks.setdefault(stage, time.process_time())
        marks["end"] = time.process_time()
if __name__ == "__main__":
    left, right, out, minimum, maximum = sys.argv[1:]
    marks, search = {}, {"minimum": int(minimum), "maximum": int(maximum)}
    settings = {"disparity": search, "cluster": {"kind": "processes", "workers": 2}}
    match_pair(left, right, out, settings, overwrite=True, progress=progress)
    print(json.dumps([marks["end"] - marks["bands"], sum(file.stat().st_size for file in Path(out).glob("*.tif"))]))
"""


def client(pair, folder):
    """Processor time of the command while workers finish strips and copy them, and gigabytes written."""
    (folder / "client.py").write_text(CLIENT)
    ends = map(str, search_range(64))
    command = [sys.executable, folder / "client.py", *pair, folder / "client", *ends]
    seconds, written = json.loads(run([str(part) for part in command], CORES)[-1].splitlines()[-1])
    return seconds, written / 1e9


def match(pair, out, workers, disparities=64, environment=None, more=()):
    """Seconds, peak memory in MB, processor seconds and run.json of a whole `sat-intervals match`."""
    ends = map(str, search_range(disparities))
    command = [Path(sys.executable).with_name("sat-intervals"), "match", *pair, out, "--disparity", *ends, "--quiet"]
    command += ["--overwrite", "--workers", workers, *more]
    *figures, _ = run([str(part) for part in command], CORES[:workers], environment)
    return *figures, json.loads((out / "run.json").read_text())


def median_run(pair, out, workers, runs, more=()):
    """Return the result of `match` of the run with the median time."""
    results = (match(pair, out, workers, more=more) for _ in range(runs))
    return sorted(results, key=lambda run: run[0])[runs // 2]


def row(*cells):
    """Print a row of the table."""
    print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)


def in_memory():
    """The chain in memory beside its peers, and its growth with size and disparities."""
    peers = "Pandora + libSGM", "OpenCV `MODE_HH`"
    row("in memory, one core", "this project", *peers, "against Pandora", "against OpenCV")
    row(*["---"] * 6)
    candidate("ours", 100, 64, 1)  # compiles
    for size, disparities in ((1000, 32), (1000, 64), (1000, 128), (1000, 256), (2000, 64), (4000, 64)):
        # Pandora's volume of 4000 x 4000 x 64 does not fit in 24 GB, and its chain takes minutes at 256 disparities
        beside = size * size * disparities <= 3e8 and disparities <= 128
        names = ["ours", "opencv", *(["pandora"] if beside else [])]
        runs = {"ours": RUNS, "opencv": RUNS, "pandora": RUNS if size * disparities <= 64000 else 1}
        seconds, memory = {}, {}
        for name in names:
            seconds[name], memory[name], _ = candidate(name, size, disparities, runs[name])
        shown = {name: f"{seconds[name]:.2f} s, {memory[name]:.0f} MB" for name in names}
        faster = {name: seconds[name] / seconds["ours"] for name in names}
        against = f"{faster['pandora']:.0f} x, memory 1/{memory['pandora'] / memory['ours']:.1f}" if beside else ""
        columns = shown["ours"], shown.get("pandora", ""), shown["opencv"], against, f"{faster['opencv']:.2f} x"
        row(f"{size} x {size} x {disparities}", *columns)


def mccnn():
    """The chain with MC-CNN in memory beside the reference's, with the same network."""
    print()
    row("MC-CNN, in memory, one core, the same network", "this project", "Pandora + MC-CNN + libSGM", "ratio")
    row(*["---"] * 4)
    candidate("ours_mccnn", 100, 64, 1)  # compiles
    for size, disparities in ((1000, 64), (1000, 128)):
        ours, our_memory, our_rest = candidate("ours_mccnn", size, disparities, 3)
        theirs, memory, rest = candidate("pandora_mccnn", size, disparities, 1)
        row(
            f"{size} x {size} x {disparities}",
            f"{ours:.2f} s, {our_memory:.0f} MB",
            f"{theirs:.2f} s, {memory:.0f} MB",
            f"{theirs / ours:.1f} x, memory 1/{memory / our_memory:.1f}",
        )
        row("outside the network", f"{our_rest:.2f} s", f"{rest:.2f} s", f"{rest / our_rest:.0f} x")


def file_to_file(folder):
    """Whole runs of the command: workers, growth, the cost of tiling and files, starting up."""
    print()
    row("files to files, 64 disparities", "figure")
    row("---", "---")
    pairs = {size: write_pair(folder, size) for size in (400, 2000, 4000, 8000)}
    cold = {"NUMBA_CACHE_DIR": str(folder / "cache")}
    first = match(pairs[400], folder / "out", 1, environment=cold)[0]
    row("first run ever, kernels compiled, 400 x 400", f"{first:.1f} s")
    row("the same again", f"{median_run(pairs[400], folder / 'out', 1, RUNS)[0]:.1f} s")
    helps = [run([str(Path(sys.executable).with_name("sat-intervals")), "--help"], CORES[:1])[0] for _ in range(RUNS)]
    row("`sat-intervals --help`", f"{statistics.median(helps):.2f} s")
    one = median_run(pairs[4000], folder / "out", 1, 3)
    row("4000 x 4000, one worker on one core", f"{one[0]:.1f} s, {one[1]:.0f} MB")
    stages = one[3]["seconds"]
    kernels, starting = stages["tiles.match"], one[0] - stages["tiles"] - stages["bands"] - stages["files"]
    row(
        "its stages",
        f"tiles {stages['tiles']:.1f} s (kernels {kernels:.1f} s), rows {stages['bands']:.1f} s, "
        f"files {stages['files']:.1f} s, starting {starting:.1f} s",
    )
    row("what all but the kernels adds to them", f"{100 * (one[0] / kernels - 1):.0f} %")
    row("strips, with reading, compressing and writing", f"{16 / stages['bands']:.0f} Mpx/s")
    if len(CORES) > 1:
        two = median_run(pairs[4000], folder / "out", 2, 3)
        tiles = stages["tiles"] / two[3]["seconds"]["tiles"]
        row("two workers on two cores against one", f"{one[0] / two[0]:.2f} x (tiles {tiles:.2f} x), {two[1]:.0f} MB")
        row("two independent `match_arrays` against one after another", f"{scaling():.2f} x")
    small, large = median_run(pairs[2000], folder / "out", 1, RUNS), median_run(pairs[8000], folder / "out", 1, 1)
    row("cost a pixel, 8000 x 8000 against 2000 x 2000", f"{large[0] / small[0] / 16:.2f}")
    row("peak memory, the same", f"{large[1] / small[1]:.2f} ({large[1]:.0f} and {small[1]:.0f} MB)")
    if len(CORES) > 1:
        seconds, written = client(pairs[8000], folder)
        row("the command itself after its tiles, 8000 x 8000, two processes", f"{seconds:.2f} s for {written:.2f} GB")


# Prints seconds by stage of `surface` of a raw pair, then of `triangulate`, of some runs after one that is not counted.
STAGES = """
import json, sys
from sat_intervals import surface, triangulate
from sat_intervals.progress import clocked, timed
if __name__ == "__main__":
    left, right, out, resolution, runs = sys.argv[1:]
    found = []
    for number in range(int(runs) + 1):
        seconds, made = {}, out + str(number)
        with clocked(seconds, lambda stage, done, total: None) as progress:
            surface([left, right], made, {"cluster": {"workers": 1}}, resolution=float(resolution), progress=progress)
        with timed(seconds, "points"):
            triangulate(made)
        found.append(seconds)
    print(json.dumps(found[1:]))
"""


def stages(folder, size=1800, whole=31000 * 40000):
    """The stages of a surface of a raw pair on one core, and on paper of a large pair on one worker and on 64."""
    print()
    heads = "s per million pixels", "of tiles and files", "one worker", "64 workers"
    row(f"`surface`, raw pair of {size} x {size}", *heads)
    row(*["---"] * 5)
    (folder / "stages.py").write_text(STAGES)
    images = raw_pair(folder / "raw", make_scene(size, size), turns=(0.0, 0.0))  # no corners without data
    command = [sys.executable, folder / "stages.py", *images, folder / "surface", PIXEL, RUNS]
    found = json.loads(run([str(part) for part in command], CORES[:1])[-1].splitlines()[-1])
    seconds = {name: statistics.median(one[name] for one in found) / size**2 for name in found[0]}
    seconds["files"] += seconds.pop("bands")
    matching = seconds["tiles"] + seconds["files"]
    for name in ("resampling", "tiles", "files", "cells", "points"):
        pixel = seconds.pop(name)
        times = f"{whole * pixel / 60:.0f} min", f"{whole * pixel / 64:.0f} s"
        row(name, f"{1e6 * pixel:.2f}", f"{pixel / matching:.2f}", *times)
    row("others: " + ", ".join(seconds), f"{1e6 * sum(seconds.values()):.2f}", "", "", "")


# Options without a setting, and with it.
SETTINGS = {
    "`satellite` instead of `paper`": (("--preset", "paper"), ("--preset", "satellite")),
    "least squares instead of V-fit, with alpha": [
        ("--alpha", 0.9, "--set", f"refinement.method={method}") for method in ("vfit", "least_squares")
    ],
    "a coverage instead of alpha, `satellite`": (("--alpha", 0.9), ("--coverage", 0.9)),
    "a coverage instead of alpha, `paper`": [("--preset", "paper", level, 0.9) for level in ("--alpha", "--coverage")],
    "`satellite-mccnn` instead of `satellite`": ((), ("--preset", "satellite-mccnn")),
    "`mccnn` instead of `paper`": [("--preset", name) for name in ("paper", "mccnn")],
    "`cross_check.method: accurate`": [
        ("--alpha", 0.9, "--set", f"cross_check.method={method}") for method in ("fast", "accurate")
    ],
    "`products.compression: zstd`": ((), ("--set", "products.compression=zstd")),
}


def settings(folder):
    """Processor time with a setting over that without, of runs in turn, since other work changes the speed."""
    print()
    row("2000 x 2000 x 64, one worker, median of pairs of runs", "processor time", "all", "bytes of files")
    row(*["---"] * 4)
    pair, out = write_pair(folder, 2000), folder / "out"
    for name, sides in SETTINGS.items():
        for more in sides:
            match(pair, out, 1, more=more)  # not counted
        ratios = []
        for _ in range(RUNS):
            seconds, sizes = [], []
            for more in sides:
                seconds.append(match(pair, out, 1, more=more)[2])
                sizes.append(sum(file.stat().st_size for file in out.glob("*.tif")))
            ratios.append(seconds[1] / seconds[0])
        range_of = f"{min(ratios):.2f} to {max(ratios):.2f}"
        row(name, f"{statistics.median(ratios):.2f}", range_of, f"{sizes[1] / sizes[0]:.2f}")


def main():
    """Print the tables that are named, by default all."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    print(f"{cpu}, {len(CORES)} cores, {datetime.now(UTC):%Y-%m-%d}, Python {platform.python_version()}\n")
    with tempfile.TemporaryDirectory() as folder:
        parts = {
            "memory": in_memory,
            "mccnn": mccnn,
            "files": partial(file_to_file, Path(folder)),
            "settings": partial(settings, Path(folder)),
            "stages": partial(stages, Path(folder)),
        }
        for name in sys.argv[1:] or parts:
            parts[name]()


if __name__ == "__main__":
    main()
