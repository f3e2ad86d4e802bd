"""OTB in both directions: from raw images by the commands of the guide, and its heights beside ours."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rasterio
from cameras import EAST, LATITUDE, LONGITUDE, NORTH, camera
from helpers import COMMAND, invoke
from rasterio.rpc import RPC
from rasterio.transform import Affine
from rasterio.warp import reproject

from sat_intervals.demo import DATUM, PIXEL, VIEWS, make_scene

pytestmark = [
    pytest.mark.peer("shareloc"),
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),
]

GUIDE = Path(__file__).parents[2] / "docs" / "guide.md"
# Raw images are turned against the epipolar ones by these angles, and shifted.
TURNS, SHIFTS, SIDE = (np.radians(8), np.radians(11)), ((20.0, -30.0), (15.0, -35.0)), 260


def run(words, folder):
    """Run a command of OTB, of rasterio or of this tool; return what it prints."""
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def otb():
    """A function that runs a command in a folder, if OTB is installed."""
    if shutil.which("otbcli_DisparityMapToElevationMap") is None:
        pytest.skip("OTB is not installed: apt-get install otb-bin")
    return run


def turned(image, turn, shift):
    """Return a raw image: the epipolar one, turned and shifted, and the positions of its pixels there."""
    from scipy.ndimage import map_coordinates

    row, column = np.mgrid[:SIDE, :SIDE]
    x, y = column - shift[0], row - shift[1]
    place = np.cos(turn) * y - np.sin(turn) * x, np.cos(turn) * x + np.sin(turn) * y
    return map_coordinates(image.astype(np.float64), place, order=3).round().clip(0, 4095).astype(np.uint16)


def otb_heights(path, lowest, like):
    """Read OTB's map, whose empty cells have the lowest height, on the cells of our surface model."""
    with rasterio.open(path) as map_, rasterio.open(like) as surface:
        heights, cells = map_.read(1), np.full(surface.shape, np.nan, np.float32)
        heights[heights <= lowest] = np.nan
        reproject(heights, cells, src_transform=map_.transform, src_crs="EPSG:4326", dst_transform=surface.transform,
                  dst_crs=surface.crs, src_nodata=np.nan, dst_nodata=np.nan)  # fmt: skip
        return cells, surface.read(1)


@pytest.fixture(scope="module")
def surfaced(otb, tmp_path_factory):
    """The scene and the folder where the commands of the guide ran, from raw images to both maps of heights."""
    folder = tmp_path_factory.mktemp("raw")
    scene = make_scene(300, 300, seed=3)
    for side, view, turn, shift in zip(("left", "right"), VIEWS, TURNS, SHIFTS, strict=True):
        raw = turned(getattr(scene, side), turn, shift)
        camera(folder / f"raw_{side}.tif", view, turn=turn, shift=shift, pixels=raw)
    section = GUIDE.read_text().split("## Images from OTB")[1].split("\n## ")[0]
    lines = re.findall(r"^(?:rio|otbcli_|sat-intervals) ?.*$", section, re.MULTILINE)
    assert len(lines) == 8
    printed = ""
    for line in lines:
        line = line.replace("default 700", f"default {DATUM}").replace("-hmin 600 -hmax 900", "-hmin -40 -hmax 80")
        line = line.replace("--resolution 1", f"--resolution {PIXEL}").replace("-step 1", f"-step {PIXEL}")
        for name, value in re.findall(r"epi.rect(size[xy]): (\d+)", printed):
            line = re.sub(rf"-out.{name} \d+", f"-out.{name} {value}", line)
        words = shlex.split(line)
        if words[0] in ("rio", "sat-intervals"):
            words[0] = str(COMMAND.with_name(words[0]))
        printed += otb(words, folder)
    return scene, folder


def test_guide__epipolar_images_and_grids_of_otb_fit_to_a_fraction_of_a_pixel(surfaced):
    from scipy.ndimage import map_coordinates

    from sat_intervals.heights.sensors import read_grid
    from sat_intervals.raster import open_image

    _, folder = surfaced
    left = open_image(str(folder / "left.tif")).georeferencing
    for side in ("left", "right"):
        with rasterio.open(folder / f"raw_{side}.tif") as raw, rasterio.open(folder / f"{side}.tif") as epipolar:
            image, expected = raw.read(1).astype(np.float64), epipolar.read(1).astype(np.float64)
        row, column = np.indices(expected.shape)
        sensor = read_grid(folder / f"{side}_grid.tif", left).interpolate(np.stack([column, row], axis=-1))
        # Sensor positions have the centre of the first pixel at 0.5.
        errors = {
            shift: np.abs(map_coordinates(image, sensor.T[::-1].swapaxes(1, 2) - 0.5 + shift, order=3) - expected)
            for shift in (0.0, -0.1, 0.1)
        }
        inner = (expected > 0) & (np.abs(sensor - SIDE / 2) < SIDE / 2 - 4).all(axis=-1)
        assert inner.mean() > 0.7
        assert errors[0.0][inner].mean() < min(errors[-0.1][inner].mean(), errors[0.1][inner].mean())


