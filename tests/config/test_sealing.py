from io import BytesIO

import pytest
import rasterio

from sat_intervals.config.sealing import ROOM, is_as_made, sealed


def picture():
    figure = pytest.importorskip("matplotlib.figure").Figure((1, 1))
    figure.savefig(stream := BytesIO(), format="png", metadata={"Software": f"sat-intervals, {ROOM}", "Comment": "run"})
    return stream.getvalue()


def text():
    return f"# {ROOM} of this file\nkey: value\n".encode() * 9


@pytest.mark.parametrize("make", [text, pytest.param(picture, marks=pytest.mark.peer("matplotlib"))])
def test_sealed__agrees_until_a_byte_changes(make):
    content = sealed(make())
    assert is_as_made(content)
    assert len(content) == len(make())
    changed = [place for place in range(len(content)) if is_as_made(_flipped(content, place))]
    assert not [place for place in changed if not _is_of_seal(content, place)]
    assert not is_as_made(content[:-1])
    assert not is_as_made(content + b"\n")


def _flipped(content, place):
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


def _is_of_seal(content, place):
    """The CRC-32 of the chunk is made again with the seal's; GDAL and others check it."""
    end = content.index(b"CRC-32 ") + len(ROOM)
    return content.startswith(b"\x89PNG") and end <= place < end + 4


def test_is_as_made__of_other_files_is_unknown():
    assert is_as_made(b"") is None
    assert is_as_made(b"key: value\n" * 200 + ROOM.encode()) is None


@pytest.mark.peer("matplotlib")
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_sealed__picture_can_be_read(tmp_path):
    (file := tmp_path / "a.png").write_bytes(sealed(picture()))
    with rasterio.open(file) as dataset:  # its chunks have checksums
        assert dataset.tags()["Software"].startswith("sat-intervals, CRC-32 ")
        assert dataset.read().shape == (4, 100, 100)
