"""Raw images of a scene with exact truth, written once."""

import numpy as np
import pytest

from sat_intervals.demo import make_views
from sat_intervals.errors import SatIntervalsError
from sat_intervals.raster import read_layers
from sat_intervals.workflows.demo import slants_of, write_views


def test_write_views__write_the_scene_once_and_replace_nothing_else(tmp_path):
    paths, truth = write_views(tmp_path, 70, 80, 3, 3)
    images, heights = make_views(70, 80, slants_of(3).tolist(), 3)
    for path, pixels in zip((*paths, truth), (*images, heights), strict=True):
        np.testing.assert_array_equal(read_layers(path)[0], pixels)
    times = {path: path.stat().st_mtime_ns for path in (*paths, truth)}
    paths[1].unlink()
    write_views(tmp_path, 70, 80, 3, 3)
    assert [path for path, time in times.items() if path.stat().st_mtime_ns != time] == [paths[1]]
    with pytest.raises(SatIntervalsError, match=r"1.tif .*exists"):
        write_views(tmp_path, 70, 80, 3, 4)
    write_views(tmp_path, 70, 80, 3, 4, overwrite=True)
