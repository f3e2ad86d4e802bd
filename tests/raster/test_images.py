"""Dates of images."""

from datetime import datetime

import numpy as np
from helpers import PLACE

from sat_intervals.raster import acquired, write_layer


def test_acquired__reads_the_date_of_the_tags(tmp_path):
    def date_of(**tags):
        write_layer(tmp_path / "a.tif", np.ones((4, 5), np.uint8), 0, PLACE, tags)
        return acquired(str(tmp_path / "a.tif"))

    assert date_of() is date_of(NITF_IDATIM="--------------") is None
    assert date_of(TIFFTAG_DATETIME="2023:07:14 10:31:02") == datetime(2023, 7, 14)
    assert date_of(NITF_IDATIM="20151313103000", TIFFTAG_DATETIME="2014:01:02 00:00:00") == datetime(2014, 1, 2)
