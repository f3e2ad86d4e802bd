"""Checks of settings against images."""

import pytest

from sat_intervals.config import ConfigError, load_config


# The left image has columns 0 to 3, the right one 0 to 2: disparities from -3 to 2 meet a right pixel.
@pytest.mark.parametrize(
    ("minimum", "maximum", "meets"),
    [(-3, -3, True), (-5, -3, True), (2, 2, True), (2, 4, True), (-4, -4, False), (3, 3, False), (60, 90, False)],
)
def test_check_images__refuses_a_range_that_meets_no_pixel(minimum, maximum, meets):
    disparity = load_config({"disparity": {"minimum": minimum, "maximum": maximum}}).disparity
    if meets:
        disparity.check_images("left.tif", 4, "right.tif", 3)
    else:
        with pytest.raises(
            ConfigError, match=rf"{minimum} to {maximum} .*left.tif \(4 columns.*right.tif \(3 columns.*sign"
        ):
            disparity.check_images("left.tif", 4, "right.tif", 3)
