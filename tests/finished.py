"""Folders of finished runs with bands made by a test, for code that only reads results."""

import json

import numpy as np
from rasterio import Env

from sat_intervals.config import load_config
from sat_intervals.match.statistics import Tally
from sat_intervals.products import FLAGS, INVALID, OCCLUSION, Bands
from sat_intervals.raster import RUN_FILES, Georeferencing, gdal, north_up, surface_file, write_layer
from sat_intervals.show.legend import PIXEL_CLASSES

PLACE = north_up(32631, x=370_000, y=4_830_000, pixel=0.5)
NOWHERE = Georeferencing()
MINIMUM, MAXIMUM = -20, 10
FINISHED = "2026-11-21T12:00:00+00:00"


def write_run(folder, bands, validity, truth=None, image=None, place=None):
    """Write a run of ``bands`` ``(4, rows, columns)``, with its images and, where given, the truth beside them.

    Returns the folder of the run, inside ``folder``.
    """
    place = place or PLACE
    if image is None:
        image = np.random.default_rng(0).integers(100, 1000, validity.shape)
    inputs = {"left": folder / "left.tif", "right": folder / "right.tif"}
    for path in inputs.values():
        write_layer(path, image.astype(np.uint16), 0, place)
    if truth is not None:
        write_layer(folder / "truth.tif", truth.astype(np.float32), float("nan"), place)
    out = folder / "out"
    out.mkdir(parents=True, exist_ok=True)
    for file, raster in zip(RUN_FILES, (bands, validity), strict=True):
        write_file(out / file.name, file, raster, place)
    (out / "run.json").write_text(json.dumps(_report(inputs, bands, validity)))
    return out


def write_file(path, file, bands, place=NOWHERE, tags=None):
    """Write bands as one of our files, but as a plain GeoTIFF: blocks of 512 pixels take longer than most tests."""
    bands = bands.reshape(-1, *bands.shape[-2:]).astype(file.dtype)
    count, height, width = bands.shape
    kind = {"count": count, "height": height, "width": width, "dtype": file.dtype, "nodata": file.nodata}
    with Env(), gdal.create(str(path), **kind, **place.creation_options()) as dataset:
        file.describe(dataset, tags or {})
        dataset.write(bands)


def _report(inputs, bands, validity):
    height, width = validity.shape
    tally = Tally(MAXIMUM - MINIMUM + 1)
    tally.add(Bands(*bands, validity))
    described = {"height": height, "width": width, "band": 1, "nodata": "0.0", "mask": None, "dtype": "uint16"}
    config = load_config({"preset": "paper", "disparity": {"minimum": MINIMUM, "maximum": MAXIMUM}})
    return {
        "finished": FINISHED,
        "settings": config.model_dump(mode="json"),
        "inputs": {side: {"path": str(path), **described} for side, path in inputs.items()},
        "tiles": {
            "region": {"row": 0, "column": 0, "height": height, "width": width},
            "rows": 2,
            "columns": 3,
            "size": max(1, -(-max(height, width) // 3)),
            "overlap": 100,
        },
        "counts": tally.report(),
        "search": None,
        "local_ranges": None,
        "survey": None,
        "rows": None,
        "quality": {"noise": 0.41, "undeclared": {"left": {"value": 0.0, "share": 0.05}}},
        "warnings": ["left.tif: 5 % of the pixels are exactly 0"],
        "verdict": "80 % valid, but see the warning",
        "validity_bits": {
            flag.name: {"bit": flag.bit, "meaning": flag.meaning, "invalid": flag.invalid} for flag in FLAGS
        },
        "seconds": {"tiles": 1.0, "tiles.read": 0.5, "total": 1.0},
        "versions": {"python": "3.11"},
    }


def random_bands(height, width, seed=0):
    """Bands of all kinds of pixels that obey the law of intervals, validity, and a truth that some intervals miss."""
    random = np.random.default_rng(seed)
    disparity = random.uniform(MINIMUM + 4, MAXIMUM - 4, (height, width))
    lower, upper = np.floor(disparity - random.integers(0, 4, disparity.shape)), np.ceil(disparity + 1)
    validity = random.choice([0, *(kind.flag for kind in PIXEL_CLASSES)], disparity.shape).astype(np.uint16)
    bands = np.stack([disparity, lower, upper, random.random(disparity.shape)]).astype(np.float32)
    bands[:3, validity & INVALID != 0] = np.nan
    truth = disparity + random.normal(0, 1.5, disparity.shape)
    truth[random.random(truth.shape) < 0.1] = np.nan
    return bands, validity, truth.astype(np.float32)


def without_intervals(folder):
    """A run without intervals, with a truth."""
    bands, validity, truth = random_bands(40, 50)
    bands[1:3] = np.nan
    out = write_run(folder, bands, validity, truth)
    report = json.loads((out / "run.json").read_text())
    report["settings"] |= {"interval": None, "regularization": None}
    (out / "run.json").write_text(json.dumps(report))
    return out


def no_bands(height, width):
    """Bands and validity of a run in which cross-checking rejected every pixel."""
    return np.full((4, height, width), np.nan, np.float32), np.full((height, width), OCCLUSION, np.uint16)


def write_surface(out, height, agreement=np.nan, runs=FINISHED):
    """A surface of intervals 3 m wide beside a run, whose confidence is one half."""
    ones = np.ones_like(height)
    bands = np.stack([height, height - 1, height + 2, ones, 0.5 * ones, agreement * ones])
    write_file(out / "dsm.tif", surface_file("dsm.tif"), bands, PLACE, {"RUNS": runs})
