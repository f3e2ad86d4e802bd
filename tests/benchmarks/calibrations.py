"""Make the built-in calibrations (`make calibration`), one for each preset, on the pairs of ``SAT_INTERVALS_SHARED``.

Twelve scenes with truth to 1/3 px or better. Those of the satellite presets have two WorldView-3 tiles beside them,
with LiDAR truth in whole pixels: their bias is removed, and a truth within 1 px of an interval counts as inside. Where
intervals follow least squares, each scene has a noisy twin in its group: white noise in both images, independent.
What is measured is kept in ``build/measured``, for `make coverage` too, until the sources of the method change.
"""

import gzip
import hashlib
import json
import os
import pickle
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import rasterio

from sat_intervals.cli.tables import show_calibration
from sat_intervals.config import PRESETS, key_of, load_config
from sat_intervals.match.mccnn import MccnnCost
from sat_intervals.match.measurement import Measured
from sat_intervals.raster import open_image
from sat_intervals.run.calibrate import calibration_from
from sat_intervals.run.measure import CalibrationScene, measure_scenes, truth_of
from sat_intervals.tiling import View
from sat_intervals.workflows.calibrate import write_calibration

DATA = Path(os.environ.get("SAT_INTERVALS_SHARED", "../shared")) / "data"
ROOT = Path(__file__).parents[2]
OUT, KEPT, TWINS = ROOT / "configs" / "calibrations", ROOT / "build" / "measured", ROOT / "build" / "noisy"
# A measurement depends on these, and on the pairs.
SOURCES = "kernels/*.py", "match/[!c]*.py", "products.py", "run/measure.py"  # not how levels are chosen
MIDDLEBURY = (
    "mb2001_venus", "mb2003_cones", "mb2003_teddy", "mb2005_art", "mb2005_books", "mb2005_dolls", "mb2005_laundry",
    "mb2005_moebius", "mb2005_reindeer",
)  # fmt: skip
SYNTHETIC = ("synth_toulouse_georef", "synth_toulouse_nodata", "synth_toulouse_urban")
DEVELOPMENT = MIDDLEBURY + SYNTHETIC
WORLDVIEW = ("us3d_jax_079", "us3d_jax_559")
PAIRED = PRESETS[:-1]  # many: calibration_many.py
NOISE = 0.1, 0.2, 0.3  # in rotation: deviation of a twin's noise, a share of the images' high-pass deviation


def settings_of(name: str) -> dict[str, Any]:
    """Return the settings of a preset, or of penalties such as ``census 5, 8/64`` or ``mccnn, 1/6``, with its span."""
    if name in PRESETS:
        return {"preset": name}
    cost, _, penalties = name.partition(", ")
    lower, upper = map(float, penalties.split("/"))
    if cost == "mccnn":
        sgm = {"penalty": "constant", "p1": lower, "p2": upper, "span": 10 * upper}
        return {"preset": "satellite-mccnn", "sgm": sgm}
    return {"cost": {"window": int(cost.split()[1])}, "sgm": {"p1": int(lower), "p2": int(upper)}}


def scenes_of(preset: str) -> tuple[str, ...]:
    """Return the scenes that the calibration of a preset is made from."""
    return DEVELOPMENT + WORLDVIEW if preset.startswith("satellite") else DEVELOPMENT


def group_of(scene: str) -> str:
    """Return what is left out with a scene: tiles of one city are a group, close-range scenes are each on their own."""
    return "_".join(scene.split("_")[:2])


def search_of(scene: str) -> dict[str, int]:
    """Return the search range of a scene."""
    minimum, maximum = json.loads((DATA / scene / "meta.json").read_text())["disparity"]
    return {"minimum": minimum, "maximum": maximum}


def tolerance_of(scene: str) -> float:
    """Return the tolerance of the truth of a scene; where there is one, the bias is removed too."""
    return 1.0 if scene in WORLDVIEW else 0.0


def read(scene: str, name: str) -> np.ma.MaskedArray:
    """Read an image of a pair; no data is masked."""
    with rasterio.open(DATA / scene / f"{name}.tif") as file:
        return np.ma.masked_array(file.read(1), file.dataset_mask() == 0)


def noisy(image: np.ma.MaskedArray, share: float, seed: int) -> np.ma.MaskedArray:
    """Add white noise of a share of the deviation of an image from its means over 5 x 5 pixels."""
    if not share:
        return image
    filled = image.astype(np.float32).filled(np.ma.median(image))
    means = np.lib.stride_tricks.sliding_window_view(np.pad(filled, 2, "edge"), (5, 5)).mean(axis=(2, 3))
    rough = (filled - means)[~np.ma.getmaskarray(image)].std()
    noise = np.random.default_rng(seed).normal(0, share * rough, filled.shape).astype(np.float32)
    return np.ma.masked_array(filled + noise, image.mask)


