"""Two images to a surface model in one call."""

import pytest
from cameras import cameras, sensor_words
from helpers import hashes, invoke, write_pair
from numpy.testing import assert_array_equal

import sat_intervals
from sat_intervals import SatIntervalsError, SurfaceChoices
from sat_intervals.demo import make_scene
from sat_intervals.raster import read_layers

pytestmark = pytest.mark.peer("shareloc")


def test_surface__gives_the_bytes_of_the_command_and_resumes(tmp_path):
    scene = make_scene(120, 150, seed=4)
    write_pair(tmp_path, scene)
    pair, sensors = (tmp_path / "left.tif", tmp_path / "right.tif"), cameras(tmp_path, *scene.truth.shape)
    search = {"disparity": {"minimum": scene.minimum, "maximum": scene.maximum}}
    choices = SurfaceChoices(outliers=20)
    words = "--disparity", scene.minimum, scene.maximum, "--resolution", 1, "--outliers", 20, *sensor_words(sensors)
    assert invoke("surface", *pair, tmp_path / "command", *words).exit_code == 0
    of_command = (tmp_path / "command" / "dsm.tif").read_bytes()
    kinds = {"resolution": 1.0, "choices": choices, "sensors": sensors}
    again = sat_intervals.surface(pair, tmp_path / "command", search, **kinds)  # the same run: its time is in a tag
    assert (tmp_path / "command" / "dsm.tif").read_bytes() == of_command
    done = sat_intervals.surface([*map(str, pair)], str(tmp_path / "call"), search, **kinds)
    assert hashes(tmp_path / "call") == hashes(tmp_path / "command")
    assert_array_equal(*(read_layers(tmp_path / name / "dsm.tif") for name in ("call", "command")))
    assert (done["rectify"], done["surface"]["points"]) == (None, again["surface"]["points"])
    assert done["warnings"] == done["run"]["warnings"]
    with pytest.raises(SatIntervalsError, match="altitude is for raw images"):
        sat_intervals.surface(pair, tmp_path / "call", search, **kinds, altitude=20)
