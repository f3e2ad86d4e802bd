"""Intermediate files: what was written is read, and damage is noticed."""

import numpy as np
import pytest

from sat_intervals.products import NO_DISPARITY
from sat_intervals.store.arrays import packed
from sat_intervals.store.folder import folder_at
from sat_intervals.store.tiles import BORDERS, TILES, DamagedTilesError, Store
from sat_intervals.tiling import Grid, Window

COUNT = 7
DAMAGES = {
    "missing": None,
    "short": lambda content: content[: len(content) // 2],
    "zeroed": lambda content: bytes(len(content)),
    "one bit": lambda content: (
        content[: len(content) // 2] + bytes([content[len(content) // 2] ^ 1]) + content[len(content) // 2 + 1 :]
    ),
}


def products(tile, random):
    shape, wide = (tile.core.height, tile.core.width), (tile.core.height, tile.core.width + COUNT - 1)
    return {
        "winner": random.integers(-9, 9, shape).astype(np.int16),
        "disparity": random.random(shape, np.float32),
        "right_cost": random.integers(0, 99, wide).astype(np.uint16),
        "right_winner": random.integers(-9, 9, wide).astype(np.int16),
        "histogram": random.integers(0, 9, 5).astype(np.uint32),
    }


@pytest.fixture(params=["disk", "memory"])
def written(request, tmp_path):
    """A store of 3 x 2 tiles of 100 pixels, and their products by name."""
    folder = folder_at(tmp_path if request.param == "disk" else f"memory://{tmp_path.name}")
    store, random = Store(folder, Grid(Window(5, 9, 230, 170), 100), "run"), np.random.default_rng(1)
    made = {tile.name: products(tile, random) for tile in store.grid}
    for tile in store.grid:
        store.write_tile(tile, made[tile.name], seconds=1.5)
    yield store, made
    store.remove()


@pytest.mark.parametrize(("first", "last"), [(0, 230), (3, 64), (90, 110), (229, 230)])
def test_strips__have_the_rows_that_were_written(written, first, last):
    store, made = written
    found = list(store.strips(64, COUNT, first, last))
    for name in ("winner", "disparity"):
        rows = [np.hstack([made[f"{row}_{column}"][name] for column in range(2)]) for row in range(3)]
        np.testing.assert_array_equal(np.vstack([strip[name] for strip in found]), np.vstack(rows)[first:last])


def test_strips__merge_right_views_by_cost_and_larger_disparity(written):
    store, made = written
    merged = np.vstack([strip["right_winner"] for strip in store.strips(64, COUNT)])
    for row, column in ((0, 3), (150, 102), (229, 175)):
        candidates = []
        for tile in store.grid:
            place = tile.core.relative_to(store.grid.region)
            right = made[tile.name]
            if place.row <= row < place.row_stop and 0 <= column - place.column < right["right_cost"].shape[1]:
                at = row - place.row, column - place.column
                candidates.append((right["right_cost"][at], -right["right_winner"][at]))
        assert merged[row, column] == -min(candidates)[1]


def test_strips__without_right_views_have_no_winner_there(tmp_path):
    store = Store(folder_at(tmp_path), Grid(Window(0, 0, 10, 10), 16), "run")
    (tile,) = store.grid
    made = products(tile, np.random.default_rng(2))
    store.write_tile(tile, {name: made[name] for name in ("winner", "histogram")})
    (strip,) = store.strips(64, COUNT)
    assert (strip["right_winner"] == NO_DISPARITY).all()
    assert strip["right_winner"].shape == (10, 10 + COUNT - 1)


def test_tables__sum_over_all_tiles(written):
    store, made = written
    tables = store.tables()
    np.testing.assert_array_equal(tables.histogram, sum(each["histogram"].astype(int) for each in made.values()))
    assert tables.records["2_1"]["seconds"] == 1.5


@pytest.mark.parametrize("how", DAMAGES)
def test_strips__delete_and_name_damaged_tiles(written, how):
    store, _ = written
    for name in ("0_1", "1_0"):
        with store.folder.opened(f"{TILES}/{name}.npz") as file:
            content = file.read()
        store.delete(TILES, [name])
        if DAMAGES[how]:
            store.folder.write(f"{TILES}/{name}.npz", DAMAGES[how](content))
    with pytest.raises(DamagedTilesError, match=r"^tiles 0_1, 1_0 in .* are damaged or missing: rerun"):
        list(store.strips(256, COUNT))
    assert store.names(TILES) == {"0_0", "1_1", "2_0", "2_1"}


def test_read__takes_no_file_of_another_run(written):
    store, _ = written
    store.write(BORDERS, "0_0_1", [("0", np.arange(3))], of="another")
    assert store.read(BORDERS, "0_0_1") is None
    assert store.meta(BORDERS, "0_0_1", "another") == {"of": "another", "names": ["0"]}


def test_write__makes_files_that_numpy_reads_and_repeats_their_bytes(tmp_path):
    arrays = [("a", np.arange(6).reshape(2, 3)), ("b/c", np.zeros((0, 2), np.float32))]
    (tmp_path / "file.npz").write_bytes(packed(arrays, {"of": "x"}))
    with np.load(tmp_path / "file.npz") as found:
        for name, array in arrays:
            np.testing.assert_array_equal(found[name], array)
        assert found["meta"] == b'{"of": "x", "names": ["a", "b/c"]}'
    assert bytes(packed(arrays, {"of": "x"})) == (tmp_path / "file.npz").read_bytes()


def test_read__notices_every_flipped_bit(tmp_path):
    store = Store(folder_at(tmp_path), Grid(Window(0, 0, 1, 1), 1), "run")
    store.write(BORDERS, "file", [(str(i), np.arange(20 + i, dtype=np.uint8)) for i in range(3)], more=1)
    file = tmp_path / BORDERS / "file.npz"
    whole = file.read_bytes()
    expected = store.read(BORDERS, "file"), store.meta(BORDERS, "file")
    for place in range(len(whole)):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        found = store.read(BORDERS, "file"), store.meta(BORDERS, "file")
        if None not in found:  # a date, or another number that does not matter
            assert found[1] == expected[1]
            assert len(found[0]) == 3
            for one, other in zip(found[0], expected[0], strict=True):
                np.testing.assert_array_equal(one, other)
