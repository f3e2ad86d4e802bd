"""The kinds of pixel that a map tells apart, each with its colour: what pictures and reports have in common."""

from typing import NamedTuple

import numpy as np

from sat_intervals.products import FLAGS, REGULARIZED

# Okabe and Ito's colours, which colour-blind people tell apart.
BLUE, SKY, ORANGE, VERMILION, PURPLE = "#0072b2", "#56b4e9", "#e69f00", "#d55e00", "#cc79a7"

_INVALID = {
    "left_window": "#4d4d4d",
    "no_candidate": "#000000",
    "left_masked": PURPLE,
    "right_masked": BLUE,
    "occlusion": ORANGE,
    "mismatch": VERMILION,
}


class PixelClass(NamedTuple):
    """A kind of pixel: its colour as ``#rrggbb``, what it means, and the validity flag that makes it (0 = none)."""

    colour: str
    meaning: str
    flag: int


PIXEL_CLASSES = (
    PixelClass("#f2f2f2", "valid", 0),
    PixelClass(SKY, "valid, interval regularised", REGULARIZED),
    *(PixelClass(_INVALID[flag.name], flag.meaning, flag.value) for flag in FLAGS if flag.invalid),
)
FIRST_INVALID = 2


def classify(validity: np.ndarray) -> np.ndarray:
    """The index in PIXEL_CLASSES of every pixel of a validity band, uint8; the first of several reasons wins."""
    places = np.zeros(validity.shape, np.uint8)
    for place in (1, *range(len(PIXEL_CLASSES) - 1, FIRST_INVALID - 1, -1)):
        places[validity & PIXEL_CLASSES[place].flag != 0] = place
    return places
