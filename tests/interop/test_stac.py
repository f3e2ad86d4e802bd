"""STAC items, validated by pystac without a network."""

import hashlib
import json
import re
import shutil

import numpy as np
import pytest
import rasterio
from finished import no_bands, random_bands, write_run, write_surface
from helpers import invoke
from numpy.testing import assert_allclose

from sat_intervals.raster import Georeferencing, footprint, north_up, read_layers


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
    links = [(link["rel"], link["href"]) for link in item["links"]]
    assert links == [("derived_from", "../left.tif"), ("derived_from", "../right.tif")]


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
        assert asset["file:size"] == len(content)
        assert asset["file:checksum"] == "1220" + hashlib.sha256(content).hexdigest()


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
    assert item["properties"]["datetime"] is None
    assert item["properties"]["end_datetime"] == item["properties"]["created"] == "2026-11-21T12:00:00Z"
    assert item["assets"]["intervals"]["proj:code"] is None
    assert item["assets"]["intervals"]["bands"][0]["statistics"] == {"valid_percent": 0}


def test_write_item__cuts_a_place_at_the_180th_meridian(tmp_path, monkeypatch):
    monkeypatch.setattr("finished.PLACE", north_up(32601, 166_000, 100, 10))  # 180 is at 166 021 m
    out = write_run(tmp_path, *random_bands(8, 12)[:2])
    assert invoke("stac", out).exit_code == 0
    item = json.loads((out / "stac.json").read_text())
    west, south, east, north = item["bbox"]
    assert (item["geometry"]["type"], south < north) == ("MultiPolygon", True)
    assert west == pytest.approx(179.99981, abs=2e-5)
    assert east == pytest.approx(-179.99912, abs=2e-5)
    rings = [np.array(polygon[0]) for polygon in item["geometry"]["coordinates"]]
    assert [(ring[:, 0].min() > 0, np.abs(ring[:, 0]).max()) for ring in rings] == [(True, 180), (False, 180)]
    for x, y in ((ring - ring[0]).T for ring in rings):
        assert (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0  # counter-clockwise


def test_footprint__of_a_local_crs_is_none():
    local = rasterio.crs.CRS.from_wkt('LOCAL_CS["epipolar",UNIT["metre",1]]')
    assert footprint(Georeferencing(crs=local, transform=rasterio.Affine(0.5, 0, 0, 0, -0.5, 0)), (10, 20)) is None


@pytest.mark.parametrize(
    ("time", "says"), [("yesterday", "is not a time such as 2024-05-31T10:20:00Z"), ("2024-05-31", "has no time zone")]
)
def test_stac__refuses_times_that_are_none(made, time, says):
    done = invoke("stac", made[0], "--datetime", time)
    assert done.exit_code == 2
    assert re.fullmatch(f"sat-intervals: {time} {says}: .*\n", done.stderr)


@pytest.mark.peer("shareloc")
def test_write_item__of_many_images_has_heights_and_all_images(swept, tmp_path):
    out = shutil.copytree(swept.parent, tmp_path / "scene") / "out"
    report = out / "run.json"
    report.write_text(report.read_text().replace(str(swept.parent), str(out.parent)))

    def item():
        assert invoke("stac", out).exit_code == 0
        return json.loads((out / "stac.json").read_text())

    assert list(item()["assets"])[:3] == ["validity", "dsm", "report"]
    assert [link["href"] for link in item()["links"]] == ["../1.tif", "../2.tif", "../3.tif"]
    assert item()["properties"]["start_datetime"].startswith("1959")
    for number, day in enumerate(("2024:05:31", "2023:01:02", "2024:04:01"), start=1):
        with rasterio.open(out.parent / f"{number}.tif", "r+") as dataset:
            dataset.update_tags(TIFFTAG_DATETIME=f"{day} 10:20:00")
    times = item()["properties"]
    days = "2023-01-02T00:00:00Z", "2024-05-31T23:59:59Z"
    assert (times["datetime"], times["start_datetime"], times["end_datetime"]) == (None, *days)
