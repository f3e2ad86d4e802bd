"""Input files: their identity, on a web server too, and those that a raster is read from."""

import gzip
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
import zipfile
from http.server import ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import rasterio
from helpers import COMMAND, OUTPUTS, PLACE, ended, hashes

from sat_intervals import match_pair
from sat_intervals.demo import make_scene
from sat_intervals.errors import ChangedInputError, SatIntervalsError
from sat_intervals.raster import describe, files_of, open_image, write_layer
from sat_intervals.raster.identity import check_not_replaced, identity
from sat_intervals.tiling import Window

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SIDE = 1024


@pytest.fixture(scope="module")
def images() -> dict[str, bytes]:
    """Content of left.tif and right.tif, tiled, not compressed."""
    scene = make_scene(SIDE, SIDE, seed=5)
    profile = {"driver": "GTiff", "height": SIDE, "width": SIDE, "count": 1, "dtype": "uint16", "nodata": 0}
    profile |= {"tiled": True, "blockxsize": 128, "blockysize": 128, "crs": "EPSG:32631"}
    content = {}
    for side in ("left", "right"):
        with rasterio.MemoryFile() as memory:
            with memory.open(**profile, transform=rasterio.Affine(0.5, 0, 0, 0, -0.5, 0)) as file:
                file.write(getattr(scene, side), 1)
            content[f"{side}.tif"] = memory.read()
    return content


def mask_of(side: int) -> bytes:
    """A mask file without a pixel to leave out."""
    with rasterio.MemoryFile() as memory:
        profile = {"driver": "GTiff", "height": side, "width": side, "count": 1, "dtype": "uint8"}
        with memory.open(**profile, crs="EPSG:32631", transform=rasterio.Affine(0.5, 0, 0, 0, -0.5, 0)) as file:
            file.update_tags(INTERNAL_MASK_FLAGS_1=2)  # for all bands
            file.write(np.full((side, side), 255, np.uint8), 1)
        return bytes(memory.read())


def put(images: dict[str, bytes], folder: Path) -> None:
    for name, content in images.items():
        (folder / name).write_bytes(content)


