"""Memory of a worker, from the sizes of what it holds; and the tile that fits in a given one."""

import os
import re

from sat_intervals.config import Config, ConfigError

# A process before its first tile, its libraries and compiled kernels; measured 240 MB.
PROCESS_BYTES = 300 * 10**6
# Per pixel of a tile with its overlap: pixels as float32 and float64 on their way, states, codes of both images, and
# what numpy keeps meanwhile; per pixel of the core: raw products and their compressed copies.
_PATCH_BYTES, _CORE_BYTES = 40, 60
_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}


def parse_bytes(text: str) -> int:
    """Bytes of a figure such as ``4GB``, ``512 MiB`` or ``3e9``.

    Raises
    ------
    ConfigError
        For what is none.
    """
    found = re.fullmatch(r"\s*([0-9.]+(?:e[0-9]+)?)\s*([KMGT]?I?)B?\s*", text.upper().replace("E", "e"))
    if not found or found[2] not in _UNITS:
        raise ConfigError(f"memory {text!r}: give a figure with a unit, such as 4GB or 512MiB")
    return int(float(found[1]) * _UNITS[found[2]])


def machine_bytes() -> int:
    """Memory of this machine."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def volume_bytes(height: int, width: int, count: int) -> int:
    """The volume of so many pixels and disparities, the most of what matching takes."""
    return 2 * height * width * (-(-count // 32) * 32)


def tile_bytes(config: Config, size: int | None = None) -> int:
    """Memory that a tile takes while it is matched, on top of its process; ``size`` in place of the settings' own."""
    size = size or config.tiles.size
    lanes = -(-config.disparity.count // 32) * 32
    patch = size + 2 * config.tiles.overlap
    volume = 2 * (size + 2) ** 2 * lanes
    if config.cross_check and config.cross_check.method == "accurate":
        volume = 2 * size * (size + config.disparity.count) * lanes  # that of the right view, which is wider
    paths = 2 * 3 * (patch + config.disparity.count) * lanes
    return volume + paths + _PATCH_BYTES * patch * (patch + config.disparity.count) + _CORE_BYTES * size**2


def fitted(config: Config, memory: int, tiles_at_once: int = 1) -> Config:
    """The settings with the largest tile, no larger than theirs, of which so many fit in a process with its memory.

    Raises
    ------
    ConfigError
        Where not even the smallest fits; the search range is never cut.
    """
    sizes = range(config.tiles.size, 0, -64)
    for size in sizes:
        if PROCESS_BYTES + tiles_at_once * tile_bytes(config, size) <= memory:
            return config.model_copy(update={"tiles": config.tiles.model_copy(update={"size": size})})
    needed = PROCESS_BYTES + tiles_at_once * tile_bytes(config, sizes[-1])
    raise ConfigError(
        f"tiles of {sizes[-1]} pixels with overlap {config.tiles.overlap} and {config.disparity.count} disparities, "
        f"{tiles_at_once} at once, need {needed / 1e6:.0f} MB, given are {memory / 1e6:.0f} MB: "
        "give more memory or fewer workers"
    )
