"""Position grids of CARS and displacement grids of OTB: both give the same points, and others are refused."""

import numpy as np
import pytest
import rasterio
from cameras import cameras, grid, sensor_words
from finished import write_run
from helpers import invoke
from rasterio.transform import Affine

from sat_intervals.raster import Georeferencing, open_image

pytestmark = [
    pytest.mark.peer("shareloc"),
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),
]

SHAPE = 40, 50


def displacements(path, positions, left, **tags):
    """Write a position grid as OTB does: displacements from coordinates, those of the pixels of an image."""
    with rasterio.open(positions) as source:
        place = left @ Affine.translation(0.5, 0.5) @ source.transform
        column, row = np.meshgrid(np.arange(source.width) + 0.5, np.arange(source.height) + 0.5)
        values = source.read() - np.stack(place @ (column, row))
        kind = source.profile | {"transform": place}
    with rasterio.open(path, "w", **kind) as dataset:
        dataset.write(values)
        dataset.update_tags(**tags)
    return path


@pytest.fixture
def run(tmp_path):
    """A run of one disparity, its models and position grids, and the transform of its left image."""
    bands = np.full((4, *SHAPE), 1.0, np.float32)
    bands[1], bands[2] = -1.5, 4.0
    out = write_run(tmp_path, bands, np.zeros(SHAPE, np.uint16))
    return out, cameras(tmp_path, *SHAPE), open_image(out / "validity.tif").georeferencing.transform


def triangulated(out, files):
    return invoke("triangulate", out, *sensor_words(files), "--quiet")


def test_read_grid__displacements_give_the_points_of_positions(run, tmp_path):
    out, (*models, left, right), place = run
    assert triangulated(out, [*models, left, right]).exit_code == 0
    with rasterio.open(out / "points.tif") as dataset:
        expected = dataset.read()
    others = [displacements(tmp_path / f"{one.stem}_otb.tif", one, place, METADATATYPE="OTB") for one in (left, right)]
    result = triangulated(out, [*models, *others])
    assert (result.exit_code, result.stderr) == (0, "")
    with rasterio.open(out / "points.tif") as dataset:
        found = dataset.read()
    np.testing.assert_allclose(found[:6], expected[:6], rtol=0, atol=1e-4)
    np.testing.assert_allclose(found[:2], expected[:2], rtol=0, atol=1e-9)


def test_read_grid__coordinates_without_a_transform_begin_at_the_corner_of_the_first_pixel(tmp_path):
    from sat_intervals.heights.sensors import read_grid

    positions = grid(tmp_path / "positions.tif", *SHAPE)
    otb = displacements(tmp_path / "otb.tif", positions, Affine.identity(), METADATATYPE="OTB")
    place = np.array([[3.0, 7.0]])
    for path in (positions, otb):
        np.testing.assert_allclose(read_grid(path, Georeferencing()).interpolate(place), [[3.5, 7.5]])


def test_triangulate_command__refuses_grids_of_other_content(run, tmp_path):
    out, (*models, left, right), _ = run
    untagged = displacements(tmp_path / "untagged.tif", left, Affine.identity())
    flat = tmp_path / "flat.tif"
    with rasterio.open(left) as source, rasterio.open(flat, "w", **source.profile) as dataset:
        dataset.write(-np.indices((source.height, source.width))[::-1] * 20.0)
        dataset.update_tags(METADATATYPE="OTB")
    complex_ = tmp_path / "complex.tif"
    with rasterio.open(left) as source, rasterio.open(complex_, "w", **source.profile | {"dtype": "complex64"}) as file:
        file.write(source.read().astype(np.complex64))
    for path, kind in ((untagged, "sensor positions: "), (complex_, "sensor positions: "), (flat, "displacements, as")):
        result = triangulated(out, [*models, path, right])
        assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
        assert f"{path} does not contain {kind}" in result.stderr
        assert "give the grid of CARS or shareloc, or that of OTB with tag METADATATYPE=OTB" in result.stderr
        assert not (out / "points.tif").exists()
