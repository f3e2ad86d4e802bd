"""CARS, from PyPI, with this matcher in its own pipeline: a part of a real pair from images to surface."""

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from rasterio.rpc import RPC
from rasterio.warp import reproject

from sat_intervals.errors import SatIntervalsError
from sat_intervals.tiling import Window

PART = Window(430, 470, 340, 380)
PATIENCE = 400.0
DUMP = "intermediate_data/surface_modeling/res1/dump_dir"


def fitted(pixel, ground):
    """An RPC of denominator 1 that takes ``ground`` (longitude, latitude, height) to ``pixel`` (column, row)."""
    offset = {name: (values.max() + values.min()) / 2 for name, values in (ground | pixel).items()}
    scale = {name: (values.max() - values.min()) / 2 for name, values in (ground | pixel).items()}
    x, y, z = ((values - offset[name]) / scale[name] for name, values in ground.items())
    one = np.ones_like(x)
    terms = [
        one, x, y, z, x * y, x * z, y * z, x * x, y * y, z * z, x * y * z, x**3, x * y * y, x * z * z, x * x * y, y**3,
        y * z * z, x * x * z, y * y * z, z**3,
    ]  # fmt: skip
    coefficients = {}
    for name, values in pixel.items():
        wanted = (values - offset[name]) / scale[name]
        coefficients[name], *_ = np.linalg.lstsq(np.column_stack(terms), wanted, rcond=None)
        assert np.abs(np.column_stack(terms) @ coefficients[name] - wanted).max() * scale[name] < 1e-3
    unit = [1.0] + [0.0] * 19
    return RPC(
        line_off=offset["row"], line_scale=scale["row"], samp_off=offset["column"], samp_scale=scale["column"],
        long_off=offset["longitude"], long_scale=scale["longitude"], lat_off=offset["latitude"],
        lat_scale=scale["latitude"], height_off=offset["height"], height_scale=scale["height"],
        line_num_coeff=list(coefficients["row"]), line_den_coeff=unit,
        samp_num_coeff=list(coefficients["column"]), samp_den_coeff=unit,
    )  # fmt: skip


