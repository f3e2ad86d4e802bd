"""QGIS projects and styles, also in the real QGIS."""

import json
import re
import subprocess
import zipfile
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
from finished import FINISHED, NOWHERE, PLACE, no_bands, random_bands, without_intervals, write_run, write_surface
from helpers import invoke
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from sat_intervals.products import INVALID
from sat_intervals.raster import write_layer
from sat_intervals.show.legend import PIXEL_CLASSES, classify

SYSTEM_PYTHON = "/usr/bin/python3"


@pytest.fixture
def run(tmp_path):
    """The folder of a run with a truth and a surface model, and its bands and validity."""
    bands, validity, truth = random_bands(60, 80)
    out = write_run(tmp_path, bands, validity, truth)
    rows, columns = np.indices((60, 80))
    write_surface(out, 700 + 10 * np.sin(rows / 9) + columns / 10)
    return out, bands, validity


def read_project(out):
    with zipfile.ZipFile(out / "project.qgz") as archive:
        return ElementTree.fromstring(archive.read("project.qgs"))


def layers_of(root):
    """Group, name and source of the layers, from the top."""
    return [
        (group.get("name"), layer.get("name"), layer.get("source"))
        for group in root.findall("layer-tree-group/layer-tree-group")
        for layer in group
    ]


def test_write_project__lists_all_layers_by_group_with_relative_paths(run):
    out, _, _ = run
    done = invoke("project", out)
    assert done.exit_code == 0, done.output
    names = ["dsm_half_width.vrt", "width.vrt", "dsm_half_width.qml", "dsm.qml", "validity.qml", "width.qml"]
    assert done.output.split() == [str(out / name) for name in [*names, "intervals.qml", "project.qgz"]]
    root = read_project(out)
    assert layers_of(root) == [
        ("Heights", "half width", "./dsm_half_width.vrt"),
        ("Heights", "confidence of heights", "./dsm.tif"),
        ("Heights", "height", "./dsm.tif"),
        ("Heights", "hillshade", "./dsm.tif"),
        ("Disparity", "validity", "./validity.tif"),
        ("Disparity", "confidence", "./intervals.tif"),
        ("Disparity", "interval width", "./width.vrt"),
        ("Disparity", "disparity", "./intervals.tif"),
        ("Images", "truth", "../truth.tif"),
        ("Images", "left", "../left.tif"),
        ("Images", "right", "../right.tif"),
    ]
    ids = [layer.findtext("id") for layer in root.findall("projectlayers/maplayer")]
    assert ids == [layer.get("id") for layer in root.iter("layer-tree-layer")]
    assert len(set(ids)) == len(ids)


def test_styles__stretch_disparities_and_colour_every_value_of_validity(run):
    out, bands, validity = run
    invoke("project", out)
    shader = ElementTree.parse(out / "intervals.qml").find(".//colorrampshader")
    ends = np.nanpercentile(bands[0], (2, 98), method="nearest")
    assert_allclose([float(shader.get(name)) for name in ("minimumValue", "maximumValue")], ends, rtol=1e-5)
    entries = ElementTree.parse(out / "validity.qml").findall(".//paletteEntry")
    kinds = {int(entry.get("value")): entry.get("color") for entry in entries}
    assert kinds == {int(one): PIXEL_CLASSES[classify(np.array(one))].colour for one in np.unique(validity)}
    count = Counter(validity.ravel().tolist())
    for entry in entries:
        value = int(entry.get("value"))
        meaning, share = re.fullmatch(rf"{value}: (.*) \((.*) %\)", entry.get("label")).groups()
        assert meaning.startswith("valid") == (value & INVALID == 0)
        assert_allclose(float(share), 100 * count[value] / validity.size, rtol=0.06)


def test_widths__are_differences_at_the_same_place(run):
    out, bands, _ = run
    invoke("project", out)
    with rasterio.open(out / "width.vrt") as width:
        assert_array_equal(width.read(1), bands[2] - bands[1])
        assert (width.crs, width.transform) == (PLACE.crs, PLACE.transform)
    with rasterio.open(out / "dsm_half_width.vrt") as half:
        assert_array_equal(half.read(1), np.full((60, 80), 1.5))


def test_write_project__leaves_out_what_is_missing_or_of_another_run(run):
    out, _, _ = run
    write_surface(out, np.ones((60, 80)), runs="2020-01-01T00:00:00+00:00")
    (out.parent / "right.tif").unlink()
    done = invoke("project", out)
    assert done.exit_code == 0
    assert "dsm.tif is of another run and is left out: rerun sat-intervals dsm" in done.stderr
    assert "the right image is left out: " in done.stderr
    names = [name for _, name, _ in layers_of(read_project(out))]
    assert names == ["validity", "confidence", "interval width", "disparity", "truth", "left"]


def write_ortho(out, runs=FINISHED):
    grey = np.random.default_rng(1).uniform(100, 900, (60, 80)).astype(np.float32)
    write_layer(out / "ortho.tif", grey, np.nan, PLACE, {"RUNS": runs})


