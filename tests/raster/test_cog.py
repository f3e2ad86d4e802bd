"""Cloud-Optimized GeoTIFFs assembled from parts: valid, equal to what was written, the same bytes in any order."""

import random
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import rasterio
from helpers import PLACE
from rasterio.enums import Interleaving
from rasterio.errors import NotGeoreferencedWarning
from rio_cogeo.cogeo import cog_validate

from sat_intervals.products import Band
from sat_intervals.raster import RUN_FILES, File, Georeferencing, blocks, cog, north_up, points_file, run_files
from sat_intervals.raster.blocks import BLOCK, codec_versions, compressed, factors, halved
from sat_intervals.raster.cog import Part, assemble, template
from sat_intervals.raster.streaming import Stream

INTERVALS, VALIDITY = RUN_FILES
COUNTS = File("counts.tif", "int16", -9999, (Band("count", "", "of something"),))


def noise(file: File, height: int, width: int) -> np.ndarray:
    values = np.random.default_rng(0).normal(0, 9, (len(file.bands), height, width)).astype(file.dtype)
    values[:, 0] = 0 if file.nodata is None else np.array(file.nodata).astype(file.dtype)
    return values


def parts_of(bands: np.ndarray, file: File, order: random.Random | None = None) -> list[list[Part]]:
    """Parts of every level, made in some order."""
    levels = factors(*bands.shape[1:])
    places = [(k, row) for k, f in enumerate(levels) for row in range(0, -(-bands.shape[1] // f), BLOCK)]
    if order:
        order.shuffle(places)
    made, of_levels = {}, [bands]
    of_levels += [bands := halved(bands) for _ in levels[1:]]
    for k, row in places:
        rows = compressed(of_levels[k][:, row : row + BLOCK], file)
        made[k, row] = Part(rows.sizes, rows.content)
    return [[made[place] for place in sorted(made) if place[0] == k] for k in range(len(levels))]


def write(path: Path, bands: np.ndarray, file: File, place: Georeferencing = PLACE, **options) -> None:
    made = template(file, place, {"ALPHA": "0.9"})
    assemble(path, made, bands.shape[1:], parts_of(bands, file, **options), copy_parts)


def copy_parts(path: Path, parts: Sequence[tuple[int, Part]]) -> None:
    with path.open("r+b") as out:
        for offset, part in reversed(parts):
            out.seek(offset)
            out.write(part.source)


def assert_valid(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        assert cog_validate(path, strict=True) == (True, [], [])


@pytest.mark.parametrize(
    ("file", "shape", "is_big"),
    [
        (INTERVALS, (1, 1), False),
        (INTERVALS, (513, 530), False),
        (INTERVALS, (513, 530), True),
        (VALIDITY, (512, 512), False),
        (VALIDITY, (1100, 40), True),
        (COUNTS, (3, 1100), False),
        (points_file("points.tif"), (20, 513), False),
    ],
)
def test_assemble__is_a_valid_file_with_every_level(tmp_path, monkeypatch, file, shape, is_big):
    monkeypatch.setattr(cog, "_CLASSIC", 0 if is_big else 1 << 32)
    bands, path = noise(file, *shape), tmp_path / file.name
    write(path, bands, file)
    assert path.read_bytes()[2] == (43 if is_big else 42)
    assert_valid(path)
    for level in range(len(factors(*shape))):
        options = {"overview_level": level - 1} if level else {}
        bands = halved(bands) if level else bands
        with rasterio.open(path, **options) as dataset:
            np.testing.assert_array_equal(dataset.read(), bands)
            assert dataset.block_shapes[0] == (BLOCK, BLOCK)
            assert dataset.interleaving == Interleaving.band
            np.testing.assert_equal(dataset.nodata, file.nodata)
    with rasterio.open(path) as dataset:
        assert (dataset.tags()["ALPHA"], dataset.tags(1)["meaning"]) == ("0.9", file.bands[0].meaning)
        assert Georeferencing.of(dataset) == PLACE


def test_halved__is_the_mean_of_what_is_known_and_every_other_flag():
    values = np.array([[1, 2, np.nan], [5, 4, np.nan], [np.nan, 7, 8]], np.float32)
    np.testing.assert_array_equal(halved(values[np.newaxis])[0], [[3, np.nan], [np.nan, np.nan]])
    flags = np.arange(15, dtype=np.uint16).reshape(1, 3, 5)
    np.testing.assert_array_equal(halved(flags), flags[:, ::2, ::2])


def test_assemble__with_zstd(tmp_path):
    for file, shape in zip(run_files("zstd"), [(513, 40), (40, 30)], strict=True):
        bands, path = noise(file, *shape), tmp_path / file.name
        write(path, bands, file)
        assert_valid(path)
        with rasterio.open(path) as dataset:
            assert dataset.profile["compress"] == "zstd"
            np.testing.assert_array_equal(dataset.read(), bands)


def test_assemble__gives_the_same_bytes_whatever_the_order(tmp_path):
    bands = noise(INTERVALS, 1100, 40)
    write(tmp_path / "a.tif", bands, INTERVALS)
    write(tmp_path / "b.tif", bands, INTERVALS, order=random.Random(1))
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()


def test_assemble__has_the_tags_of_gdals_own_driver(tmp_path):
    bands, place = noise(VALIDITY, 600, 700), north_up(32631, 3e5, 4.8e6, 0.5)
    write(tmp_path / "ours.tif", bands, VALIDITY, place)
    options = {"count": 1, "dtype": "uint16", **place.creation_options()}
    with rasterio.open(tmp_path / "plain.tif", "w", driver="GTiff", height=600, width=700, **options) as plain:
        VALIDITY.describe(plain, {"ALPHA": "0.9"})
        plain.write(bands)
    driver = {"driver": "COG", "compress": "DEFLATE", "overview_resampling": "NEAREST"}
    rasterio.shutil.copy(tmp_path / "plain.tif", tmp_path / "theirs.tif", **driver)
    with rasterio.open(tmp_path / "ours.tif") as ours, rasterio.open(tmp_path / "theirs.tif") as theirs:
        assert ours.profile == theirs.profile
        for of_band in ((), (1,)):
            for domain in (None, "IMAGE_STRUCTURE"):
                assert ours.tags(*of_band, ns=domain) == theirs.tags(*of_band, ns=domain) | (
                    {} if domain or of_band else {"ALPHA": "0.9"}
                )


@pytest.mark.parametrize("rows", [100, 512, 1100])
def test_stream__makes_the_parts_of_any_strips(tmp_path, rows):
    bands = noise(INTERVALS, 1100, 40)
    stream = Stream(INTERVALS, tmp_path, bands.shape[1:])
    for row in range(0, 1100, rows):
        stream.write(bands[:, row : row + rows])
    expected = parts_of(bands, INTERVALS)
    for found, wanted in zip(stream.parts, expected, strict=True):
        assert [part.sizes for part in found] == [part.sizes for part in wanted]
    made = template(INTERVALS, PLACE, {"ALPHA": "0.9"})
    assemble(tmp_path / "a.tif", made, bands.shape[1:], stream.parts, stream.copy_parts)
    assemble(tmp_path / "b.tif", made, bands.shape[1:], expected, copy_parts)
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()
    stream.close()
    assert {path.name for path in tmp_path.iterdir()} == {"a.tif", "b.tif"}


def test_codec_versions__follow_the_bytes_of_blocks(monkeypatch):
    before = codec_versions("deflate")
    monkeypatch.setitem(blocks._LEVELS, "deflate", {"zlevel": 9})
    assert codec_versions("deflate") == before  # once a process
    codec_versions.cache_clear()
    assert codec_versions("deflate")["codec"] != before["codec"]
    codec_versions.cache_clear()
