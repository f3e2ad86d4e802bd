"""Exact seams against overlaps: processor time and memory of the command, and lost time of a cluster.

Run as ``python tests/benchmarks/seams.py``; it takes about seven minutes. Prints the tables of docs/speed.md.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections import deque
from heapq import heappop, heappush
from pathlib import Path

from candidates import search_range

from sat_intervals.demo import make_scene
from sat_intervals.match.schedule import Schedule
from sat_intervals.raster import north_up, write_layer
from sat_intervals.tiling import Grid, Window

SIDE, COUNT, RUNS = 4000, 64, 3
SETTINGS = {
    "overlap 100": ["--set", "tiles.overlap=100"],
    "overlap 200": ["--set", "tiles.overlap=200"],
    "exact": ["--set", "tiles.overlap=exact"],
    "exact, tiles of 256": ["--set", "tiles.overlap=exact", "--tile-size", "256"],
    "exact, `paper`": ["--preset", "paper"],
}


def main():
    """Print both tables."""
    with tempfile.TemporaryDirectory() as folder:
        runs = measured(Path(folder))
    base = statistics.median(runs["overlap 100"][0])
    print(f"| {SIDE} x {SIDE} x {COUNT}, one core | processor time | relative | peak memory |\n|---|---|---|---|")
    for name, (seconds, memory, _) in runs.items():
        time = statistics.median(seconds)
        print(f"| {name} | {time:.1f} s | {time / base:.2f} | {max(memory) / 1e3:.0f} MB |")
    stages, tiles = runs["exact"][2]["seconds"], (-(-SIDE // 1024)) ** 2
    match = sum(stages[f"tiles.{stage}"] for stage in ("read", "pixels", "match", "write")) / tiles
    trace = stages["tiles.trace"] / (3 * (tiles - 1))
    grid = Grid(Window(0, 0, 40 * 1024, 40 * 1024), 1024)
    print(f"\nTracing takes {trace:.3f} s, matching {match:.3f} s.\n\n| workers | lost time |\n|---|---|")
    for workers in (1, 8, 64):
        print(f"| {workers} | {100 * idle(grid, workers, trace, match):.1f} % |")


def measured(folder):
    """Processor seconds and peak memory in kB of the command, and the last run.json, by setting; runs alternate."""
    scene, place = make_scene(SIDE, SIDE, seed=1), north_up(32633, 0, 0, 0.5)
    for name in ("left", "right"):
        write_layer(folder / f"{name}.tif", getattr(scene, name), 0, place)
    images = [str(folder / f"{name}.tif") for name in ("left", "right")]
    search = [str(end) for end in search_range(COUNT)]
    found = {name: ([], [], None) for name in SETTINGS}
    for _ in range(RUNS):
        for name, options in SETTINGS.items():
            command = [Path(sys.executable).with_name("sat-intervals"), "match", *images, folder / "out"]
            command += ["--overwrite", "--quiet", "--workers", "1", "--disparity", *search, *options]
            process = subprocess.Popen(command, preexec_fn=lambda: os.sched_setaffinity(0, {0}))
            _, status, used = os.wait4(process.pid, 0)
            assert status == 0
            seconds, memory, _ = found[name]
            report = json.loads((folder / "out" / "run.json").read_text())
            found[name] = [*seconds, used.ru_utime + used.ru_stime], [*memory, used.ru_maxrss], report
    return found


def time_of(grid, workers, trace, match):
    """Time that workers take for all steps, from that of tracing and of matching one tile."""
    schedule, now, count, queue, running = Schedule(grid, grid, set().__contains__), 0.0, 0, deque(), []
    while schedule:
        # as in a run, two steps per worker are submitted
        while len(queue) + len(running) < 2 * workers and (step := schedule.next()) is not None:
            queue.append(step)
        while queue and len(running) < workers:
            step, count = queue.popleft(), count + 1
            heappush(running, (now + (match if step.wavefront is None else trace), count, step))
        now, _, step = heappop(running)
        schedule.ended(step)
    return now


def idle(grid, workers, trace, match):
    """Share of the workers' time without work that one worker would do."""
    return 1 - time_of(grid, 1, trace, match) / (workers * time_of(grid, workers, trace, match))


if __name__ == "__main__":
    main()