def test_write_project__drapes_the_ortho_image_over_the_terrain(run):
    out, _, _ = run
    write_ortho(out)
    assert invoke("project", out).exit_code == 0
    root = read_project(out)
    assert [name for _, name, _ in layers_of(root)[1:5]] == [
        "confidence of heights",
        "height",
        "ortho-image",
        "hillshade",
    ]
    shown = {layer.get("name") for layer in root.iter("layer-tree-layer") if layer.get("checked") == "Qt::Checked"}
    assert shown == {"ortho-image", "hillshade", "disparity", "left"}
    terrain = root.find("ElevationProperties/terrainProvider[@type='raster']/TerrainProvider")
    assert (terrain.get("layer"), terrain.get("layerSource"), terrain.get("scale")) == (
        "heights_height",
        "./dsm.tif",
        "1",
    )
    assert ElementTree.parse(out / "ortho.qml").find(".//rasterrenderer").get("type") == "singlebandgray"
    write_ortho(out, runs="earlier")
    invoke("project", out)
    assert "ortho-image" not in [name for _, name, _ in layers_of(read_project(out))]


def test_write_project__of_a_surface_switches_off_what_is_on_no_map(tmp_path):
    bands, validity, truth = random_bands(60, 80)
    out = write_run(tmp_path, bands, validity, truth, place=NOWHERE)
    for names in ({"disparity", "left"}, {"height", "hillshade"}):
        assert invoke("project", out).exit_code == 0
        layers = read_project(out).iter("layer-tree-layer")
        assert {layer.get("name") for layer in layers if layer.get("checked") == "Qt::Checked"} == names
        write_surface(out, np.ones((60, 80)))


def test_write_project__of_a_run_without_intervals_and_without_valid_pixels(tmp_path):
    out = without_intervals(tmp_path)
    assert invoke("project", out).exit_code == 0
    assert not (out / "width.vrt").exists()
    (tmp_path / "none").mkdir()
    assert invoke("project", write_run(tmp_path / "none", *no_bands(30, 20))).exit_code == 0


@pytest.mark.process
def test_project__in_qgis(run, tmp_path):
    """Every layer is valid and styled, rasters opened alone take the same styles."""
    if subprocess.run([SYSTEM_PYTHON, "-c", "import qgis.core"], capture_output=True).returncode:
        pytest.skip("QGIS is not installed for the system's Python: apt install python3-qgis qgis-providers")
    out, _, _ = run
    write_ortho(out)
    assert invoke("project", out).exit_code == 0
    script = Path(__file__).with_name("render_project.py")
    done = subprocess.run(
        [SYSTEM_PYTHON, script, out / "project.qgz", tmp_path],
        env={"QT_QPA_PLATFORM": "offscreen", "HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["read"], report["crs"]) == (True, "EPSG:32631")
    layers = {layer["name"]: layer for layer in report["layers"]}
    assert [layer["name"] for layer in report["layers"]] == [name for _, name, _ in layers_of(read_project(out))]
    assert all(layer["valid"] and layer["crs"] == "EPSG:32631" for layer in layers.values())
    renderers = {name: (layer["renderer"], layer["bands"]) for name, layer in layers.items()}
    ramp = "singlebandpseudocolor"
    assert renderers == {
        "half width": (ramp, [1]), "confidence of heights": (ramp, [5]), "height": (ramp, [1]),
        "ortho-image": ("singlebandgray", [1]),
        "hillshade": ("hillshade", [1]), "validity": ("paletted", [1]), "confidence": (ramp, [4]),
        "interval width": (ramp, [1]), "disparity": (ramp, [1]), "truth": (ramp, [1]),
        "left": ("singlebandgray", [1]), "right": ("singlebandgray", [1]),
    }  # fmt: skip
    for name in ("half width", "height", "validity", "interval width", "disparity"):
        assert layers[name]["alone_labels"] == layers[name]["labels"] != []
    shown = {name for name, layer in layers.items() if layer["shown"]}
    assert shown == {"ortho-image", "hillshade", "disparity", "left"}
    for name in (*layers, "map"):
        with Image.open(tmp_path / f"{name.replace(' ', '_')}.png") as picture:
            colours = picture.convert("RGB").getcolors(1 << 20)
        assert len(colours) > (100 if name == "map" else 1), name  # the half width is 1.5 m everywhere
        assert max(count for count, _ in colours) < 0.9 * 700 * 700, name


@pytest.mark.peer("shareloc")
def test_write_project__of_many_images_has_heights_and_validity(swept):
    done = invoke("project", swept)
    assert done.exit_code == 0, done.output
    assert layers_of(read_project(swept)) == [
        ("Heights", "half width", "./dsm_half_width.vrt"),
        ("Heights", "confidence of heights", "./dsm.tif"),
        ("Heights", "height", "./dsm.tif"),
        ("Heights", "hillshade", "./dsm.tif"),
        ("Heights", "validity", "./validity.tif"),
    ]
