"""Records of commands: one place writes them, with plain numbers."""

import json
from pathlib import Path

import numpy as np
import pytest
from cameras import cameras, sensor_words
from helpers import PLACE, invoke

from sat_intervals.demo import make_scene
from sat_intervals.products import as_json, plain
from sat_intervals.raster import write_layer


def test_plain__numbers_are_those_of_python():
    record = {"a": (np.int16(-7), np.bool_(False)), 3: np.float32(0.25), "b": [np.inf, float("nan"), Path("x/y")]}
    assert plain(record) == {"a": [-7, False], "3": 0.25, "b": [None, None, "x/y"]}
    assert [type(one) for one in plain(record)["a"]] == [int, bool]
    assert json.loads(as_json(record)) == plain(record)
    with pytest.raises(TypeError, match="ndarray is not JSON serializable"):
        as_json({"lines": np.zeros(3)})


def types_in(record):
    inner = record.values() if isinstance(record, dict) else record if isinstance(record, list) else ()
    return {type(record)}.union(*map(types_in, inner))


@pytest.mark.peer("shareloc")
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_as_json__of_all_records_of_a_run_whose_range_is_extended(tmp_path, monkeypatch):
    """The right image shows a part, the range is searched further at the finer level, and its middle row is no data."""
    scene, dumps, kinds = make_scene(160, 820, seed=29), json.dumps, set()
    right = np.zeros_like(scene.right)
    right[:, 168:348] = scene.right[:, 168:348]
    right[78:82] = 0
    for name, pixels in (("left", scene.left), ("right", right)):
        write_layer(tmp_path / f"{name}.tif", pixels, 0, PLACE)

    def spied(content, **options):
        kinds.update(types_in(content))
        return dumps(content, **options)

    monkeypatch.setattr(json, "dumps", spied)
    images, words = (tmp_path / "left.tif", tmp_path / "right.tif"), sensor_words(cameras(tmp_path, 160, 820))
    result = invoke("surface", *images, tmp_path / "out", *words, "--resolution", 2, "--keep-tiles", "--json")
    assert result.exit_code == 0, result.output
    assert kinds <= {dict, list, str, int, float, bool, type(None)}
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert len(report["search"]["levels"]) == 2
    assert report["quality"]["same"] is False
    assert {file.name for file in (tmp_path / "out").rglob("*.json")} == {"run.json", "manifest.json", "geometry.json"}