def test_triangulate__heights_by_grids_of_otb_are_true(otb, surfaced):
    scene, folder = surfaced
    otb([COMMAND, "triangulate", "out"], folder)
    with rasterio.open(folder / "out" / "points.tif") as points:
        longitude, latitude, height = points.read((1, 2, 3))
    found = np.isfinite(height)
    x = (longitude - LONGITUDE) * EAST / PIXEL + VIEWS[0] * (height - DATUM)
    y = (LATITUDE - latitude) * NORTH / PIXEL
    true = DATUM + scene.truth[np.rint(y[found]).astype(int), np.rint(x[found]).astype(int)]
    error = height[found] - true
    assert found.mean() > 0.5
    assert abs(np.nanmedian(error)) < 0.1
    assert np.nanmedian(np.abs(error)) < 0.25


def test_export__otb_gets_our_heights(surfaced):
    _, folder = surfaced
    theirs, ours = otb_heights(folder / "otb" / "heights.tif", -40, folder / "out" / "dsm.tif")
    both = np.isfinite(theirs) & np.isfinite(ours)
    assert both.sum() > 0.85 * np.isfinite(ours).sum()
    assert abs(np.median((theirs - ours)[both])) < 0.05
    assert (np.abs(theirs - ours)[both] < 1).mean() > 0.9


def displaced(source, target, first):
    """Write a position grid of CARS as OTB's, for a raw image that begins at a column and row."""
    with rasterio.open(source) as grid:
        column, row = np.meshgrid(np.arange(grid.width) + 0.5, np.arange(grid.height) + 0.5)
        place = Affine.translation(0.5, 0.5) @ grid.transform  # pixels of images without a geotransform
        values = grid.read() - np.stack(place @ (column, row)) - np.reshape(first, (2, 1, 1))
        kind = {"count": 2, "dtype": "float64", "transform": place}
        size = {"height": grid.height, "width": grid.width}
    with rasterio.open(target, "w", driver="GTiff", **kind, **size) as dataset:
        dataset.write(values)
        dataset.update_tags(METADATATYPE="OTB")


def raw_part(model, target, first, size):
    """Write a part of a raw image, without content, with the RPC of the whole."""
    entries = dict(line.split(": ") for line in model.read_text().splitlines())
    single = {name: float(entries[name]) for name in entries if name.endswith(("_off", "_scale"))}
    lists = {
        f"{name}_coeff": [float(entries[f"{name}_coeff_{index:02}"]) for index in range(20)]
        for name in ("line_num", "line_den", "samp_num", "samp_den")
    }
    rpc = RPC(**single | lists | {"samp_off": single["samp_off"] - first[0], "line_off": single["line_off"] - first[1]})
    kind = {"height": int(size[1]), "width": int(size[0]), "count": 1, "dtype": "uint8", "rpcs": rpc}
    with rasterio.open(target, "w", driver="GTiff", sparse_ok=True, **kind) as dataset:
        dataset.update_tags(METADATATYPE="OTB")


def test_export__otb_makes_our_heights_of_a_real_pair(otb, shared_data, tmp_path):
    folder, out = shared_data / "dsm_picanteo", tmp_path / "out"
    for side in ("left", "right"):
        with rasterio.open(folder / f"{side}_grid.tif") as grid:
            sensor = grid.read()
        first, last = np.floor(sensor.min(axis=(1, 2))), np.ceil(sensor.max(axis=(1, 2)))
        displaced(folder / f"{side}_grid.tif", tmp_path / f"{side}_grid.tif", first)
        raw_part(folder / f"{side}.geom", tmp_path / f"raw_{side}.tif", first, last - first)
    given = {f"--{side}-model": folder / f"{side}.geom" for side in ("left", "right")}
    given |= {f"--{side}-grid": folder / f"{side}_grid.tif" for side in ("left", "right")}
    region = ("--window", 450, 400, 300, 400, "--disparity", -35, 18, "--preset", "satellite")
    sensors = [word for pair in given.items() for word in pair]
    for step in (
        ("surface", folder / "left.tif", folder / "right.tif", out, *region, *sensors, "--resolution", 0.5, "--quiet"),
        ("export", out, tmp_path / "otb", "--to", "otb"),
    ):
        result = invoke(*step)
        assert result.exit_code == 0, result.stderr
    words = shlex.split(
        "otbcli_DisparityMapToElevationMap -io.in otb/disparity.tif -io.mask otb/mask.tif -io.left raw_left.tif "
        "-io.right raw_right.tif -io.lgrid left_grid.tif -io.rgrid right_grid.tif -io.out otb/heights.tif -step 0.5 "
        "-hmin 600 -hmax 850"
    )
    otb(words, tmp_path)
    theirs, ours = otb_heights(tmp_path / "otb" / "heights.tif", 600, out / "dsm.tif")
    both = np.isfinite(theirs) & np.isfinite(ours)
    difference = (theirs - ours)[both]
    assert both.sum() > 0.7 * np.isfinite(ours).sum()
    assert abs(np.median(difference)) < 0.1
    assert (np.abs(difference) < 1).mean() > 0.9
