"""Which parts the files of a run are made of, see `store.parts`, and what decides their bytes."""

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sat_intervals.config import Config
from sat_intervals.match import postprocess
from sat_intervals.raster import BLOCK, codec_versions, factors
from sat_intervals.store.manifest import digest
from sat_intervals.store.parts import Parts, parts_in
from sat_intervals.store.tiles import Store
from sat_intervals.tiling import Window

# What finishes rows decides their bytes, too.
_CODE = zlib.crc32(Path(postprocess.__file__).read_bytes())
# Increase when parts change.
_LAYOUT = 1


def parts_of(store: Store, run: str, codecs: Mapping[str, Any]) -> Parts:
    """Return the parts of a run of this name; ``codecs``: see `codecs_of`."""
    return parts_in(store, digest({"run": run, "codecs": codecs, "layout": _LAYOUT}))


def codecs_of(config: Config) -> dict[str, Any]:
    """Return what decides the bytes of parts, in this process."""
    return codec_versions(config.products.compression) | {"code": _CODE}


def rows_of_levels(region: Window) -> list[int]:
    """Return the number of rows of blocks of each level."""
    return [-(-region.height // (factor * BLOCK)) for factor in factors(region.height, region.width)]
