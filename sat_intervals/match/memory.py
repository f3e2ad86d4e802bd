"""Memory of a worker, from the sizes of what it holds; and the tile that fits in a given one."""

from sat_intervals.config import Config, ConfigError, Mccnn
from sat_intervals.errors import SatIntervalsError
from sat_intervals.machine import usable_memory

# A process before its first tile, its libraries and compiled kernels; measured 240 MB.
PROCESS_BYTES = 300 * 10**6
# Per pixel of a tile with its overlap: pixels as float32 and float64 on their way, states, codes of both images, and
# what numpy keeps meanwhile; per pixel of the core: raw products and their compressed copies.
_PATCH_BYTES, _CORE_BYTES = 40, 60
# Per column of a patch: what the network of MC-CNN holds of a strip of rows, and the features of both images.
_NETWORK_BYTES = 140_000


def _lanes(config: Config) -> int:
    """Disparities in whole vectors."""
    return -(-config.disparity.count // 32) * 32


def volume_bytes(height: int, width: int, config: Config) -> int:
    """The volume of so many pixels, the most of what matching takes; that of MC-CNN's costs comes on top."""
    return (3 if isinstance(config.cost, Mccnn) else 2) * height * width * _lanes(config)


def tile_bytes(config: Config, size: int | None = None) -> int:
    """Memory that a tile takes while it is matched, on top of its process; ``size`` in place of the settings' own."""
    size = size or config.tiles.size
    lanes = _lanes(config)
    patch = size + 2 * config.tiles.overlap
    volume = 2 * (size + 2) ** 2 * lanes
    accurate = config.cross_check is not None and config.cross_check.method == "accurate"
    if accurate:
        volume = 2 * size * (size + config.disparity.count) * lanes  # that of the right view, which is wider
    if isinstance(config.cost, Mccnn):
        volume += lanes * patch * (patch + accurate * (patch + config.disparity.count))
        volume += _NETWORK_BYTES * (patch + config.disparity.count)
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


def check_memory(needed: int, what: str, way_out: str) -> None:
    """Refuse what needs more bytes than this process may use.

    Raises
    ------
    SatIntervalsError
        With both figures.
    """
    usable = usable_memory()
    if needed > usable:
        raise SatIntervalsError(
            f"{what} need {needed / 1e9:.1f} GB, this process may use {usable / 1e9:.1f} GB: {way_out}"
        )
