"""The tables of comparison.md (`make comparison`): raw images through CARS, s2p and this project, against LiDAR.

Usage: python docs/comparison.py IMAGES OUT. IMAGES has raw images 001.tif and others, with RPC tags, and
lidar_west.tif. Commands `cars` and `s2p` are looked for beside python, then on PATH; what is not there has no row. It
needs the extras `dsm` and `test`.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rasterio
from rasterio.transform import rowcol, xy

from sat_intervals.evaluate.comparison import compared, open_comparison, registered
from sat_intervals.products import SURFACE
from sat_intervals.raster.layers import read_known
from sat_intervals.tiling import Window

RESOLUTION, CRS, BAND, CORES = 0.5, 32617, 2, os.cpu_count()
PAIR, THREE = ("003", "004"), ("003", "004", "005")
HEADS = (
    "images, tool | time, s | processor time, s | memory, MB | cells, % | median error, m | mean error, m | coverage | "
    "half width, m"
)
HEADS_PUBLISHED = "method | mean error here, m | time | needs"
# Published figures, which this script does not measure; see comparison.md.
PUBLISHED = """\
| [EOGS++](https://arxiv.org/abs/2511.16542), 19 images | 0.93 | minutes | GPU, 24 GB |
| [EOGS](https://arxiv.org/abs/2412.13047), 19 images | 1.09 | minutes | GPU |"""


def command(name: str) -> str | None:
    """Return a command beside python, or on PATH."""
    return shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)


def measured(*words: object, folder: Path) -> dict[str, float]:
    """Run a command in a folder; return its seconds, those of processors, and the peak of its memory in MB."""
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    peak, seen, ended = 0, {}, threading.Event()
    path = f"{Path(str(words[0])).parent}{os.pathsep}{os.environ['PATH']}"
    with (folder / f"{Path(str(words[0])).name}.log").open("w") as log:
        given = {"cwd": folder, "stdout": log, "stderr": subprocess.STDOUT, "env": {**os.environ, "PATH": path}}
        process = psutil.Popen([str(word) for word in words], **given)

    def watch() -> None:
        nonlocal peak
        while not ended.wait(0.2):
            used = 0
            for one in (process, *process.children(recursive=True)):
                try:
                    used += one.memory_full_info().pss
                    seen[one.pid] = sum(one.cpu_times()[:2])
                except psutil.Error:
                    continue
            peak = max(peak, used)

    watcher = threading.Thread(target=watch)
    watcher.start()
    status = process.wait()
    ended.set()
    watcher.join()
    if status:
        raise SystemExit(f"{words[0]} ended with status {status}: see {log.name}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    waited = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    # Each sum lacks some: processes that live shortly, and those that nobody waits for.
    return {"s": time.perf_counter() - began, "processor s": max(waited, sum(seen.values())), "MB": peak / 1e6}


def write_bands(images: list[Path], folder: Path) -> list[str]:
    """Write the band that is compared, with its RPC model, to files of one band."""
    for path in images:
        with rasterio.open(path) as file:
            kind = {"driver": "GTiff", "width": file.width, "height": file.height, "count": 1, "dtype": "uint8"}
            with rasterio.open(folder / path.name, "w", **kind, rpcs=file.rpcs) as out:
                out.write(file.read(BAND), 1)
    return [path.name for path in images]


def write_surface(heights: Path, half_widths: Path | None, out: Path) -> Path:
    """Write heights of another tool, and half widths if it has them, with the bands of our surfaces."""
    height = read_known(heights)[0]
    half = read_known(half_widths)[-1] if half_widths else np.full_like(height, np.nan)
    values = {"height": height, "height_lower": height - half, "height_upper": height + half}
    with rasterio.open(heights) as like:
        kind = {**like.profile, "driver": "GTiff", "count": len(SURFACE), "dtype": "float32", "nodata": np.nan}
    with rasterio.open(out, "w", **kind) as file:
        for number, band in enumerate(SURFACE, 1):
            file.write(values.get(band.name, np.full_like(height, np.nan)).astype(np.float32), number)
            file.set_band_description(number, band.name)
    return out


def run_cars(images: list[Path], folder: Path, *_: object) -> tuple[dict[str, float], Path]:
    """Make a surface with CARS and its own matcher, all pairs fused, with its map of errors from intervals."""
    names = write_bands(images, folder)
    pairs = [[one, other] for number, one in enumerate(names) for other in names[number + 1 :]]
    maps = {"dense_matching": {"performance_map_method": ["risk", "intervals"]}}
    configuration = {
        "input": {"sensors": {name: {"image": name} for name in names}, "pairing": pairs},
        "output": {
            "directory": "cars",
            "resolution": RESOLUTION,
            "epsg": CRS,
            "geoid": False,
            "auxiliary": {"performance_map": [0]},
        },
        # With the usual 2000 MB it crops ranges of disparities, and a tile fails.
        "orchestrator": {"mode": "multiprocessing", "nb_workers": CORES, "max_ram_per_worker": 4000},
        # With the usual 16, 4, 1 the surface of 4 is empty, and CARS ends.
        "subsampling": {"advanced": {"resolutions": [1]}},
        "surface_modeling": {"applications": {"all": maps}},
    }
    (folder / "cars.json").write_text(json.dumps(configuration, indent=1))
    figures = measured(command("cars"), "cars.json", folder=folder)
    made = folder / "cars" / "dsm"
    return figures, write_surface(made / "dsm.tif", made / "performance_map.tif", folder / "surface.tif")


def run_s2p(images: list[Path], folder: Path, *_: object) -> tuple[dict[str, float], Path]:
    """Make a surface with s2p: the first image with each other one."""
    names = write_bands(images, folder)
    configuration = {
        "images": [{"img": name} for name in names],
        "full_img": True,
        "dsm_resolution": RESOLUTION,
        "out_dir": "s2p",
        "temporary_dir": "temporary",
        "tile_size": 400,
        "max_processes": CORES,
    }
    (folder / "s2p.json").write_text(json.dumps(configuration, indent=1))
    figures = measured(command("s2p"), "s2p.json", folder=folder)
    return figures, write_surface(folder / "s2p" / "dsm.tif", None, folder / "surface.tif")


def run_ours(images: list[Path], folder: Path, *options: object) -> tuple[dict[str, float], Path]:
    """Make a surface with this project."""
    usual = "--band", BAND, "--resolution", RESOLUTION, "--overwrite", "--quiet"
    figures = measured(command("sat-intervals"), "surface", *images, "made", *usual, *options, folder=folder)
    return figures, folder / "made" / "dsm.tif"


def judged(surface: Path, lidar: Path) -> tuple[dict[str, float], np.ndarray]:
    """Return what a surface, moved onto LiDAR by a shift, is worth, and its errors in the cells of LiDAR."""
    comparison, _ = registered(open_comparison(surface, lidar))
    (height, lower, upper, truth, *_), known, _ = compared(comparison, Window(0, 0, *comparison.shape))
    errors = np.full(read_known(lidar)[0].shape, np.nan)
    x, y = (np.asarray(values) for values in xy(comparison.place.transform, *known))
    with rasterio.open(lidar) as file:
        place = np.asarray(rowcol(file.transform, x - comparison.shift[0], y - comparison.shift[1])).astype(int)
    is_inside = ((place >= 0) & (place < np.array(errors.shape)[:, np.newaxis])).all(axis=0)
    errors[tuple(place[:, is_inside])] = np.abs(height - truth)[is_inside]
    has_bounds = np.isfinite(lower) & np.isfinite(upper)
    half, inside = (upper - lower)[has_bounds] / 2, ((lower <= truth) & (truth <= upper))[has_bounds]
    bounds = {"coverage": inside.mean(), "half width": np.median(half)} if half.size else {}
    return {"cells": np.isfinite(errors).sum() / np.isfinite(read_known(lidar)[0]).sum(), **bounds}, errors


def row(name: str, made: dict[str, float], found: dict[str, float], errors: np.ndarray, common: np.ndarray) -> str:
    """Return a row of the first table."""
    words = [name, *(f"{made[key]:.0f}" for key in ("s", "processor s", "MB")), f"{100 * found['cells']:.0f}"]
    words += [f"{of(errors):.2f} ({of(errors[common]):.2f})" for of in (np.nanmedian, np.nanmean)]
    words += [f"{found['coverage']:.3f}", f"{found['half width']:.2f}"] if "coverage" in found else ["none", ""]
    return f"| {' | '.join(words)} |"


def main(images: Path, out: Path) -> None:
    """Run all and print the tables."""
    tools = {"CARS 1.3": run_cars, "s2p": run_s2p, "`surface`": run_ours}
    tools = {name: run for name, run in tools.items() if run is run_ours or command(run.__name__.removeprefix("run_"))}

    def made(numbers: tuple[str, ...], run: Any, *options: object) -> tuple[Any, ...]:
        folder = out / f"{run.__name__}_{len(numbers)}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        figures, surface = run([images / f"{one}.tif" for one in numbers], folder, *options)
        return figures, *judged(surface, images / "lidar_west.tif")

    print(f"| {HEADS} |\n|{'---|' * len(HEADS.split(' | '))}")
    for label, numbers in ("two", PAIR), ("three", THREE):
        made(numbers, run_ours)  # compiles once for all runs; workers of CARS compile in each
        rows = {name: made(numbers, run) for name, run in tools.items()}
        common = np.isfinite([errors for *_, errors in rows.values()]).all(axis=0)
        print(*(row(f"{label}, {name}", *found, common) for name, found in rows.items()), sep="\n", flush=True)
    figures, found, errors = made(tuple(sorted(path.stem for path in images.glob("0*.tif"))), run_ours, "--fill")
    print(f"\n| {HEADS_PUBLISHED} |\n|{'---|' * len(HEADS_PUBLISHED.split(' | '))}\n{PUBLISHED}")
    words = [f"{np.nanmean(errors):.2f}", f"{figures['s']:.0f} s", f"{CORES} cores, {figures['MB']:.0f} MB"]
    print(f"| `surface --fill`, ten images | {' | '.join(words)} |")
    print(f"\nten images: {100 * found['cells']:.1f} % of the cells, median error {np.nanmedian(errors):.2f} m")
    print(f"coverage {found['coverage']:.3f}, half width {found['half width']:.2f} m")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve())
