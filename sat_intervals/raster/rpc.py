"""Find and read the RPC models of sensor images."""

import os
import re
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rasterio import Env
from rasterio.rpc import RPC

from sat_intervals.errors import InputError
from sat_intervals.raster import gdal
from sat_intervals.raster.identity import in_zip
from sat_intervals.raster.images import opened
from sat_intervals.store.remote import RemotePath, path_of

_BESIDE = ".rpb", "_rpc.txt"  # what GDAL reads beside an image only, and what shareloc does not read at all
# Names in the order of files without names, after two errors in some.
_SINGLE = [f"{axis}_{what}" for what in ("OFF", "SCALE") for axis in ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")]
_LISTS = [f"{axis}_{part}_COEFF_{i}" for axis in ("LINE", "SAMP") for part in ("NUM", "DEN") for i in range(1, 21)]
# Powers of longitude, latitude and height in the terms of an RPC, up to the second order; the others are 0.
_TERMS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2))


def find_model(image: str) -> str | None:
    """Return the file with the RPC model of an image: beside it or its target, else the image itself; None without."""
    with opened(image) as dataset:
        known, files = dataset.rpcs is not None, dataset.files
    if not known:
        beside = path_of(image).with_suffix(".geom")
        if (in_zip(str(beside)) or beside).is_file():
            return str(beside)
        return find_model(os.path.realpath(image)) if os.path.islink(image) else None
    # RPC_*.XML of DIMAP is of the whole product: only GDAL moves it to the tile of the image
    own = [file for file in files if Path(file).name.lower().endswith(_BESIDE)]
    return str(path_of(own[0])) if own and not in_zip(image) else image


def local_copy(path: str, folder: str, ends: tuple[str, ...] = (".geom", ".xml")) -> str:
    """Return a path; of a file in a zip archive or bucket that of a copy in a folder, if its name has one of ``ends``.

    Only GDAL reads archives and buckets.
    """
    if isinstance(there := path_of(path), RemotePath) and path.lower().endswith(ends):
        copy = Path(folder) / there.name
        copy.write_bytes(there.read_bytes())
        return str(copy)
    file = in_zip(path)
    return file.root.extract(file.at, folder) if file and path.endswith(".geom") else path


def read_rpc_file(path: str) -> dict[str, Any] | None:
    """Return the coefficients in a text file, whatever its name, or of an image in a bucket; None of other kinds."""
    file = path_of(path)
    if isinstance(file, RemotePath):
        with suppress(InputError), opened(path) as dataset:
            if dataset.rpcs:
                return dict(dataset.rpcs.to_dict())
    if not file.is_file() or file.stat().st_size > 100_000:  # no raster is read whole
        return None
    text = file.read_bytes().decode("latin-1")
    values = re.split(r"[\s,;]+", text.strip(" \t\r\n,;"))
    if re.fullmatch(r"[-+.\deE]+", "".join(values)) and len(values) in (90, 92):
        text = "\n".join(f"{name}: {value}" for name, value in zip(_SINGLE + _LISTS, values[-90:], strict=True))
    end = ".RPB" if re.search(r"^\s*lineNumCoef\s*=", text, re.IGNORECASE | re.MULTILINE) else "_RPC.TXT"
    if end == "_RPC.TXT":
        text = re.sub(r"[ \t]*[:=][ \t]*", ": ", text)  # GDAL reads no spaces before the colon
        if not re.search(r"^\s*LINE_NUM_COEFF_20:", text, re.IGNORECASE | re.MULTILINE):
            return None
    with TemporaryDirectory() as folder:
        image = Path(folder) / "image.tif"
        image.with_name(f"image{end}").write_bytes(text.encode("latin-1"))
        with Env(), gdal.create(str(image), height=1, width=1, count=1, dtype=np.uint8) as dataset:
            dataset.write(np.ones((1, 1, 1), np.uint8))
        with gdal.reading(str(image)) as dataset:
            found = dataset.rpcs
    if found is None:
        raise ValueError("GDAL finds no RPC in it")
    return dict(found.to_dict())


def fitted_rpc(ground: np.ndarray, places: np.ndarray) -> RPC:
    """Return an RPC model of the second order, fitted by least squares.

    ground: ``(n, 3)`` longitude, latitude (degrees) and height (metres) of points all over an image.
    places: ``(n, 2)`` their rows and columns, whose pixel centres are integers.
    """
    offset, scale = ground.mean(axis=0), np.maximum(np.ptp(ground, axis=0) / 2, 1e-6)
    terms = (((ground - offset) / scale)[:, np.newaxis, :] ** np.array(_TERMS)).prod(axis=2)
    middle, half = places.mean(axis=0), np.ptp(places, axis=0) / 2
    fitted = np.zeros((20, 2))
    fitted[: len(_TERMS)] = np.linalg.lstsq(terms, (places - middle) / half, rcond=None)[0]
    one, figures = np.eye(20)[0].tolist(), dict[str, float]()
    names = "long", "lat", "height", "line", "samp"
    for name, off, by in zip(names, (*offset, *middle), (*scale, *half), strict=True):
        figures |= {f"{name}_off": float(off), f"{name}_scale": float(by)}
    line, sample = fitted.T.tolist()
    return RPC(**figures, line_num_coeff=line, samp_num_coeff=sample, line_den_coeff=one, samp_den_coeff=one)
