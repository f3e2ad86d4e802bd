"""Arrays of tiles: strips read the pieces of rows that they need, and check them."""

import numpy as np
import pytest
import zarr

from sat_intervals.store.folder import LocalFolder
from sat_intervals.store.zarr_arrays import DamagedFileError, TileArrays
from sat_intervals.tiling import Grid, Window

SIZE, COUNT = 192, 7
SHARD = "int16/c/0/0/0"


@pytest.fixture
def arrays(tmp_path):
    """Arrays of two tiles, of which the second is cut; their checksums; random products by name."""
    grid = Grid(Window(0, 0, 300, SIZE), SIZE)
    arrays = TileArrays(LocalFolder(tmp_path), grid, COUNT, 20, 0, has_seams=False)
    arrays.create()
    random = np.random.default_rng(0)
    kinds = {"winner": np.int16, "lower": np.int16, "upper": np.int16, "validity": np.uint16}
    kinds |= {"disparity": np.float32, "ambiguity": np.uint32}
    whole = {name: random.integers(0, 99, (300, SIZE)).astype(kind) for name, kind in kinds.items()}
    checksums = {}
    for tile in grid:
        checksums |= arrays.write(
            tile, {name: band[tile.core.slices] for name, band in whole.items()} | {"histogram": np.zeros(21)}
        )
    return arrays, checksums, whole


def joined(arrays, checksums, first, last):
    strips = list(arrays.strips(64, checksums, first, last))
    return {name: np.concatenate([strip[name] for strip in strips]) for name in strips[0]}


@pytest.mark.parametrize(("first", "last"), [(0, 300), (70, 71), (100, 250), (190, 194), (256, 300)])
def test_strips__have_the_rows_that_were_written(arrays, first, last):
    arrays, checksums, whole = arrays
    found = joined(arrays, checksums, first, last)
    for name, band in whole.items():
        np.testing.assert_array_equal(found[name], band[first:last])


def test_strips__are_contiguous_where_the_tile_is_wider_than_the_image(tmp_path):
    """Kernels are compiled again for any other layout."""
    grid = Grid(Window(0, 0, 40, 100), SIZE)
    arrays = TileArrays(LocalFolder(tmp_path), grid, COUNT, 20, 0, has_seams=False)
    arrays.create()
    kinds = {"winner": np.int16, "lower": np.int16, "upper": np.int16, "validity": np.uint16}
    kinds |= {"disparity": np.float32, "ambiguity": np.uint32}
    bands = {name: np.full((40, 100), 7, kind) for name, kind in kinds.items()}
    checksums = arrays.write(grid.tile(0, 0), bands | {"histogram": np.zeros(21)})
    (strip,) = arrays.strips(64, checksums)
    assert all(plane.flags.c_contiguous for plane in strip.values())
    assert {strip[name].shape for name in bands} == {(40, 100)}


def test_write__makes_arrays_that_zarr_reads(arrays):
    arrays, _, whole = arrays
    group = zarr.open_group(arrays.folder.path, mode="r")
    for array, names in ("int16", ("winner", "lower", "upper", "validity")), ("uint32", ("disparity", "ambiguity")):
        for plane, name in zip(group[array][:, :300], names, strict=True):
            np.testing.assert_array_equal(plane.view(whole[name].dtype), whole[name])
    assert group["histogram"][:].shape == (2, 1, 21)


def test_strips__read_only_the_pieces_of_their_rows(arrays, monkeypatch):
    arrays, checksums, _ = arrays
    read_parts, read = LocalFolder.read_parts, []

    def counted(folder, parts):
        contents = read_parts(folder, parts)
        read.extend(map(len, contents))
        return contents

    monkeypatch.setattr(LocalFolder, "read_parts", counted)
    joined(arrays, checksums, 70, 120)
    assert sum(read) < 0.4 * sum(size for name, (size, *_) in checksums.items() if name.endswith(("0/0", "c/0")))


@pytest.mark.parametrize("how", ["bit", "gone", "of another tile"])
@pytest.mark.parametrize("row", [0, 64, 191])
def test_strips__meet_what_is_damaged_in_the_rows_they_read(arrays, how, row):
    arrays, checksums, _ = arrays
    file = arrays.folder.path / SHARD
    place = sum(checksums[SHARD][2 : 2 + 2 * (row // 64) : 2])
    content = bytearray(file.read_bytes())
    content[place + 40] ^= 1
    if how == "gone":
        file.unlink()
    else:
        file.write_bytes(content if how == "bit" else (file.parents[1] / "1" / "0").read_bytes())
    for first in (0, 64, 128):
        if how != "bit" or first <= row < first + 64:
            with pytest.raises(DamagedFileError):
                joined(arrays, checksums, first, first + 64)
        else:
            joined(arrays, checksums, first, first + 64)
