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

from sat_intervals.errors import RunError
from sat_intervals.kernels import FINGERPRINT
from sat_intervals.match import postprocess, refinement
from sat_intervals.progress import Progress
from sat_intervals.raster import BLOCK, File, OutputWriter, Part, codec_versions, compressed, factors, halved
from sat_intervals.run.workers import Task, Threads, Workers, picklable_errors, results
from sat_intervals.store.arrays import DamagedFileError
from sat_intervals.store.manifest import digest
from sat_intervals.store.tiles import PARTS, DamagedTilesError, Store

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
    retries: int

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

    def damaged(self, names: Sequence[str]) -> DamagedTilesError:
        """Delete parts; return the error that says that they must be made again."""
        self.store.delete(PARTS, names)
        return DamagedTilesError(
            f"parts {', '.join(names)} in {self.store.folder} are damaged or missing: rerun the same command: it makes "
            "them again"
        )


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
    row: Callable[[PartKey], tuple[Callable[..., str | None], tuple[Any, ...]]],
    failed: Callable[[PartKey], str],
    look: Callable[[int], None],
) -> dict[PartKey, dict[str, Any]]:
    """Make the parts that are missing; return ``meta`` of all.

    ``row`` returns function and arguments that write a row of blocks of the files and return None, or what is damaged;
    ``look`` is given the number of rows of blocks done.
    """
    counts, store, of = parts.rows, parts.store, parts.of
    keys = [(level, row) for level in reversed(range(len(counts))) for row in range(counts[level])]
    done = {key for key in keys if store.meta(PARTS, part_name(key), of)}
    waiting = [key for key in keys if key not in done]
    damaged: list[str] = []

    def tasks() -> Iterator[Task | None]:
        while waiting:
            ready = (key for key in waiting if all(below in done for below in _below(key, counts)))
            if (key := next(ready, None)) is None:
                yield None
            else:
                waiting.remove(key)
                function, arguments = (reduce_rows, (parts, key, _below(key, counts))) if key[0] else row(key)
                yield Task(key, function, arguments, parts.retries)

    def looked(_: int) -> None:
        look(sum(level == 0 for level, _ in done))

    for key, damage in results(workers, tasks(), failed, looked) if waiting else ():
        if damage is None:
            done.add(key)
        else:
            damaged.append(damage)  # the other strips are finished before tiles are matched again
    if damaged:
        raise DamagedTilesError(damaged[0])
    found = {key: meta for key in keys if (meta := store.meta(PARTS, part_name(key), of)) is not None}
    if missing := [part_name(key) for key in keys if key not in found]:
        raise parts.damaged(missing)
    return found


def _below(key: PartKey, counts: Sequence[int]) -> list[PartKey]:
    """Return the one or two rows of the level below that a row of an overview is made of."""
    level, row = key
    return [(level - 1, below) for below in (2 * row, 2 * row + 1) if level and below < counts[level - 1]]


def reduce_rows(parts: Parts, key: PartKey, below: Sequence[PartKey]) -> str | None:
    """Make a row of blocks of an overview from parts of the level below; return what is wrong if one is damaged."""
    with picklable_errors():
        parts.check()
        halves = []
        for part in map(part_name, below):
            try:
                with parts.store.opened(PARTS, part, parts.of) as archive:
                    halves.append([archive[_HALF.format(file.name)] for file in parts.files])
            except DamagedFileError:
                return str(parts.damaged([part]))
        write_part(parts, key, [np.concatenate(of_file, axis=1) for of_file in zip(*halves, strict=True)])
    return None


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
    copied: list[str | None] = []

    def look(_: int) -> None:
        progress("files", len(copied), len(parts.files) * len(metas))

    with nullcontext(workers) if workers else closing(Threads(_THREADS)) as copiers:

        def copy(final: Path, path: Path, of_file: Iterable[tuple[int, Part]]) -> None:
            tasks = (
                Task(part.source, copy_part, (parts, *part.source, path.absolute(), offset), parts.retries)
                for offset, part in of_file
            )
            for _, name in results(copiers, tasks, lambda _: f"{final} could not be written", look):
                copied.append(name)

        look(0)
        for file in parts.files:
            levels = [
                [Part(metas[level, row]["blocks"][file.name], ((level, row), file.name)) for row in range(count)]
                for level, count in enumerate(parts.rows)
            ]
            writer.assemble(file.name, levels, partial(copy, writer.folder / file.name))
    if damaged := sorted({name for name in copied if name}):
        raise parts.damaged(damaged)


def copy_part(parts: Parts, key: PartKey, name: str, path: Path, offset: int) -> str | None:
    """Write a part into a file at an offset; return its name if it is damaged or missing. Runs on a worker."""
    with picklable_errors():
        parts.check()
        try:
            with parts.store.opened(PARTS, part_name(key), parts.of) as archive:
                content = archive[name]
        except DamagedFileError:
            return part_name(key)
        # not for reading: NFS would write whole pages, over bytes of the neighbours
        with open(os.open(path, os.O_WRONLY), "wb") as stream:
            stream.seek(offset)
            stream.write(content.data)
            stream.flush()
            os.fsync(stream.fileno())
    return None
