"""Figures of docs/volumes.md: disparities of OpenCV's SGBM on pairs with truth, audited by `intervals_around`."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import rasterio

from sat_intervals import intervals_around

DATA = Path(os.environ.get("SAT_INTERVALS_SHARED", "../shared")) / "data"
# Rows by which the right image is lower, to the nearest: SGBM does not take them out.
PAIRS = {
    "us3d_jax_079": 1,
    "us3d_jax_559": 0,
    "synth_toulouse_georef": 0,
    "synth_toulouse_nodata": 0,
    "synth_toulouse_urban": 0,
}
# A larger error is a blunder, in pixels.
BLUNDER = 3
SETTINGS = {
    "satellite, 0.9": {"preset": "satellite"},
    "satellite, 0.8": {"preset": "satellite", "interval": {"coverage": 0.8}},
}


def bytes_of(image: np.ndarray) -> np.ndarray:
    """Stretch an image to 8 bits, as SGBM takes it."""
    first, last = np.percentile(image[image > 0], [1, 99])
    return np.clip((image.astype(float) - first) / (last - first) * 255, 0, 255).astype(np.uint8)


def sgbm(left: np.ndarray, right: np.ndarray, minimum: int, maximum: int) -> np.ndarray:
    """Return its disparities in our sign, NaN where it rejects."""
    count = 16 * -(-(maximum - minimum + 1) // 16)
    matcher = cv2.StereoSGBM_create(-maximum, count, 5, 8 * 25, 32 * 25, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_HH)
    found = matcher.compute(bytes_of(left), bytes_of(right)).astype(np.float32) / 16
    return np.where((found < -maximum) | (-found < minimum), np.float32(np.nan), -found)


def share(part: np.ndarray, whole: np.ndarray) -> float:
    return float((part & whole).sum() / whole.sum())


def main() -> None:
    print("| pair | settings | wrong inside | wrong outside | found | good flagged | with rejected: found | good |")
    print("|---|---|---|---|---|---|---|---|")
    for name, offset in PAIRS.items():
        with (
            rasterio.open(DATA / name / "left.tif") as left,
            rasterio.open(DATA / name / "right.tif") as right,
            rasterio.open(DATA / name / "truth.tif") as true,
        ):
            images, truth = (left.read(1), right.read(1)), true.read(1)
        search = json.loads((DATA / name / "meta.json").read_text())["disparity"]
        given = sgbm(images[0], np.roll(images[1], -offset, axis=0), *search)
        error = given - truth
        error -= np.nanmedian(error)  # the truth has a constant bias
        known = np.isfinite(error)
        wrong, good = known & (abs(error) > BLUNDER), known & (abs(error) <= BLUNDER)
        kept, right = share(known, np.isfinite(truth)), share(abs(error) <= 1, np.isfinite(truth))
        print(f"{name}: {kept:.3f} kept, {right:.3f} right to a pixel, {share(wrong, known):.3f} of the kept wrong")
        for words, settings in SETTINGS.items():
            found = intervals_around(*(np.ma.masked_equal(image, 0) for image in images), given, settings)
            agreement = found["agreement"].data
            inside, outside = agreement == 1, agreement == 0
            judged = inside | outside
            figures = [
                share(wrong, known & inside), share(wrong, known & outside),
                share(outside, wrong & judged), share(outside, good & judged),
                share(~inside, wrong), share(~inside, good),
            ]  # fmt: skip
            ours = found["disparity"].data - truth
            right = abs(ours - np.nanmedian(ours)) <= BLUNDER
            print(f"{name}, {words}: ours is kept and right at {share(right, wrong):.3f} of its errors")
            print(f"| `{name}` | {words} | {' | '.join(f'{figure:.3f}' for figure in figures)} |")


if __name__ == "__main__":
    main()
