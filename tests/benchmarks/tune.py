"""The sweep of `make tune`: penalties, windows and spans against truth and against the guard of roofs.

Scenes of ``SAT_INTERVALS_SHARED``, in memory, fast cross-checking. On WorldView-3 the truth is LiDAR in whole pixels
and biased by a constant: the median error is removed and a truth within 1 px of an interval counts as inside.
"""

import json
import os
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio
from numpy.lib.stride_tricks import sliding_window_view

from sat_intervals import match_arrays
from sat_intervals.config import PRESETS

DATA = Path(os.environ.get("SAT_INTERVALS_SHARED", "../shared")) / "data"
WORLDVIEW = "us3d_jax_079", "us3d_jax_559"
SYNTHETIC = "synth_toulouse_urban", "synth_toulouse_georef", "synth_toulouse_nodata"
MIDDLEBURY = tuple(sorted(path.name for path in DATA.glob("mb200[35]_*")))
TOWNS = "phr_picanteo_pre", "dsm_picanteo"
NOMINAL = 0.9
# A trusted roof: confidence and width of the interval by the paper's settings, and how far it stands off, in pixels,
# the median of its neighbourhood of so many pixels a side, of which every third row and column is looked at.
CONFIDENCE, WIDTH, STEP, SIDE, EVERY = 0.8, 3, 3, 61, 3
MOVED = 1.5  # pixels

CENSUS = {
    5: [(8, 32), (8, 64), (12, 64), (12, 96), (16, 128), (24, 192)],
    7: [(8, 64), (16, 96), (20, 128), (24, 160), (32, 256)],
    9: [(30, 240)],
    11: [(20, 80), (38, 464), (50, 350), (72, 309)],
}
COSINE = [
    (0.5, 3, 40),
    (0.6, 3.5, 36),
    (0.6, 3.5, 42),
    (0.7, 4, 40),
    (0.7, 4, 45),
    (1, 6, 60),
    (2, 12, 110),
]


class Scene(NamedTuple):
    """A pair with its search range; the truth is None where there is none."""

    left: np.ma.MaskedArray
    right: np.ma.MaskedArray
    truth: np.ndarray | None
    search: dict[str, int]


@cache
def read_scene(name: str) -> Scene:
    """A pair of the shared data."""

    def read(file: str) -> np.ma.MaskedArray:
        with rasterio.open(DATA / name / file) as dataset:
            return dataset.read(1, masked=True)

    minimum, maximum = json.loads((DATA / name / "meta.json").read_text())["disparity"]
    truth = read("truth.tif").filled(np.nan) if (DATA / name / "truth.tif").exists() else None
    return Scene(read("left.tif"), read("right.tif"), truth, {"minimum": minimum, "maximum": maximum})


def bands(name: str, settings: dict[str, Any]) -> dict[str, np.ndarray]:
    """Match a scene."""
    scene = read_scene(name)
    found = match_arrays(scene.left, scene.right, {**settings, "disparity": scene.search})
    return {band: found[band].values.astype(np.float64) for band in ("disparity", "lower", "upper", "confidence")}


def judged(name: str, settings: dict[str, Any]) -> dict[str, float]:
    """Figures of one scene with truth."""
    found, truth = bands(name, settings), read_scene(name).truth
    assert truth is not None
    known, is_biased = np.isfinite(truth), name in WORLDVIEW
    kept = known & np.isfinite(found["disparity"])
    disparity, lower, upper, true = (band[kept] for band in (found["disparity"], found["lower"], found["upper"], truth))
    true = true + (np.median(disparity - true) if is_biased else 0.0)
    error, width = np.abs(disparity - true), upper - lower
    missed = np.maximum(np.maximum(lower - true, true - upper) - (1.0 if is_biased else 0.0), 0.0)
    return {
        "good": (error <= 1).sum() / known.sum(),
        "kept": kept.sum() / known.sum(),
        "bad-1": (error > 1).mean(),
        "bad-3": (error > 3).mean(),
        "coverage": (missed == 0).mean(),
        "median width": np.median(width),
        "score": width.mean() + 2 / (1 - NOMINAL) * missed.mean(),  # interval score (Gneiting and Raftery 2007)
    }


