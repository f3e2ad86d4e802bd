"""Accuracy on real pairs: no worse than that of the reference implementation with the same settings."""

import json

import numpy as np
import pytest
import rasterio

from sat_intervals import match_arrays

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

# Accuracy and share of pixels kept of the reference implementation: fast cross-checking, then accurate.
REFERENCE = {
    "mb2003_cones": ((0.976, 0.845), (0.979, 0.842)),
    "mb2003_teddy": ((0.964, 0.854), (0.972, 0.845)),
    "mb2005_art": ((0.957, 0.758), (0.966, 0.737)),
    "mb2005_books": ((0.958, 0.844), (0.958, 0.835)),
    "mb2005_dolls": ((0.962, 0.849), (0.965, 0.844)),
    "mb2005_laundry": ((0.910, 0.822), (0.920, 0.804)),
    "mb2005_moebius": ((0.970, 0.836), (0.971, 0.823)),
    "mb2005_reindeer": ((0.969, 0.802), (0.973, 0.796)),
}


def read(path):
    with rasterio.open(path) as file:
        return file.read(1)


@pytest.mark.parametrize("method", ["fast", "accurate"])
@pytest.mark.parametrize("name", REFERENCE)
def test_match_arrays__is_as_accurate_as_the_reference(shared_data, name, method):
    folder = shared_data / name
    minimum, maximum = json.loads((folder / "meta.json").read_text())["disparity"]
    left, right, truth = (read(folder / f"{layer}.tif") for layer in ("left", "right", "truth"))
    search = {"minimum": minimum, "maximum": maximum}
    settings = {"preset": "paper", "disparity": search, "cross_check": {"method": method}}
    result = match_arrays(left, right, settings)
    lower, upper = result["lower"].to_numpy(), result["upper"].to_numpy()
    judged = np.isfinite(lower) & (truth >= minimum) & (truth <= maximum)
    inside = (lower <= truth) & (truth <= upper)
    accuracy, kept = REFERENCE[name][method == "accurate"]
    assert inside[judged].mean() >= accuracy - 0.006
    assert judged.mean() == pytest.approx(kept, abs=0.02)
    assert np.median((upper - lower)[judged]) / (maximum - minimum) <= 0.037
