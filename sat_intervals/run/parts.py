"""Files as parts: rows of blocks that workers make and compress, their overviews, and copies of them in the files."""

import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.config import Cluster
from sat_intervals.errors import RunError
from sat_intervals.kernels import FINGERPRINT
from sat_intervals.match import postprocess, refinement
from sat_intervals.prepare.pair import Rows
from sat_intervals.progress import Progress
from sat_intervals.raster import BLOCK, File, OutputWriter, Part, codec_versions, compressed, factors, halved
from sat_intervals.run.workers import Task, Threads, Workers, computing, results
from sat_intervals.store.manifest import digest
from sat_intervals.store.tiles import PARTS, Store
from sat_intervals.tiling import Window

PartKey = tuple[int, int]
"""Level of a file, 0 for its pixels, and row of blocks from the top."""

# What finishes rows decides their bytes, too. The number increases when parts change.
_CODE = *(zlib.crc32(Path(str(module.__file__)).read_bytes()) for module in (postprocess, refinement)), 4
_HALF = "half of {}"
_THREADS = 2  # that copy parts which workers cannot copy: one reads while another writes


@dataclass(frozen=True)
class Parts:
    """Files of one size whose parts are in a store; picklable. ``run`` and ``codecs`` decide their bytes."""

    store: Store
    files: tuple[File, ...]
    shape: tuple[int, int]
    run: str
    codecs: dict[str, Any]
    cluster: Cluster

    @property
    def of(self) -> str:
        """Return what the parts belong to: those of other runs or codecs are made again."""
        return digest({"run": self.run, "codecs": self.codecs})

    @property
    def rows(self) -> list[int]:
        """Return the number of rows of blocks of each level."""
        return [-(-self.shape[0] // (factor * BLOCK)) for factor in factors(*self.shape)]

    def check(self) -> None:
        """Raise if this process, a worker, makes other bytes than the command."""
        if (here := codecs_of(self.files)) != self.codecs:
            raise RunError(
                f"this worker compresses with {here}, the command with other versions: install the same versions of "
                "sat-intervals and rasterio for all"
            )

    def read(self, key: PartKey, names: Sequence[str]) -> list[np.ndarray]:
        """Read arrays of a part; delete it and raise DamagedTilesError if it is damaged or missing."""
        if (arrays := self.store.read(PARTS, part_name(key), names, self.of)) is None:
            raise self.store.damaged(PARTS, [part_name(key)], self.of)
        return arrays

    def window(self, key: PartKey) -> Window:
        """Return the pixels that a part is made of."""
        level, row = key
        return Window(BLOCK * row << level, 0, BLOCK << level, self.shape[1]).clipped(Window(0, 0, *self.shape))


def codecs_of(files: Sequence[File]) -> dict[str, Any]:
    """Return what decides the bytes of parts in this process, beside the run."""
    code = {"version": version("sat-intervals"), "kernels": FINGERPRINT, "code": _CODE}
    return codec_versions(files[0].compression) | code


def part_name(key: PartKey) -> str:
    """Return the name of a part's file."""
    return f"{key[0]}_{key[1]}"


def finish_parts(
    parts: Parts,
    workers: Workers,
    row: Callable[[Window], tuple[Callable[..., Rows], tuple[Any, ...]]],
    failed: Callable[[Window], str],
    stage: str,
    progress: Progress,
) -> dict[PartKey, dict[str, Any]]:
    """Make the parts that are missing; return ``meta`` of all.

    ``row`` returns function and arguments that make the rows of a window; ``failed`` says which could not be made.
    """
    counts, store, of = parts.rows, parts.store, parts.of
    keys = [(level, row) for level in reversed(range(len(counts))) for row in range(counts[level])]
    done = {key for key in keys if store.meta(PARTS, part_name(key), of)}
    waiting = [key for key in keys if key not in done]

    def tasks() -> Iterator[Task | None]:
        while waiting:
            ready = (key for key in waiting if all(below in done for below in _below(key, counts)))
            if (key := next(ready, None)) is None:
                yield None
            else:
                waiting.remove(key)
                below = _below(key, counts)
                function, arguments = (reduce_rows, (parts, below)) if below else row(parts.window(key))
                yield Task(key, make_part, (parts, key, function, arguments), parts.cluster.retries)

    def look(_: int = 0) -> None:
        progress(stage, min(parts.shape[0], BLOCK * sum(level == 0 for level, _ in done)), parts.shape[0])

    look()
    for key, _ in results(workers, tasks(), lambda key: failed(parts.window(key)), look) if waiting else ():
        done.add(key)
    found = {key: meta for key in keys if (meta := store.meta(PARTS, part_name(key), of)) is not None}
    if missing := [part_name(key) for key in keys if key not in found]:
        raise store.damaged(PARTS, missing, of)
    return found


def _below(key: PartKey, counts: Sequence[int]) -> list[PartKey]:
    """Return the one or two rows of the level below that a row of an overview is made of."""
    level, row = key
    return [(level - 1, below) for below in (2 * row, 2 * row + 1) if level and below < counts[level - 1]]


def make_part(parts: Parts, key: PartKey, function: Callable[..., Rows], arguments: tuple[Any, ...]) -> None:
    """Make a part with a function; runs on a worker."""
    # also while it reads and writes: more strips at once would need more memory than `check_tiles` allows for
    with computing(parts.cluster):
        parts.check()
        rasters, noted = function(*arguments)
        write_part(parts, key, rasters, **noted)


def reduce_rows(parts: Parts, below: Sequence[PartKey]) -> Rows:
    """Make a row of blocks of an overview from parts of the level below."""
    names = [_HALF.format(file.name) for file in parts.files]
    halves = [parts.read(key, names) for key in below]
    return [np.concatenate(of_file, axis=1) for of_file in zip(*halves, strict=True)], {}


def write_part(parts: Parts, key: PartKey, rasters: list[np.ndarray], **meta: Any) -> None:
    """Write a part; ``rasters``, ``(bands, rows, columns)`` of each file, are emptied on the way, to save memory."""
    blocks: dict[str, list[int]] = {}
    is_top = key[0] + 1 == len(parts.rows)

    def arrays() -> Iterator[tuple[str, np.ndarray]]:
        for file in parts.files:
            raster = rasters.pop(0)
            made = compressed(raster, file)
            blocks[file.name] = made.sizes
            yield file.name, np.frombuffer(made.content, np.uint8)
            del made
            if not is_top:
                yield _HALF.format(file.name), halved(raster)

    parts.store.write(PARTS, part_name(key), arrays(), of=parts.of, blocks=blocks, **meta)


def copy_parts(
    parts: Parts,
    metas: Mapping[PartKey, Mapping[str, Any]],
    writer: OutputWriter,
    workers: Workers | None,
    progress: Progress,
) -> None:
    """Copy finished parts into the files, on workers that share their folder, else (None) in this process."""
    copied: list[Any] = []

    def look(_: int) -> None:
        progress("files", len(copied), len(parts.files) * len(metas))

    with nullcontext(workers) if workers else closing(Threads(_THREADS)) as copiers:

        def copy(final: Path, path: Path, of_file: Iterable[tuple[int, Part]]) -> None:
            tasks = (
                Task(part.source, copy_part, (parts, *part.source, path.absolute(), offset), parts.cluster.retries)
                for offset, part in of_file
            )
            for source, _ in results(copiers, tasks, lambda _: f"{final} could not be written", look):
                copied.append(source)

        look(0)
        for file in parts.files:
            levels = [
                [Part(metas[level, row]["blocks"][file.name], ((level, row), file.name)) for row in range(count)]
                for level, count in enumerate(parts.rows)
            ]
            writer.assemble(file, levels, partial(copy, writer.folder / file.name))


def copy_part(parts: Parts, key: PartKey, name: str, path: Path, offset: int) -> None:
    """Write a part into a file at an offset; runs on a worker."""
    parts.check()
    (content,) = parts.read(key, [name])
    # not for reading: NFS would write whole pages, over bytes of the neighbours
    with open(os.open(path, os.O_WRONLY), "wb") as stream:
        stream.seek(offset)
        stream.write(content.data)
        stream.flush()
        os.fsync(stream.fileno())