def match(server: ThreadingHTTPServer, out: Path, *options: str, prefix: str = "") -> subprocess.Popen:
    address = f"{prefix}http://127.0.0.1:{server.server_address[1]}"
    command = [COMMAND, "match", f"{address}/left.tif", f"{address}/right.tif", out, "--disparity", "-18", "40"]
    command += ["--set", "tiles.overlap=20", "--quiet", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@pytest.mark.parametrize("prefix", ["", "/vsicurl/"])
def test_match__reads_windows_of_images_on_a_web_server(web_server, images, tmp_path, prefix):
    put(images, web_server.folder)
    window = "--window", "512", "384", "128", "128"
    assert ended(match(web_server, tmp_path / "remote", *window, prefix=prefix)) == (0, "")
    for name, content in images.items():
        sent = [count for file, count in web_server.sent if file == name]
        assert max(sent) < len(content) / 8
        assert sum(sent) < len(content) / 2, name  # read for the survey, the tiles and the strip
    options = {"disparity": {"minimum": -18, "maximum": 40}, "tiles": {"overlap": 20}}
    local = web_server.folder / "left.tif", web_server.folder / "right.tif", tmp_path / "local", options
    match_pair(*local, window=Window(512, 384, 128, 128))
    assert hashes(tmp_path / "remote") == hashes(tmp_path / "local")


def test_match__never_goes_on_with_an_image_of_another_etag(web_server, images, tmp_path):
    put(images, web_server.folder)
    out, tiles = tmp_path / "out", ("--tile-size", "128")
    first = match(web_server, out, *tiles)
    while first.poll() is None and len(list((out / "tiles").glob("[!.]*/[0-9]*_[0-9]*"))) < 3:
        time.sleep(0.02)
    first.terminate()
    assert ended(first)[0] == 143
    changed = bytearray(images["right.tif"])
    changed[-1] ^= 1
    put({"right.tif": bytes(changed)}, web_server.folder)
    status, output = ended(match(web_server, out, *tiles))
    assert status == 1
    tags = [hashlib.sha256(content).hexdigest() for content in (images["right.tif"], changed)]
    assert "holds the tiles of another run: inputs.right.etag was " in output
    assert output.index(tags[0]) < output.index(tags[1])
    put(images, web_server.folder)
    assert ended(match(web_server, out, *tiles)) == (0, "")
    assert sorted(path.name for path in out.iterdir()) == [".sat-intervals.lock", *OUTPUTS]


def test_identity__hashes_a_local_file_unless_size_and_time_are_known(tmp_path, monkeypatch):
    file = tmp_path / "image.tif"
    file.write_bytes(b"one")
    os.utime(file, ns=(0, 1_700_000_000_123_456_789))
    (tmp_path / "link.tif").symlink_to(file)
    before = identity(str(tmp_path / "link.tif"))
    assert before == {
        "path": str(file),
        "bytes": 3,
        "modified": "2023-11-14T22:13:20.123456789+00:00",
        "sha256": hashlib.sha256(b"one").hexdigest(),
    }
    with monkeypatch.context() as patch:
        patch.setattr(hashlib, "file_digest", None)
        assert identity(str(file), {str(file): before}) == before
    file.write_bytes(b"two")
    os.utime(file, ns=(0, 1_700_000_000_123_456_790))
    after = identity(str(file), {str(file): before})
    assert {name for name in before if after[name] != before[name]} == {"sha256", "modified"}


def test_identity__of_a_file_in_an_archive_is_that_of_the_archive(tmp_path):
    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        archive.writestr("left.tif", "content")
    name = f"/vsizip/{tmp_path}/all.zip/left.tif"
    assert identity(name) == identity(str(tmp_path / "all.zip")) | {"path": name}


def test_describe__says_what_decides_the_pixels(tmp_path):
    write_layer(tmp_path / "left.tif", np.ones((4, 5), np.uint16), 0, PLACE)
    write_layer(tmp_path / "mask.tif", np.zeros((4, 5), np.uint8), 0, PLACE)
    (tmp_path / "left.tif.msk").write_bytes(mask_of(4))
    image = open_image(tmp_path / "left.tif", mask=tmp_path / "mask.tif", nodata=7)
    described = describe(image)
    mask = identity(str(tmp_path / "mask.tif")) | {"files": []}
    assert described == identity(str(tmp_path / "left.tif")) | {
        **{"height": 4, "width": 5, "band": 1, "dtype": "uint16", "nodata": "7.0", "crs": "EPSG:32631", "alpha": None},
        **{"files": [identity(str(tmp_path / "left.tif.msk"))], "use_mask": True, "mask": mask},
    }
    known = {file["path"]: file | {"sha256": "known"} for file in (described, *described["files"], mask)}
    again = describe(image, known)
    assert {file["sha256"] for file in (again, again["mask"], *again["files"])} == {"known"}


@pytest.mark.parametrize("damage", ["missing", "damaged"])
def test_describe__names_an_image_that_cannot_be_read_any_more(tmp_path, damage):
    write_layer(tmp_path / "left.tif", np.ones((4, 5), np.uint16), 0, PLACE)
    image = open_image(tmp_path / "left.tif")
    (tmp_path / "left.tif").unlink()
    if damage == "damaged":
        (tmp_path / "left.tif").write_text("no image")
    with pytest.raises(ChangedInputError, match=r"left\.tif cannot be read: .*: restore"):
        describe(image)


@pytest.mark.parametrize("way", ["itself", "symbolic link", "folder", "archive"])
def test_check_not_replaced__refuses_an_output_that_is_an_input(tmp_path, way):
    (tmp_path / "in").mkdir()
    file, output = tmp_path / "in" / "left.tif", tmp_path / "out.tif"
    file.write_text("content")
    if way == "symbolic link":
        output.symlink_to(file)
    name = f"/vsizip/{file}/left.tif" if way == "archive" else file
    outputs, folders = [file if way in ("itself", "archive") else output], [tmp_path / "in"] if way == "folder" else []
    with pytest.raises(SatIntervalsError, match=r"left\.tif is an input"):
        check_not_replaced([None, "https://host/left.tif", name], outputs, folders)
    check_not_replaced([None, "https://host/left.tif", name], [tmp_path / "other.tif"], [tmp_path / "other"])


def test_match__ends_where_an_image_on_a_server_changes_and_publishes_nothing(web_server, images, tmp_path):
    put(images, web_server.folder)
    out = tmp_path / "out"
    run = match(web_server, out, "--tile-size", "128", "--workers", "1")
    while run.poll() is None and len(list((out / "tiles").glob("[!.]*/[0-9]*_[0-9]*"))) < 3:
        time.sleep(0.02)
    changed = bytearray(images["right.tif"])
    changed[-1] ^= 1
    put({"right.tif": bytes(changed)}, web_server.folder)
    status, output = ended(run)
    assert (status, output.count("\n")) == (1, 1)
    assert "right.tif" in output
    assert "changed during the run" in output
    assert [path.name for path in out.iterdir()] == [".sat-intervals.lock"]


@pytest.mark.parametrize("path", ["http://127.0.0.1:1/image.tif", "/vsimem/image.tif", "nowhere://image.tif"])
def test_identity__of_what_nobody_tells_more_of_is_its_name(path):
    assert identity(path) == {"path": path}


def test_identity__of_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ChangedInputError, match=r"left\.tif cannot be read: it is missing, a folder"):
        identity(str(tmp_path / "left.tif"))


OPENED = """import json, sys
from sat_intervals.raster import describe, open_image
described = describe(open_image(sys.argv[1]))
print(json.dumps([described["use_mask"], described, *described["files"]]))"""


