"""Estimates of the memory that matching needs, and the largest tile that fits in a given memory."""

from math import isqrt

from sat_intervals.config import Config, ConfigError
from sat_intervals.errors import SatIntervalsError
from sat_intervals.kernels.cost import padded_to_lanes
from sat_intervals.machine import usable_memory

# A process before its first tile, with libraries and compiled kernels; measured 240 MB.
PROCESS_BYTES = 300 * 10**6
# Per pixel of a tile with its overlap: pixels as float32 and float64, states, codes of both images, and temporary
# arrays; per pixel of the core: raw products and their compressed copies.
_PATCH_BYTES, _CORE_BYTES = 40, 60
# Per pixel of a block of tiles: pixels and states of both images.
_VIEW_BYTES = 20
# Pixels of a piece of a strip, in whole rows, and bytes for each: raw products, final bands and temporary arrays.
STRIP_PIXELS = 1 << 19
_PIECE_BYTES, _PIECE_ROWS = 100, 64
# With least squares: more temporary arrays, per pixel of a strip the pixels of both images, and, before there are
# bands, what reading them needs, at the rows of a function.
_FIT_BYTES = 60
_IMAGES_BYTES = 8
_READING_BYTES = 60
# Per pixel of a strip: final bands, which are compressed one file after another; and per pixel of the columns that are
# compressed at a time: what is written, read back and compared.
_BAND_BYTES = 18
_BLOCK_BYTES = 64
_COLUMNS = 2048

# Side in pixels of a block of small tiles, at most: that of one tile of the default size.
_BLOCK = 1024


def tiles_together(config: Config, size: int) -> int:
    """Tiles along each side of a block, at most, whose path states take less memory than the volume of one tile."""
    if not config.hands_states_on or config.cost.precomputed:
        return 1
    return max(1, min(_BLOCK // size, isqrt(size // 16)))


def volume_bytes(height: int, width: int, config: Config) -> int:
    """Bytes of the cost volume, the largest part of matching, and of precomputed matching costs."""
    return (2 + config.cost.precomputed) * height * width * padded_to_lanes(config.disparity.count)


def tile_bytes(config: Config, size: int | None = None) -> int:
    """Bytes that matching a tile needs on top of its process; ``size`` replaces ``tiles.size`` of the settings."""
    size = size or config.tiles.size
    lanes = padded_to_lanes(config.disparity.count)
    patch = size + 2 * config.tiles.support  # a tile alone in its region has support on all sides
    volume = 2 * (size + 2) ** 2 * lanes
    accurate = config.matches_right_view
    if accurate:
        volume = 2 * size * (size + config.disparity.count) * lanes  # the volume of the right view is wider
    per_candidate = config.cost.precomputed + config.cost.converted
    volume += per_candidate * lanes * patch * (patch + accurate * (patch + config.disparity.count))
    volume += config.cost.column_bytes * (patch + config.disparity.count)
    paths = 2 * 3 * (patch + config.disparity.count) * lanes
    together = tiles_together(config, size)
    if config.hands_states_on:
        # of four wavefronts: two lines of two paths, of three neighbours and of tiles in a block
        paths += (1 + accurate) * 4 * (3 + together) * 8 * together * size * lanes
    if together > 1:
        paths += _VIEW_BYTES * together * size * (together * size + config.disparity.count)
    return volume + paths + _PATCH_BYTES * patch * (patch + config.disparity.count) + _CORE_BYTES * size**2


def waiting_bytes(config: Config, size: int | None = None) -> int:
    """Bytes of images and products of a tile that is read or written while others are matched."""
    size = size or config.tiles.size
    side = size * tiles_together(config, size) + 2 * config.tiles.support
    return _VIEW_BYTES * side * (side + config.disparity.count) + _CORE_BYTES * size**2


def strip_bytes(rows: int, width: int, config: Config) -> int:
    """Bytes that finishing a strip of final rows needs on top of its process."""
    piece = (_PIECE_BYTES + config.fits * _FIT_BYTES) * max(STRIP_PIXELS, _PIECE_ROWS * width)
    bands, facing = rows * width * (_BAND_BYTES + 6 * len(config.extra_bands)), width + config.disparity.count
    writing = bands // 2 + rows * min(width, _COLUMNS) * _BLOCK_BYTES
    reading = rows * facing * _READING_BYTES if config.fits and config.rows == "auto" else 0
    return max(reading, bands + config.fits * rows * facing * _IMAGES_BYTES + piece, bands + writing)


def fitted(config: Config, memory: int, tiles_at_once: int = 1, waiting: int = 0) -> Config:
    """Reduce the tile size until ``tiles_at_once`` tiles and ``waiting`` ones fit in a process of ``memory`` bytes."""
    for size in range(config.tiles.size, 0, -64):
        tiles = tiles_at_once * tile_bytes(config, size) + waiting * waiting_bytes(config, size)
        if PROCESS_BYTES + tiles <= memory:
            return config.model_copy(update={"tiles": config.tiles.model_copy(update={"size": size})})
    raise ConfigError(
        f"tiles of {size} pixels with overlap {config.tiles.overlap} and {config.disparity.count} disparities, "
        f"{tiles_at_once} at once, need {(PROCESS_BYTES + tiles) / 1e6:.0f} MB, but {memory / 1e6:.0f} MB are given: "
        "give more memory or fewer workers"
    )


def check_strips(rows: int, width: int, config: Config, memory: int, strips_at_once: int = 1) -> None:
    """Raise if ``strips_at_once`` strips of final rows do not fit in a process of ``memory`` bytes."""
    needed = PROCESS_BYTES + strips_at_once * strip_bytes(rows, width, config)
    if needed > memory:
        raise ConfigError(
            f"strips of {rows} x {width} pixels, {strips_at_once} at once, need {needed / 1e6:.0f} MB, but "
            f"{memory / 1e6:.0f} MB are given: give more memory or fewer workers, or match a narrower window"
        )


def check_memory(needed: int, what: str, remedy: str) -> None:
    """Raise if ``needed`` bytes exceed the memory of this process; ``what`` and ``remedy`` are for the message."""
    usable = usable_memory()
    if needed > usable:
        raise SatIntervalsError(
            f"{what} need {needed / 1e9:.1f} GB, this process may use {usable / 1e9:.1f} GB: {remedy}"
        )