def write_sensor_image(folder: Path, side: str, target: Path) -> None:
    """A part of an epipolar image as a sensor image: its RPC is that of the raw image through the epipolar grid."""
    from shareloc.geofunctions.rectification_grid import RectificationGrid
    from shareloc.geomodels import GeoModel

    rows, columns = (np.linspace(0, size - 1, 15) for size in (PART.height, PART.width))
    row, column, height = map(np.ravel, np.meshgrid(rows, columns, np.linspace(640, 800, 7), indexing="ij"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        grid = RectificationGrid(str(folder / f"{side}_grid.tif"))
        sensor = grid.interpolate(np.column_stack([column + PART.column, row + PART.row]))
        points = GeoModel(str(folder / f"{side}.geom"), "RPC").direct_loc_h(sensor[:, 1], sensor[:, 0], height)
        ground = dict(zip(("longitude", "latitude", "height"), points.T, strict=True))
        with rasterio.open(folder / f"{side}.tif") as dataset:
            pixels, nodata = dataset.read(1)[PART.slices], dataset.nodata
    kind = {"height": PART.height, "width": PART.width, "count": 1, "dtype": pixels.dtype, "nodata": nodata}
    with rasterio.open(
        target, "w", driver="GTiff", rpcs=fitted({"column": column, "row": row}, ground), **kind
    ) as dataset:
        dataset.write(pixels, 1)


def configuration() -> dict:
    sensors = {
        side: {"image": f"{side}.tif", "geomodel": {"path": f"{side}.tif", "model_type": "RPC"}}
        for side in ("left", "right")
    }
    method = {"method": "sat_intervals", "settings": {"interval": {"alpha": 0.9}}, "save_intermediate_data": True}
    return {
        "input": {"sensors": sensors, "pairing": [["left", "right"]], "initial_elevation": {"dem": "dem.tif"}},
        "output": {"directory": "out", "resolution": 1.0, "epsg": 32637, "geoid": False},
        "orchestrator": {"mode": "sequential"},
        "subsampling": {"advanced": {"resolutions": [1]}},
        "surface_modeling": {
            "applications": {"all": {"dense_matching": method, "triangulation": {"save_intermediate_data": True}}}
        },
    }


def read(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            return np.where(dataset.read_masks(1) > 0, dataset.read(1).astype(np.float64), np.nan)


@pytest.mark.peer
def test_cars_plugin__of_another_version_leaves_cars_alone(tmp_path):
    (tmp_path / "cars").mkdir()
    (tmp_path / "cars" / "__init__.py").write_text("import sat_intervals.interop.cars_plugin\n")
    done = subprocess.run(
        [sys.executable, "-c", "import cars"], env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "sat_intervals needs CARS 1.3 and cannot be used with this version" in done.stderr


@pytest.mark.peer("cars")
def test_cars_method__has_the_penalties_of_cars_and_confidence_relative_to_its_range():
    with patch.dict(os.environ):  # it changes the environment of other tests: dask's configuration, numbers of threads
        import cars  # noqa: F401

    from sat_intervals.interop.cars_method import SatIntervals

    config = SatIntervals(None)._config(-9, 4)
    assert (config.preset, config.sgm.p1, config.sgm.p2, config.cost.window) == ("paper", 8, 32, 5)
    assert (config.ambiguity.normalization, config.interval.coverage) == ("range", None)
    given = {"preset": "satellite", "interval": {"coverage": 0.9}}
    config = SatIntervals({"settings": given})._config(-9, 4)
    assert (config.sgm.p2, config.ambiguity.normalization, float(config.interval.coverage)) == (144, "percentile", 0.9)
    for wrong in ({"disparity": {"minimum": 0}}, {"interval": None}):
        with pytest.raises(SatIntervalsError, match="leave out disparity, and null for interval or ambiguity"):
            SatIntervals({"settings": wrong})


@pytest.mark.peer("cars")
def test_cars__matches_a_real_pair_with_intervals_up_to_its_surface(shared_data, tmp_path):
    folder = shared_data / "dsm_picanteo"
    for side in ("left", "right"):
        write_sensor_image(folder, side, tmp_path / f"{side}.tif")
    place = rasterio.transform.from_origin(36.88, 37.61, 0.005, 0.005)
    kind = {"height": 12, "width": 12, "count": 1, "dtype": "float32", "crs": "EPSG:4326", "transform": place}
    with rasterio.open(tmp_path / "dem.tif", "w", driver="GTiff", **kind) as dataset:
        dataset.write(np.full((1, 12, 12), 680, np.float32))
    (tmp_path / "conf.json").write_text(json.dumps(configuration()))
    command = Path(sys.executable).with_name("cars")
    done = subprocess.run(
        [command, "conf.json", "--logtype", "plain"],
        cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, (done.stdout + done.stderr)[-2000:]

    dump = tmp_path / "out" / DUMP
    names = ("disp", "disp_interval_bounds_inf", "disp_interval_bounds_sup", "disp_ambiguity")
    disparity, lower, upper, ambiguity = (read(dump / f"dense_matching/left_right/epi_{name}.tif") for name in names)
    valid = read(dump / "dense_matching/left_right/epi_disp_mask.tif") == 255
    assert valid.sum() > 0.5 * PART.height * PART.width
    assert (lower <= disparity)[valid].all()
    assert (disparity <= upper)[valid].all()
    assert np.median((upper - lower)[valid]) < 10
    assert ((ambiguity >= 0) & (ambiguity <= 1))[valid].all()

    heights = ("Z", "Z_inf_from_intervals", "Z_sup_from_intervals")
    height, low, high = (read(dump / f"triangulation/left_right/tif/{name}.tif") for name in heights)
    known = np.isfinite(height)
    assert known.sum() > 0.5 * PART.height * PART.width
    assert ((np.minimum(low, high) <= height + 1e-3) & (height <= np.maximum(low, high) + 1e-3))[known].all()

    with rasterio.open(folder / "peer_dsm_mean_1m.tif") as peer, rasterio.open(tmp_path / "out/dsm/dsm.tif") as dsm:
        expected, surface = peer.read(1), np.full(peer.shape, np.nan, np.float32)
        reproject(dsm.read(1), surface, src_transform=dsm.transform, src_crs=peer.crs, dst_transform=peer.transform,
                  dst_crs=peer.crs, src_nodata=dsm.nodata, dst_nodata=np.nan)  # fmt: skip
    difference = (surface - expected)[np.isfinite(surface) & np.isfinite(expected)]
    assert difference.size > 10_000
    assert abs(np.median(difference)) < 0.2
    assert (np.abs(difference) <= 1).mean() > 0.8
