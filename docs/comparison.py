"""The table of comparison.md: one raw pair through CARS with its own matcher, and through this project.

Usage: python docs/comparison.py PAIR OUT. The terrain is that of raw_picanteo_pre; for another PAIR change HEIGHT, CRS
and the place in write_terrain. PAIR has left.tif, right.tif and their RPC models left.geom, right.geom. It
needs the extras `cars`, `dsm` and `test`.
"""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rasterio
from rasterio.enums import Resampling
from rasterio.transform import from_origin
from rasterio.vrt import WarpedVRT

RESOLUTION, CRS = 1.0, 32637
HEIGHT = 706.0  # metres above the ellipsoid, of the terrain that both are given


def measured(name: str, *command: object, **options: Any) -> dict[str, Any]:
    """Run a command; return its seconds, those of processors, and the peak of its memory (proportional) in MB."""
    began, peak, processor = time.perf_counter(), 0, {}
    process = psutil.Popen([str(word) for word in command], **options)
    ended = threading.Event()

    def watch() -> None:
        nonlocal peak
        while not ended.wait(0.2):
            used = 0
            for one in (process, *process.children(recursive=True)):
                try:
                    used += one.memory_full_info().pss
                    processor[one.pid] = sum(one.cpu_times()[:2])
                except psutil.Error:
                    continue
            peak = max(peak, used)

    watcher = threading.Thread(target=watch)
    watcher.start()
    status = process.wait()
    ended.set()
    watcher.join()
    if status:
        raise SystemExit(f"{name} ended with status {status}")
    return {"s": time.perf_counter() - began, "processor s": sum(processor.values()), "MB": peak / 1e6}


def write_terrain(path: Path) -> Path:
    """Write a flat terrain around the scene."""
    place = from_origin(36.88, 37.61, 0.005, 0.005)
    kind = {"height": 12, "width": 12, "count": 1, "dtype": "float32", "crs": "EPSG:4326", "transform": place}
    with rasterio.open(path, "w", driver="GTiff", **kind) as file:
        file.write(np.full((1, 12, 12), HEIGHT, np.float32))
    return path


def run_cars(pair: Path, folder: Path, command: Path) -> tuple[dict[str, Any], Path]:
    """Make a surface with CARS and its own matcher."""
    sensors = {
        side: {
            "image": str(pair / f"{side}.tif"),
            "geomodel": {"path": str(pair / f"{side}.geom"), "model_type": "RPC"},
        }
        for side in ("left", "right")
    }
    terrain = {"dem": str(write_terrain(folder / "terrain.tif"))}
    configuration = {
        "input": {"sensors": sensors, "pairing": [["left", "right"]], "initial_elevation": terrain},
        "output": {"directory": "cars", "resolution": RESOLUTION, "epsg": CRS, "geoid": False},
        "orchestrator": {"mode": "multiprocessing", "nb_workers": os.cpu_count()},
        "subsampling": {"advanced": {"resolutions": [1]}},
    }
    (folder / "cars.json").write_text(json.dumps(configuration, indent=1))
    with (folder / "cars.log").open("w") as log:
        figures = measured("cars", command, "cars.json", cwd=folder, stdout=log, stderr=subprocess.STDOUT)
    return figures, folder / "cars" / "dsm" / "dsm.tif"


def run_ours(pair: Path, folder: Path, command: Path) -> tuple[dict[str, Any], Path]:
    """Make a surface with this project."""
    models = [word for side in ("left", "right") for word in (f"--{side}-model", pair / f"{side}.geom")]
    images = pair / "left.tif", pair / "right.tif"
    options = "--resolution", RESOLUTION, "--crs", f"EPSG:{CRS}", "--altitude", HEIGHT, "--overwrite", "--quiet"
    out = folder / "sat_intervals"
    return measured("surface", command, "surface", *images, out, *models, *options), out / "dsm.tif"


def on_grid(path: Path, like: Any, band: int = 1) -> np.ndarray:
    """Read a band on the cells of another raster, NaN where it has no value."""
    grid = {"crs": like.crs, "transform": like.transform, "height": like.height, "width": like.width}
    with rasterio.open(path) as file, WarpedVRT(file, resampling=Resampling.nearest, nodata=np.nan, **grid) as warped:
        return np.asarray(warped.read(band), np.float64)


def main(pair: Path, folder: Path) -> None:
    """Run both and print a table."""
    folder.mkdir(parents=True, exist_ok=True)
    scripts = Path(sys.executable).parent
    rows = {}
    for name, run, command in (("CARS", run_cars, "cars"), ("this project", run_ours, "sat-intervals")):
        if run is run_ours:
            run(pair, folder, scripts / command)  # compiles once for all runs; workers of CARS compile in each
        rows[name] = run(pair, folder, scripts / command)
    with rasterio.open(rows["this project"][1]) as like:
        heights = {name: on_grid(path, like) for name, (_, path) in rows.items()}
        lower, upper = (on_grid(rows["this project"][1], like, band) for band in (2, 3))
    print("| | time | processor time | memory | cells with a height |\n|---|---|---|---|---|")
    for name, (figures, _) in rows.items():
        words = [f"{figures['s']:.0f} s", f"{figures['processor s']:.0f} s", f"{figures['MB']:.0f} MB"]
        print(f"| {name} | {' | '.join(words)} | {100 * np.isfinite(heights[name]).mean():.1f} % |")
    theirs, ours = heights["CARS"], heights["this project"]
    error = (ours - theirs)[np.isfinite(ours) & np.isfinite(theirs)]
    inside = ((lower <= theirs) & (theirs <= upper))[np.isfinite(ours) & np.isfinite(theirs)].mean()
    spread = 1.4826 * np.median(np.abs(error - np.median(error)))
    print(f"heights of both: median difference {np.median(error):+.3f} m, NMAD {spread:.2f} m")
    print(
        f"{100 * (np.abs(error) <= 1).mean():.1f} % within 1 m, {100 * inside:.1f} % of those of CARS in our intervals"
    )
    print(f"median half width of our intervals: {np.nanmedian(upper - lower) / 2:.2f} m")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve())