@cache
def trusted_roofs(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Disparities by the paper's settings, and the roofs: trusted pixels that differ from their neighbourhood."""
    paper = bands(name, {})
    disparity, side = paper["disparity"], SIDE // EVERY
    sparse = np.pad(disparity[::EVERY, ::EVERY], side // 2, constant_values=np.nan)
    empty = np.isnan(sliding_window_view(sparse, (side, side))).all(axis=(2, 3))
    median = np.full(empty.shape, np.nan)
    for row, windows in enumerate(sliding_window_view(sparse, (side, side))):
        median[row, ~empty[row]] = np.nanmedian(windows[~empty[row]], axis=(1, 2))
    median = median.repeat(EVERY, axis=0).repeat(EVERY, axis=1)[: disparity.shape[0], : disparity.shape[1]]
    trusted = (paper["confidence"] > CONFIDENCE) & (paper["upper"] - paper["lower"] <= WIDTH)
    return disparity, trusted & (np.abs(disparity - median) >= STEP)


def roofs_moved(settings: dict[str, Any]) -> float:
    """Share of the trusted roofs of both towns that move, where they are kept: the worse of the towns."""
    shares = []
    for name in TOWNS:
        before, roofs = trusted_roofs(name)
        after = bands(name, settings)["disparity"]
        roofs = roofs & np.isfinite(after)
        shares.append(float((np.abs(after - before)[roofs] > MOVED).mean()))
    return max(shares)


def means(names: Iterable[str], settings: dict[str, Any]) -> dict[str, float]:
    """Means over scenes."""
    found = [judged(name, settings) for name in names]
    return {figure: float(np.mean([one[figure] for one in found])) for figure in found[0]}


def candidates() -> Iterator[tuple[str, dict[str, Any]]]:
    """Names and settings of the sweep."""
    for window, pairs in CENSUS.items():
        for p1, p2 in pairs:
            yield f"Census {window}, {p1}/{p2}", {"cost": {"window": window}, "sgm": {"p1": p1, "p2": p2}}
    yield "MC-CNN, edges (preset mccnn)", {"preset": "mccnn"}
    for p1, p2, span in COSINE:
        sgm = {"penalty": "constant", "p1": p1, "p2": p2, "span": span}
        yield f"MC-CNN, {p1}/{p2}, K {span}", {"cost": {"method": "mccnn"}, "sgm": sgm}


def row(*cells: object) -> None:
    """Print a row of a table."""
    print("| " + " | ".join(cell if isinstance(cell, str) else f"{cell:.3f}" for cell in cells) + " |", flush=True)


def header(*cells: str) -> None:
    """Print the head of a table."""
    row(*cells)
    row(*["---"] * len(cells))


def sweep() -> None:
    """All candidates: WorldView-3, the guard, the synthetic cities."""
    figures = "good", "bad-1", "bad-3", "kept", "coverage", "median width", "score"
    synthetic = "good", "bad-1", "coverage", "median width", "score"
    names = [*figures, "roofs moved", *(f"synthetic: {name}" for name in synthetic)]
    header("setting", *names)
    for label, settings in candidates():
        real, made = means(WORLDVIEW, settings), means(SYNTHETIC, settings)
        row(label, *(real[name] for name in figures), roofs_moved(settings), *(made[name] for name in synthetic))


def presets() -> None:
    """Figures of every preset by kind of scene."""
    figures = "good", "bad-3", "kept", "coverage", "median width", "score"
    header("preset", "scenes", *figures)
    for preset in PRESETS:
        for label, names in (("WorldView-3", WORLDVIEW), ("synthetic cities", SYNTHETIC), ("Middlebury", MIDDLEBURY)):
            found = means(names, {"preset": preset})
            row(preset, label, *(found[name] for name in figures))


if __name__ == "__main__":
    for table in sys.argv[1:] or ["presets", "sweep"]:
        print()
        {"presets": presets, "sweep": sweep}[table]()
