"""Volumes of our own costs, as another matcher would give them."""

import numpy as np

from sat_intervals import Config, Window
from sat_intervals.kernels.matching import cost_volume
from sat_intervals.match.costs import cost_of
from sat_intervals.match.patch import PatchFrame, kernel_settings, patch_areas
from sat_intervals.match.whole import cut, whole_view
from sat_intervals.products import IMPOSSIBLE_COST


def volume_of(left: np.ndarray, right: np.ndarray, config: Config, *, sgm: bool = False) -> np.ndarray:
    """Our costs, aggregated or not: float32, NaN where impossible."""
    cost, areas = cost_of(config), patch_areas(PatchFrame.of_whole(Window(0, 0, *left.shape)), config)
    windows = cost.windows(areas)
    (costs,) = cost.of_areas((cut(whole_view(left), windows[0]), cut(whole_view(right), windows[1])), areas)
    found = cost_volume(costs.costs, kernel_settings(config)._replace(regularized=sgm))
    return np.where(found == IMPOSSIBLE_COST, np.float32(np.nan), found.astype(np.float32))


def softmax(volume: np.ndarray, temperature: float) -> np.ndarray:
    """Probabilities of costs."""
    weights = np.exp(-np.nan_to_num(volume, nan=np.inf) / temperature)
    with np.errstate(invalid="ignore"):
        return (weights / weights.sum(axis=2, keepdims=True)).astype(np.float32)


def census_volume(left: np.ma.MaskedArray, right: np.ma.MaskedArray, first: int) -> np.ndarray:
    """Hamming distances of 3 x 3 Census codes, as `volume_of` of `match_pair` returns them."""
    assert isinstance(first, int)
    bits, known = zip(*(_bits(image) for image in (left, right)), strict=True)
    columns, count = bits[0].shape[2], bits[1].shape[2] - bits[0].shape[2] + 1
    found = np.empty((*bits[0].shape[1:], count), np.float32)
    for k in range(count):
        there = slice(k, k + columns)
        found[:, :, k] = (bits[0] != bits[1][:, :, there]).sum(axis=0)
        found[~(known[0] & known[1][:, there]), k] = np.nan
    return found


def _bits(image: np.ma.MaskedArray) -> tuple[np.ndarray, np.ndarray]:
    height, width = (size - 2 for size in image.shape)
    shifts = [(row, column) for row in range(3) for column in range(3)]
    parts = [image[row : row + height, column : column + width] for row, column in shifts]
    known = ~np.any([np.ma.getmaskarray(part) for part in parts], axis=0)
    return np.array([part.data > parts[4].data for part in parts]), known
