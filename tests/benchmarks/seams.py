"""Exact seams against overlaps: processor time of the command, and idle workers of a cluster.

Run as ``python tests/benchmarks/seams.py``; it takes about five minutes. Prints the tables of docs/speed.md.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from candidates import search_range

from sat_intervals.demo import make_scene
from sat_intervals.raster import north_up, write_layer
from sat_intervals.run.schedule import time_of
from sat_intervals.tiling import Grid, Window

SIDE, COUNT, RUNS = 4000, 64, 3
SETTINGS = {
    "overlap 100": ["--overlap", "100"],
    "overlap 200": ["--overlap", "200"],
    "exact": ["--overlap", "exact"],
    "exact, tiles of 256": ["--overlap", "exact", "--tile-size", "256"],
    "exact, `satellite`": ["--preset", "satellite"],
}


def main():
    """Print both tables."""
    with tempfile.TemporaryDirectory() as folder:
        runs = measured(Path(folder))
    base = statistics.median(runs["overlap 100"][0])
    print(f"| {SIDE} x {SIDE} x {COUNT}, one core | processor time | relative |\n|---|---|---|")
    for name, (seconds, _) in runs.items():
        print(f"| {name} | {statistics.median(seconds):.1f} s | {statistics.median(seconds) / base:.2f} |")
    stages, tiles = runs["exact"][1]["seconds"], (-(-SIDE // 1024)) ** 2
    match = sum(stages[f"tiles.{stage}"] for stage in ("read", "match", "write")) / tiles
    trace = stages["tiles.trace"] / (3 * (tiles - 1))
    grid = Grid(Window(0, 0, 40 * 1024, 40 * 1024), 1024)
    print(f"\nTracing takes {trace:.3f} s, matching {match:.3f} s.\n\n| workers | idle time |\n|---|---|")
    for workers in (1, 8, 64):
        print(f"| {workers} | {100 * idle(grid, workers, trace, match):.1f} % |")


def measured(folder):
    """Processor seconds of the command and the last run.json, by setting; runs alternate."""
    scene, place = make_scene(SIDE, SIDE, seed=1), north_up(32633, 0, 0, 0.5)
    for name in ("left", "right"):
        write_layer(folder / f"{name}.tif", getattr(scene, name), 0, place)
    images = [str(folder / f"{name}.tif") for name in ("left", "right")]
    search = [str(end) for end in search_range(COUNT)]
    found = {name: ([], None) for name in SETTINGS}
    for _ in range(RUNS):
        for name, options in SETTINGS.items():
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [Path(sys.executable).with_name("sat-intervals"), "match", *images, folder / "out"]
            command += ["--overwrite", "--quiet", "--workers", "1", "--disparity", *search, *options]
            subprocess.run(
                command,
                check=True,
                preexec_fn=lambda: os.sched_setaffinity(0, {0}),
            )
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            found[name][0].append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
            found[name] = found[name][0], json.loads((folder / "out" / "run.json").read_text())
    return found


def idle(grid, workers, trace, match):
    """Share of the workers' time without work that one worker would do."""
    return 1 - time_of(grid, 1, trace, match) / (workers * time_of(grid, workers, trace, match))


if __name__ == "__main__":
    main()