def opened(name):
    """Whether an image has a mask, and the identities of its files; in a process, since GDAL holds Python's lock."""
    done = subprocess.run([sys.executable, "-c", OPENED, name], capture_output=True, text=True, timeout=60, check=True)
    return json.loads(done.stdout)


def test_open_image__counts_each_file_on_a_server_once(web_server, images):
    put({**images, "left.tif.msk": mask_of(SIDE), "left.tif.ovr": images["right.tif"]}, web_server.folder)
    name = f"http://127.0.0.1:{web_server.server_address[1]}/left.tif"
    has_mask, *files = opened(name)
    assert has_mask
    assert [file["path"] for file in files] == [name, f"/vsicurl/{name}.msk"]  # overviews are no input
    assert [file["bytes"] for file in files] == [len(images["left.tif"]), len(mask_of(SIDE))]
    assert all(file["etag"] for file in files)


SIZE = 16
SOURCE = '<SourceFilename relativeToVRT="{}">{}</SourceFilename>'


def virtual(is_relative, name):
    """The text of a virtual raster of an image."""
    source = f"<SimpleSource>{SOURCE.format(is_relative, name)}<SourceBand>1</SourceBand></SimpleSource>"
    band = f'<VRTRasterBand dataType="UInt16" band="1">{source}</VRTRasterBand>'
    return f'<VRTDataset rasterXSize="{SIZE}" rasterYSize="{SIZE}">{band}</VRTDataset>'


@pytest.fixture
def folder(tmp_path):
    for name, dtype in (("image.tif", "uint16"), ("mask.tif", "uint8")):
        with rasterio.open(tmp_path / name, "w", "GTiff", SIZE, SIZE, 1, dtype=dtype) as file:
            file.write(np.ones((1, SIZE, SIZE), dtype))
    return tmp_path


def zipped(folder, name, *files):
    with zipfile.ZipFile(folder / f"{name}.zip", "w") as archive:
        for file in files:
            archive.write(folder / file, file)
    return f"/vsizip/{folder}/{name}.zip/{files[0]}"


def compressed(folder, file):
    (folder / f"{file}.gz").write_bytes(gzip.compress((folder / file).read_bytes()))
    return f"/vsigzip/{folder}/{file}.gz"


SOURCES = {
    "relative": lambda folder: (1, "image.tif"),
    "absolute": lambda folder: (0, folder / "image.tif"),
    "entity": lambda folder: (1, "image&#46;tif"),
    "in an archive": lambda folder: (0, zipped(folder, "image", "image.tif")),
    "compressed": lambda folder: (0, compressed(folder, "image.tif")),
}
FILES = {"in an archive": "image.zip", "compressed": "image.tif.gz"}


def local_files(name):
    """The local files behind the names of a raster's other files."""
    return {re.sub(r"^/vsi\w+/(.*\.(zip|gz)|.*).*", r"\1", file) for file in files_of(name)[1:]}


@pytest.mark.parametrize("spelling", SOURCES)
def test_files_of__a_virtual_raster_have_its_source_in_any_spelling(folder, spelling):
    (folder / "image.vrt").write_text(virtual(*SOURCES[spelling](folder)))
    name = str(folder / "image.vrt")
    assert files_of(name)[0] == name
    assert local_files(name) == {str(folder / FILES.get(spelling, "image.tif"))}


def test_files_of__virtual_rasters_of_virtual_rasters_have_all_sources_and_their_masks(folder):
    shutil.copy(folder / "mask.tif", folder / "image.tif.msk")
    (folder / "inner.vrt").write_text(virtual(1, "image.tif"))
    (folder / "outer.vrt").write_text(virtual(0, folder / "inner.vrt"))
    names = ["outer.vrt", "image.tif", "image.tif.msk", "inner.vrt"]
    assert files_of(str(folder / "outer.vrt")) == [str(folder / name) for name in names]


def test_files_of__have_no_overviews_and_statistics(folder):
    for name in ("image.tif.msk", "image.tif.msk.ovr", "image.tif.ovr"):
        shutil.copy(folder / "mask.tif", folder / name)
    (folder / "image.tif.aux.xml").write_text("<PAMDataset/>")
    assert files_of(str(folder / "image.tif")) == [str(folder / name) for name in ("image.tif", "image.tif.msk")]


def test_files_of__lists_the_source_of_a_mask_band(folder):
    mask = f'<VRTRasterBand dataType="Byte"><SimpleSource>{SOURCE.format(1, "mask.tif")}</SimpleSource></VRTRasterBand>'
    text = virtual(1, "image.tif").replace("</VRTDataset>", f"<MaskBand>{mask}</MaskBand></VRTDataset>")
    (folder / "masked.vrt").write_text(text)
    assert str(folder / "mask.tif") in files_of(str(folder / "masked.vrt"))
