"""STAC items, validated by pystac without a network."""

import hashlib
import itertools
import json
import os
import re
import shutil

import numpy as np
import pytest
import rasterio
from finished import no_bands, random_bands, write_points, write_run, write_surface
from helpers import contents, exchanged, flip_bit, invoke
from numpy.testing import assert_allclose

from sat_intervals.interop import stac
from sat_intervals.raster import north_up, read_layers
from sat_intervals.show.canvas import page


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a run with a surface model, and its item."""
    out = write_run(tmp_path_factory.mktemp("run"), *random_bands(60, 80)[:2])
    write_surface(out, np.add.outer(np.arange(60.0), np.arange(80.0)))
    done = invoke("stac", out, "--datetime", "2024-05-31T12:20:00+02:00", "--id", "one")
    assert (done.exit_code, done.output) == (0, f"{out / 'stac.json'}\n")
    return out, json.loads((out / "stac.json").read_text())


def test_write_item__describes_time_place_software_and_sources(made):
    out, item = made
    assert (item["id"], item["properties"]["datetime"]) == ("one", "2024-05-31T10:20:00Z")
    with rasterio.open(out / "validity.tif") as dataset:
        box = rasterio.warp.transform_bounds(dataset.crs, "EPSG:4326", *dataset.bounds)
    assert_allclose(item["bbox"], box, atol=2e-6)
    ring = np.array(item["geometry"]["coordinates"][0])
    assert (ring[0] == ring[-1]).all()
    x, y = ring.T
    assert (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0  # counter-clockwise
    assert item["properties"]["processing:software"]["python"] == "3.11"
    report = json.loads((out / "run.json").read_text())
    assert item["properties"]["processing:expression"]["expression"] == report["settings"]
    assert [(link["rel"], link["href"]) for link in item["links"]] == [
        ("derived_from", "../left.tif"),
        ("derived_from", "../right.tif"),
    ]


def test_write_item__has_statistics_and_checksums_of_each_raster(made):
    out, item = made
    assert list(item["assets"]) == ["intervals", "validity", "dsm", "report"]
    for name in ("intervals", "validity", "dsm"):
        asset, pixels = item["assets"][name], read_layers(out / f"{name}.tif").astype(np.float64)
        assert (asset["proj:code"], asset["proj:shape"]) == ("EPSG:32631", list(pixels.shape[1:]))
        assert asset["proj:transform"][:3] == [0.5, 0, 370_000]
        for band, values in zip(asset["bands"], pixels, strict=True):
            known = values[np.isfinite(values)]
            found = band["statistics"]
            assert_allclose(found.pop("valid_percent"), 100 * known.size / values.size)
            if known.size:
                expected = {"minimum": known.min(), "maximum": known.max(), "mean": known.mean(), "stddev": known.std()}
                assert found.keys() == expected.keys()
                assert_allclose([found[key] for key in expected], [*expected.values()], rtol=1e-6, atol=1e-9)
    for asset in item["assets"].values():
        content = (out / asset["href"]).read_bytes()
        assert (asset["file:size"], asset["file:checksum"]) == (
            len(content),
            "1220" + hashlib.sha256(content).hexdigest(),
        )


@pytest.mark.peer("pystac")
def test_write_item__is_valid_and_read_by_pystac(made):
    """Core schemas are part of pystac; fields of extensions are read by its classes."""
    import pystac
    from pystac.extensions.file import FileExtension
    from pystac.extensions.projection import ProjectionExtension
    from pystac.validation.stac_validator import JsonSchemaSTACValidator

    out, _ = made
    item = pystac.Item.from_file(str(out / "stac.json"))
    schemas = JsonSchemaSTACValidator()
    assert schemas.validate_core(item.to_dict(transform_hrefs=False), pystac.STACObjectType.ITEM, "1.1.0")
    broken = item.to_dict(transform_hrefs=False) | {"bbox": None}
    with pytest.raises(pystac.STACValidationError):
        schemas.validate_core(broken, pystac.STACObjectType.ITEM, "1.1.0")
    asset = item.assets["dsm"]
    assert ProjectionExtension.ext(asset).code == "EPSG:32631"
    assert FileExtension.ext(asset).size == (out / "dsm.tif").stat().st_size


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_write_item__without_georeferencing_and_valid_pixels(tmp_path, monkeypatch):
    monkeypatch.setattr("finished.PLACE", type(north_up(32631, 0, 0, 1))())
    out = write_run(tmp_path, *no_bands(20, 30))
    assert invoke("stac", out).exit_code == 0
    item = json.loads((out / "stac.json").read_text())
    assert (item["geometry"], "bbox" in item, item["id"]) == (None, False, "out")
    assert item["properties"]["datetime"] == item["properties"]["created"] == "2026-11-21T12:00:00Z"
    assert item["assets"]["intervals"]["proj:code"] is None
    assert item["assets"]["intervals"]["bands"][0]["statistics"] == {"valid_percent": 0}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--datetime", "yesterday"], "yesterday is not a time such as 2024-05-31T10:20:00Z: .*"),
        (["--datetime", "2024-05-31T10:20:00"], "2024-05-31T10:20:00 has no time zone: .*"),
    ],
)
def test_stac__refuses_times_that_are_none(made, words, message):
    done = invoke("stac", made[0], *words)
    assert done.exit_code == 2
    assert re.fullmatch(f"sat-intervals: {message}\n", done.stderr)


def test_stac__replaces_its_own_item_only(made, tmp_path):
    out = shutil.copytree(made[0], tmp_path / "out")
    assert invoke("stac", out).exit_code == 0
    (out / "stac.json").write_text('{"properties": {}}')
    done = invoke("stac", out)
    assert done.exit_code == 2
    said = "exists and was not made by sat-intervals, or was changed since: move it away"
    assert done.stderr == f"sat-intervals: {out / 'stac.json'} {said}\n"
    assert (out / "stac.json").read_text() == '{"properties": {}}'
    (out / "stac.json").unlink()
    assert invoke("stac", out).exit_code == 0
    item = json.loads((out / "stac.json").read_text())
    item["properties"]["title"] = "mine"
    (out / "stac.json").write_text(mine := json.dumps(item, indent=1))
    assert said in invoke("stac", out).stderr
    assert (out / "stac.json").read_text() == mine
    (out / "stac.json").unlink()
    os.mkfifo(out / "stac.json")
    assert f"{out / 'stac.json'} is a named pipe" in invoke("stac", out).stderr


def test_write_item__refuses_damaged_points(made, tmp_path):
    out = shutil.copytree(made[0], tmp_path / "out")
    write_points(out, np.full((60, 80), 700.0))
    assert invoke("stac", out).exit_code == 0
    before = (out / "stac.json").read_bytes()
    flip_bit(out / "points.tif")
    done = invoke("stac", out)
    assert (done.exit_code, (out / "stac.json").read_bytes()) == (2, before)
    assert "points.tif is not what triangulate published; " in done.stderr


def test_write_item__has_no_picture_of_a_user_or_of_an_earlier_run(made, tmp_path):
    out = shutil.copytree(made[0], tmp_path / "out")

    def assets():
        done = invoke("stac", out)
        assert done.exit_code == 0
        keys = json.loads((out / "stac.json").read_text())["assets"].keys()
        said = f"{out / 'overview.png'} is not of this run as it is now and is left out: rerun sat-intervals plot\n"
        assert ("overview" in keys) == (said not in done.stderr)
        return keys

    with page(out / "overview.png", (1, 1), 50, "", "an earlier time"):
        pass
    assert "overview" not in assets()
    (out / "overview.png").write_text("mine")
    assert "overview" not in assets()
    (out / "overview.png").unlink()
    assert invoke("plot", out, "--dpi", "50").exit_code == 0
    assert "overview" in assets()


def test_write_item__ends_where_a_surface_is_replaced_meanwhile(made, tmp_path, monkeypatch):
    """Else it gives the checksum of one surface and the statistics of another."""
    out = shutil.copytree(made[0], tmp_path / "out")
    bands = stac._bands

    def replaced_before(path, *arguments):
        if path.name == "dsm.tif":
            write_surface(out, np.full((60, 80), 700.0))
        return bands(path, *arguments)

    monkeypatch.setattr(stac, "_bands", replaced_before)
    done = invoke("stac", out)
    assert done.exit_code == 1
    assert re.search(r"dsm.tif was replaced or changed while it was read: rerun the command", done.stderr)


@pytest.mark.parametrize("moment", ["write_file", "_check_own"])
def test_stac__ends_where_another_run_takes_the_folders_name_while_it_writes(tmp_path, monkeypatch, moment):
    for name in "ab":
        (tmp_path / name).mkdir()
    out, other = (write_run(tmp_path / name, *random_bands(20, 30)) for name in "ab")
    assert invoke("stac", out).exit_code == invoke("stac", other).exit_code == 0
    mine, calls = contents(other), itertools.count()
    step = getattr(stac, moment)

    def late(*arguments):
        if next(calls) == (moment == "_check_own"):
            exchanged(out, other)
        return step(*arguments)

    monkeypatch.setattr(stac, moment, late)
    done = invoke("stac", out)
    assert (done.exit_code, done.stderr.count("\n"), "was replaced" in done.stderr) == (1, 1, True), done.stderr
    assert list(contents(out).values()) == list(mine.values())


def test_write_item__keeps_an_item_that_appears_meanwhile(tmp_path, monkeypatch):
    out, item = write_run(tmp_path, *random_bands(20, 30)), stac._item
    edited = json.dumps({"properties": {"processing:software": {"sat-intervals": "1", "mine": "2"}}})

    def and_appears(*arguments):
        (out / "stac.json").write_text(edited)
        return item(*arguments)

    monkeypatch.setattr(stac, "_item", and_appears)
    done = invoke("stac", out)
    assert done.exit_code == 2
    assert done.stderr.count("\n") == 1
    assert (out / "stac.json").read_text() == edited