def twin_of(scene: str, side: str, share: float) -> Path:
    """Write the noisy twin of an image: float32, since rounding would add noise."""
    TWINS.mkdir(parents=True, exist_ok=True)
    pixels = noisy(read(scene, side), share, 1 + (side == "right")).filled(np.nan)
    file = TWINS / f"{scene}-{side}-{share:g}.tif"
    size = {"height": pixels.shape[0], "width": pixels.shape[1]}
    with rasterio.open(file, "w", driver="GTiff", count=1, dtype="float32", nodata=np.nan, **size) as twin:
        twin.write(pixels, 1)
    return file


def scene_of(scene: str, preset: str, noise: float = 0) -> CalibrationScene:
    """Open a scene, or its noisy twin, to calibrate with."""
    config = load_config(settings_of(preset) | {"disparity": search_of(scene)})
    files = (twin_of(scene, side, noise) if noise else DATA / scene / f"{side}.tif" for side in ("left", "right"))
    left, right = map(open_image, files)
    truth, tolerance = truth_of(left, DATA / scene / "truth.tif"), tolerance_of(scene)
    return CalibrationScene(scene, group_of(scene), left, right, truth, config, None, tolerance, tolerance > 0)


def remembered(make: Callable[..., list[np.ndarray]]) -> Callable[..., list[np.ndarray]]:
    """Keep the last costs of MC-CNN, most of its time: a scene is matched 13 times, at other levels."""
    kept: list[tuple[str, list[np.ndarray]]] = []
    lock = Lock()

    def made(cost: MccnnCost, views: Sequence[View], *others: Any) -> list[np.ndarray]:
        digest = hashlib.sha256(repr((others[1], cost._given.statistics)).encode())
        for view in views:
            digest.update(view.pixels.tobytes() + view.state.tobytes())
        with lock:
            if not kept or kept[0][0] != digest.hexdigest():
                kept[:] = [(digest.hexdigest(), make(cost, views, *others))]
            return kept[0][1]

    return made


MccnnCost._correlations = remembered(MccnnCost._correlations)


@cache
def measured(preset: str) -> tuple[list[CalibrationScene], list[Measured]]:
    """Measure all scenes of a preset's calibration, then their twins, or read what was measured before."""
    scenes = [scene_of(scene, preset) for scene in scenes_of(preset)]
    if scenes[0].config.fits:
        scenes += [scene_of(scene, preset, NOISE[i % len(NOISE)]) for i, scene in enumerate(scenes_of(preset))]
    digest = hashlib.sha256(json.dumps(key_of(scenes[0].config)).encode())
    package = ROOT / "sat_intervals"
    images = [Path(image.path) for scene in scenes for image in (scene.left, scene.right)]
    inputs = [file.resolve() for scene in scenes_of(preset) for file in sorted((DATA / scene).iterdir())]
    for file in [*(file for names in SOURCES for file in sorted(package.glob(names))), *inputs, *images]:
        digest.update(file.read_bytes())
    kept = KEPT / f"{preset}-{digest.hexdigest()[:16]}.gz"
    if not kept.exists():
        with tempfile.TemporaryDirectory() as folder:
            found = measure_scenes(scenes, Path(folder), lambda *_: None)
        KEPT.mkdir(parents=True, exist_ok=True)
        with gzip.open(kept.with_suffix(".new"), "wb", 3) as file:
            pickle.dump(found, file)
        kept.with_suffix(".new").replace(kept)
    with gzip.open(kept) as file:
        return scenes, pickle.load(file)


def main() -> None:
    """Make the calibrations of the presets that are named, by default of all."""
    OUT.mkdir(exist_ok=True)
    for preset in sys.argv[1:] or PAIRED:
        scenes, parts = measured(preset)
        calibration, expected = calibration_from(parts, scenes, preset)
        pairs = calibration.provenance["pairs"]
        if twins := pairs[len(scenes_of(preset)) :]:
            del pairs[-len(twins) :]  # the twins differ in their noise alone
            calibration.provenance["noise"] = list(NOISE)
        write_calibration(OUT / f"{preset}.yaml", calibration)
        show_calibration(calibration, expected)


if __name__ == "__main__":
    main()
