"""QGIS projects and styles, also in the real QGIS."""

import json
import re
import shutil
import subprocess
import zipfile
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
from finished import PLACE, no_bands, random_bands, without_intervals, write_points, write_run, write_surface
from helpers import exchanged, fail, flip_bit, invoke
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from rasterio.crs import CRS
from surfaces import write_raster

from sat_intervals.products import INVALID
from sat_intervals.raster import ControlPoint, Georeferencing
from sat_intervals.show import project
from sat_intervals.show.legend import PIXEL_CLASSES, classify
from sat_intervals.show.styles import difference

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


def test_write_project__calls_no_failed_read_a_failed_write(run, monkeypatch):
    out, _, _ = run
    monkeypatch.setattr(project, "read_layers", fail)
    with pytest.raises(OSError, match="Input/output error"):
        project.write_project(out)
    assert not (out / "project.qgz").exists()


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
    ends = np.nanpercentile(bands[0], (2, 98))
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


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_difference__keeps_control_points(tmp_path, run):
    points = tuple(
        ControlPoint(row, column, 5 + column / 9, 44 - row / 9, 30.0) for row in (0, 60) for column in (0, 80)
    )
    place = Georeferencing(gcps=points, gcps_crs=CRS.from_epsg(4326))
    (run[0] / "gcps.vrt").write_bytes(difference(("intervals.tif", 3, 2), place, (60, 80)))
    with rasterio.open(run[0] / "gcps.vrt") as dataset:
        assert Georeferencing.of(dataset) == place


def test_write_project__keeps_styles_and_projects_of_others(run):
    out, _, _ = run
    (out / "intervals.qml").write_text("<qgis/>")
    done = invoke("project", out)
    assert done.exit_code == 0
    said = f"{out / 'intervals.qml'} was not made by sat-intervals, or was changed since, and is kept\n"
    assert done.stderr == said
    assert (out / "intervals.qml").read_text() == "<qgis/>"
    assert invoke("project", out).exit_code == 0  # its own files are replaced
    before = (out / "width.qml").read_bytes()
    (out / "width.qml").unlink()
    (out / "project.qgz").write_bytes(b"PK of QGIS")
    done = invoke("project", out)
    assert (done.exit_code, (out / "project.qgz").read_bytes()) == (2, b"PK of QGIS")
    assert re.fullmatch(r"sat-intervals: .*project.qgz exists and was not made by sat-intervals.*\n", done.stderr)
    assert b"made by sat-intervals" in before
    assert not (out / "width.qml").exists()  # nothing is written before


@pytest.mark.parametrize("name", ["width.vrt", "dsm_half_width.vrt"])
@pytest.mark.parametrize("is_edited", [False, True])
def test_write_project__says_that_the_layer_of_a_kept_file_is_left_out(run, name, is_edited):
    out, _, _ = run
    invoke("project", out)
    mine = (out / name).read_bytes().replace(b"</VRTDataset>", b"<!-- mine --></VRTDataset>") if is_edited else b""
    (out / name).write_bytes(mine)
    done = invoke("project", out)
    assert (done.exit_code, (out / name).read_bytes()) == (0, mine)
    assert done.stderr == (
        f"{out / name} was not made by sat-intervals, or was changed since, and is kept: its layer is left out; to "
        "have it, move the file away and rerun sat-intervals project\n"
    )


def test_write_project__keeps_a_project_that_was_edited(run):
    out, _, _ = run
    for _ in range(2):  # its own file is replaced
        assert invoke("project", out).exit_code == 0
    made = (out / "project.qgz").read_bytes()
    with zipfile.ZipFile(out / "project.qgz") as archive:
        project = archive.read("project.qgs")
    for files in ({"project.qgs": project + b"<!-- mine -->"}, {"project.qgs": project, "mine.txt": b"mine"}):
        with zipfile.ZipFile(out / "project.qgz", "w") as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        before = (out / "project.qgz").read_bytes()
        done = invoke("project", out)
        assert (done.exit_code, (out / "project.qgz").read_bytes()) == (2, before)
        assert "project.qgz exists and was not made by sat-intervals, was changed since" in done.stderr
    (out / "project.qgz").write_bytes(made[:-9])
    assert invoke("project", out).exit_code == 2


def test_write_project__keeps_styles_that_were_edited(run):
    out, _, _ = run
    invoke("project", out)
    style = out / "intervals.qml"
    mine = style.read_bytes().replace(b'"Reds"', b'"Blues"') + b"<!-- mine -->\n"
    style.write_bytes(mine)
    done = invoke("project", out)
    assert (done.exit_code, style.read_bytes()) == (0, mine)
    assert f"{style} was not made by sat-intervals, or was changed since, and is kept" in done.stderr


def test_write_project__leaves_out_what_is_missing_or_of_another_run(run):
    out, _, _ = run
    write_surface(out, np.ones((60, 80)), runs="2020-01-01T00:00:00+00:00")
    (out.parent / "right.tif").unlink()
    done = invoke("project", out)
    assert done.exit_code == 0
    assert "dsm.tif is of another run or of earlier points and is left out: rerun sat-intervals dsm" in done.stderr
    assert "the right image is left out: " in done.stderr
    names = [name for _, name, _ in layers_of(read_project(out))]
    assert names == ["validity", "confidence", "interval width", "disparity", "truth", "left"]


