"""Keep the CRC-32 of a small file of this tool in its first lines: settings, pages, styles, pictures and others."""

import re
import struct
import zlib

ROOM = "CRC-32 00000000"
"""Text near the beginning of a file that `sealed` gives the CRC-32; in a picture it is the end of a chunk."""

_SEAL = re.compile(rb"CRC-32 ([0-9a-f]{8})")
_BEGINNING = 1024  # bytes that have the text


def sealed(content: bytes) -> bytes:
    """Return the content of a file with ROOM in its first kilobyte, with its CRC-32."""
    return _with(content, b"%08x" % zlib.crc32(content))


def is_as_made(content: bytes) -> bool | None:
    """Return whether the content of a file agrees with the CRC-32 in it; None without one."""
    if not (seal := _SEAL.search(content, 0, _BEGINNING)):
        return None
    return zlib.crc32(_with(content, b"0" * len(seal[1]))) == int(seal[1], 16)


def _with(content: bytes, digits: bytes) -> bytes:
    """Return a content with other digits in its seal; a chunk of PNG that has them is followed by its own CRC-32."""
    seal = _SEAL.search(content, 0, _BEGINNING)
    assert seal
    start, end = seal.span(1)
    head, tail = content[:start] + digits, content[end:]
    if content.startswith(b"\x89PNG"):
        chunk = head[head.rfind(b"tEXt") :]
        tail = struct.pack(">I", zlib.crc32(chunk)) + tail[4:]
    return head + tail
