"""Find and read the RPC models of sensor images."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rasterio import Env

from sat_intervals.raster import gdal
from sat_intervals.raster.images import opened

# What GDAL reads beside an image only, and what shareloc does not read at all.
_BESIDE = ".rpb", "_rpc.txt"


def find_model(image: str) -> str | None:
    """Return the file with the RPC model of an image: beside it, else the image itself; None if there is none."""
    with opened(image) as dataset:
        known, files = dataset.rpcs is not None, dataset.files
    if not known:
        beside = Path(image).with_suffix(".geom")
        return str(beside) if beside.is_file() else None
    # RPC_*.XML of DIMAP is of the whole product: only GDAL moves it to the tile of the image
    own = [file for file in files if Path(file).name.lower().endswith(_BESIDE)]
    return own[0] if own else image


def read_rpc_file(path: str) -> dict[str, Any] | None:
    """Return the coefficients in a file .RPB or _RPC.TXT by rasterio's names; None if it is of another kind."""
    if not path.lower().endswith(_BESIDE):
        return None
    with TemporaryDirectory() as folder:
        image = Path(folder) / "image.tif"
        end = next(end for end in (".RPB", "_RPC.TXT") if path.lower().endswith(end.lower()))
        shutil.copyfile(path, image.with_name(f"image{end}"))
        with Env(), gdal.create(str(image), height=1, width=1, count=1, dtype=np.uint8) as dataset:
            dataset.write(np.ones((1, 1, 1), np.uint8))
        with gdal.reading(str(image)) as dataset:
            found = dataset.rpcs
    if found is None:
        raise ValueError("GDAL finds no RPC in it")
    return dict(found.to_dict())