def test_write_project__refuses_damaged_points(run):
    out, _, _ = run
    write_points(out, np.full((60, 80), 700.0))
    assert invoke("project", out).exit_code == 0
    flip_bit(out / "points.tif")
    done = invoke("project", out)
    assert done.exit_code == 2
    assert "points.tif is not what triangulate published; " in done.stderr


def test_write_project__ends_where_a_surface_is_replaced_meanwhile(run, monkeypatch):
    out, _, _ = run
    read_place = project.read_place

    def replaced_after(path):
        found = read_place(path)
        write_surface(out, np.full((60, 80), 1700.0))
        return found

    monkeypatch.setattr(project, "read_place", replaced_after)
    done = invoke("project", out)
    assert done.exit_code == 1
    assert "dsm.tif was replaced or changed while it was read: rerun the command" in done.stderr


def test_write_project__leaves_out_the_truth_beside_another_image(run):
    out, _, _ = run
    write_raster(out.parent / "left.tif", np.ones((1, 9, 9)), PLACE.transform)
    done = invoke("project", out)
    assert done.exit_code == 0
    for name in ("left", "truth"):
        assert re.search(f"the {name} image is left out: .*left.tif has 9 x 9 pixels, but had 60 x 80", done.stderr)


@pytest.mark.parametrize("name", ["left", "truth"])
def test_write_project__leaves_out_an_image_that_is_another_for_a_moment(run, monkeypatch, name):
    out, _, _ = run
    image, other = out.parent / f"{name}.tif", out.parent / "other.tif"
    shutil.copy(out.parent / "right.tif", other)
    read = project.read_small_image

    def of_the_other(opened, *arguments):
        if opened.path != str(image):
            return read(opened, *arguments)
        exchanged(image, other)
        found = read(opened, *arguments)
        exchanged(image, other)
        return found

    monkeypatch.setattr(project, "read_small_image", of_the_other)
    done = invoke("project", out)
    assert done.exit_code == 0
    assert f"the {name} image is left out: {image} was replaced or changed while it was read" in done.stderr
    assert name not in [layer for _, layer, _ in layers_of(read_project(out))]


def test_write_project__of_a_run_without_intervals_and_without_valid_pixels(tmp_path):
    out = without_intervals(tmp_path)
    assert invoke("project", out).exit_code == 0
    assert not (out / "width.vrt").exists()
    (tmp_path / "none").mkdir()
    assert invoke("project", write_run(tmp_path / "none", *no_bands(30, 20))).exit_code == 0


def files_in(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("last", ["_project", "write_made_here"])
def test_write_project__replaces_nothing_of_another_run_that_takes_the_folders_name(run, monkeypatch, last):
    out, _, _ = run
    other = out.with_name("other")
    shutil.copytree(out, other)
    assert invoke("project", out).exit_code == invoke("project", other).exit_code == 0
    before = files_in(out), files_in(other)
    step = getattr(project, last)

    def and_exchanged(*arguments):
        exchanged(out, other)
        return step(*arguments)

    monkeypatch.setattr(project, last, and_exchanged)
    done = invoke("project", out)
    assert (done.exit_code, "was replaced while it was read: rerun the command" in done.stderr) == (1, True), (
        done.output
    )
    assert (files_in(other), files_in(out)) == before


@pytest.mark.parametrize("name", ["width.vrt.msk", "dsm_half_width.vrt.ovr"])
def test_project__ends_where_a_file_appears_beside_its_rasters(run, monkeypatch, name):
    out, _, _ = run

    def and_appears(*arguments):
        (out / name).write_text("mine")
        return difference(*arguments)

    monkeypatch.setattr(project.styles, "difference", and_appears)
    done = invoke("project", out)
    assert (done.exit_code, f"{name} changes what is read from" in done.stderr) == (2, True), done.output
    assert not (out / "project.qgz").exists()


@pytest.mark.process
def test_project__in_qgis(run, tmp_path):
    """Every layer is valid and styled, rasters opened alone take the same styles, and QGIS removes the mark."""
    if subprocess.run([SYSTEM_PYTHON, "-c", "import qgis.core"], capture_output=True).returncode:
        pytest.skip("QGIS is not installed for the system's Python: apt install python3-qgis qgis-providers")
    out, _, _ = run
    assert invoke("project", out).exit_code == 0
    script = Path(__file__).with_name("render_project.py")
    done = subprocess.run(
        [SYSTEM_PYTHON, script, out / "project.qgz", tmp_path, tmp_path / "saved.qgz"],
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
        "hillshade": ("hillshade", [1]), "validity": ("paletted", [1]), "confidence": (ramp, [4]),
        "interval width": (ramp, [1]), "disparity": (ramp, [1]), "truth": (ramp, [1]),
        "left": ("singlebandgray", [1]), "right": ("singlebandgray", [1]),
    }  # fmt: skip
    for name in ("half width", "height", "validity", "interval width", "disparity"):
        assert layers[name]["alone_labels"] == layers[name]["labels"] != []
    shown = {name for name, layer in layers.items() if layer["shown"]}
    assert shown == {"height", "hillshade", "disparity", "left"}
    for name in (*layers, "map"):
        with Image.open(tmp_path / f"{name.replace(' ', '_')}.png") as picture:
            colours = picture.convert("RGB").getcolors(1 << 20)
        assert len(colours) > (100 if name == "map" else 1), name  # the half width is 1.5 m everywhere
        assert max(count for count, _ in colours) < 0.9 * 700 * 700, name
    with zipfile.ZipFile(tmp_path / "saved.qgz") as archive:
        assert b"made by sat-intervals" not in archive.read("saved.qgs")[:1024]
