"""Scenes of many views with errors of their models, and surfaces made of them."""

import shutil
from typing import NamedTuple

import numpy as np

from sat_intervals.demo import PIXEL
from sat_intervals.raster import Georeferencing, read_layers, write_layer
from sat_intervals.raster.images import opened
from sat_intervals.workflows.demo import CRS, LEFT, TOP, errors_of, slants_of, write_views
from sat_intervals.workflows.surface import surface

ROWS, COLUMNS, SEED = 200, 220, 1
OPTIONS = {"resolution": PIXEL, "crs": CRS}
WORDS = "--resolution", PIXEL, "--crs", CRS


class Sweep(NamedTuple):
    """Images, the folder of a surface of theirs, its report, and the true heights of its cells, NaN outside."""

    images: list
    out: object
    report: dict
    truth: np.ndarray


def swept(folder, **options):
    """Write five views of a scene, and make their surface."""
    images, truth = write_views(folder, ROWS, COLUMNS, 5, SEED)
    report = surface(images, folder / "out", **OPTIONS | options)
    return Sweep(images, folder / "out", report, on_cells(read_layers(truth)[0], report["sweep"]["cells"]))


def on_cells(truth, cells):
    first = round((cells["top"] - TOP) / PIXEL), round((LEFT - cells["left"]) / PIXEL)  # cells around the scene
    found = np.full((cells["rows"], cells["columns"]), np.nan)
    found[first[0] : first[0] + ROWS, first[1] : first[1] + COLUMNS] = truth
    return found


def with_other(folder, images, pixels):
    """Copy images in a folder, the last one with other pixels and the same model; return their paths."""
    folder.mkdir(exist_ok=True)
    paths = [folder / path.name for path in images]
    for path, copy in zip(images, paths, strict=True):
        shutil.copy(path, copy)
    with opened(str(images[-1])) as dataset:
        write_layer(paths[-1], pixels.astype(np.uint16), 0, Georeferencing(), rpcs=dataset.rpcs)
    return paths


def left_by_heights(shifts):
    """What shifts leave of the errors of models, ``(images, 2)`` pixels, but for what another datum explains."""
    left, slants = np.asarray(shifts) + errors_of(5, SEED), slants_of(5)
    left[:, 1] -= slants * (slants @ left[:, 1]) / (slants @ slants)
    return left
