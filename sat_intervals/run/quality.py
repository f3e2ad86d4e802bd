"""Tell what is odd about a run, by cause: no data, rows, search range, noise; and its verdict in one line."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sat_intervals.config import Config, Disparity, calibration_of, unreached
from sat_intervals.match.matching_cost import view_windows
from sat_intervals.match.parallax import Survey
from sat_intervals.match.patch import patch_areas
from sat_intervals.prepare.pair import is_plain
from sat_intervals.prepare.search_range import UNDECLARED, undeclared_lines
from sat_intervals.raster import Image, read_window
from sat_intervals.run.job import Job
from sat_intervals.run.source import frame_of
from sat_intervals.store.tiles import Tables
from sat_intervals.tiling import Window

# Disparities up to which refinement alone can widen an interval to all, and up to which usual ones are half of all.
_NARROW_RANGE, _SHORT_RANGE = 3, 8
# Share of valid pixels with the whole search range as interval above which a run warns.
_AMBIGUOUS_SHARE = 0.1
# Share of valid pixels at the ends of the search range above which a run warns, and at one end to search further there.
_AT_ENDS, _AT_END = 0.005, 0.001
# Rows that are looked at.
_ROWS = 8
# Share of windows that meet no data from which it is asked if it is isolated, and of valid pixels that are few.
_SPOILED, _FEW = 0.2, 0.2
# Times the usual width of intervals that are wide, and of those that a run warns of.
_WIDE, _TOO_WIDE = 2.0, 5.0
# Rows that make a pair badly resampled, and the distance of matches that makes it noisy.
_ROW_OFFSET, _NOISE = 1.0, 0.55


def quality_of(job: Job, tables: Tables) -> dict[str, Any]:
    """Return ``noise``; ``undeclared``, see `Found`; ``no_data``, shares by side; ``same``: of equal images."""
    if job.swept:
        return {"undeclared": {}, "same": False, "no_data": {}, "noise": None}
    looked = _look(job.left, job.right, job.store.grid.region) | {"no_data": _no_data(job, tables)}
    looked["undeclared"] |= job.prepared.search.undeclared if job.prepared.search else {}
    return looked | {"noise": job.prepared.survey and job.prepared.survey.noise}


def _look(left: Image, right: Image, region: Window) -> dict[str, Any]:
    """Return ``undeclared`` and ``same``, see `quality_of`, by some rows of both images."""
    sides = {"left": left, "right": right}
    lines = {side: _lines(image, region, _ROWS) for side, image in sides.items() if is_plain(image)}
    undeclared = {
        side: undeclared_border for side, of_side in lines.items() if (undeclared_border := _undeclared(*of_side))
    }
    (first, _), (second, state) = (_lines(image, region, 1) for image in sides.values())
    same = bool(first.size and (state == 0).any() and np.array_equal(first, second))
    return {"undeclared": undeclared, "same": same}


def doubts_of_images(left: Image, right: Image, looked: Mapping[str, Any] | None = None) -> list[str]:
    """Return warnings of equal images, and of no data that is not declared or, of a run, that no pixel is."""
    looked = looked or _look(left, right, Window(0, 0, max(left.height, right.height), max(left.width, right.width)))
    lines = undeclared_lines(looked["undeclared"], (left.path, right.path))
    if looked["same"]:
        lines.insert(0, f"{left.path} and {right.path} have the same pixels: give the left and the right image")
    given = [(side, image) for side, image in (("left", left), ("right", right)) if image.nodata_given]
    if given and "no_data" in looked and not any(looked["no_data"][side] for side, _ in given):
        path, nodata = given[0][1].path, given[0][1].nodata
        lines.append(f"{path}: no pixel that was read is {nodata:.9g}, the no-data value given: check it")
    return lines


def _no_data(job: Job, tables: Tables) -> dict[str, float]:
    """Return the share of pixels without data among those that tiles have read, by side."""
    read = Counter[str]()
    usable = Counter[str]()
    ranges = job.ranges()
    for tile in job.store.grid:
        windows = view_windows(patch_areas(frame_of(job, tile), job.config, ranges), job.config)
        for side, image, window in zip(("left", "right"), (job.left, job.right), windows, strict=True):
            inside = window.clipped(Window(0, 0, image.height, image.width))
            read[side] += inside.height * inside.width
            usable[side] += tables.records[tile.name]["usable_pixels"][side]
    return {side: 1 - usable[side] / read[side] if read[side] else 0.0 for side in ("left", "right")}


def _lines(image: Image, region: Window, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Read pixels and states of rows spread over a region of an image, one alone from its middle."""
    inside = region.clipped(Window(0, 0, image.height, image.width))
    places = np.linspace(inside.row, inside.row_stop - 1, count + 2 * (count == 1))
    rows = np.unique(places[1:-1] if count == 1 else places).astype(int)
    if inside.width <= 0:
        return np.empty((0, 2)), np.empty((0, 2))
    lines = (read_window(image, Window(int(row), inside.column, 1, inside.width)) for row in rows)
    pixels, state = (np.concatenate(parts) for parts in zip(*lines, strict=True))
    return pixels, state


def _undeclared(pixels: np.ndarray, state: np.ndarray) -> dict[str, float] | None:
    """Return value and share of the pixels that begin or end rows and have their commonest value, None if few do."""
    values, counts = np.unique(pixels[:, [0, -1]][state[:, [0, -1]] == 0], return_counts=True)
    if not values.size:
        return None
    value = values[counts.argmax()]
    has = (pixels == value) & (state == 0)
    runs = np.logical_and.accumulate(has, 1) | np.logical_and.accumulate(has[:, ::-1], 1)[:, ::-1]
    is_undeclared = runs.mean() > UNDECLARED
    return {"value": float(value), "share": round(float(runs.mean()), 4)} if is_undeclared else None


def warnings_of(job: Job, counts: Mapping[str, Any], quality: Mapping[str, Any]) -> list[str]:
    """Return the warnings about a run, one line each, the likeliest cause of all others first."""
    if job.swept:
        lines = [
            f"{path}: left out, since it is not like the other images on the ground: clouds, or another place"
            for path in job.swept.report["left_out"]
        ]
        return [*lines, *([f"{job.out}: {missed}"] if (missed := unreached(job.config)) else [])]
    paths = (job.left.path, job.right.path)
    config = job.config
    survey = job.prepared.survey
    of_data = [*doubts_of_images(job.left, job.right, quality), *_spoiled(job, counts, quality["no_data"]["left"])]
    rows = rows_left(survey, config.rows, job.right.path)
    was_found = job.prepared.search is not None
    of_range = _doubts_of_range(counts, config.disparity, paths[0], was_found=was_found)
    if (of_given := counts["agreement"])["outside"] > of_given["inside"]:
        of_data.append(
            f"{config.disparity.around}: {of_given['outside']} of {sum(of_given.values())} disparities are outside the "
            "intervals: check that x_right = x_left + disparity, and that it is of the left image"
        )
    if job.prepared.missed:
        of_pair = [f"{paths[0]} and {paths[1]}: {job.prepared.missed}"]
    elif of_data or (survey and survey.rows and survey.rows.contradiction):
        of_pair = rows
    else:  # where a given range is wrong, rows are, too
        of_pair = (
            _rejected(counts, paths)
            or ([] if was_found else of_range)
            or [*rows, *of_range]
            or _too_wide(counts, config, paths)
        )
    noise = noise_line(survey, paths) if config.cost.method == "census" and config.preset == "paper" else []
    missed = unreached(config)
    return [*of_data, *of_pair, *noise, *([f"{paths[0]}: {missed}"] if missed else [])]


def _spoiled(job: Job, counts: Mapping[str, Any], no_data: float) -> list[str]:
    """Return a warning of isolated pixels without data, a share of the left image, that spoil many windows."""
    spoiled = counts["causes"]["left_window"] / max(1, counts["pixels"])
    if spoiled <= _SPOILED or spoiled <= 3 * no_data:
        return []
    return [
        f"{job.left.path}: {100 * no_data:.1f} % of the pixels are no data or masked, but spoil the windows of "
        f"{100 * spoiled:.0f} %: they are isolated: fill them, or check no data and masks"
    ]


def _rejected(counts: Mapping[str, Any], paths: tuple[str, str]) -> list[str]:
    """Return a warning if cross-checking rejects more than it keeps."""
    rejected = counts["causes"]["occlusion"] + counts["causes"]["mismatch"]
    if rejected <= counts["valid"]:
        return []
    return [
        f"{paths[0]} and {paths[1]}: cross-checking rejected {100 * rejected / (rejected + counts['valid']):.0f} % of "
        "the matches: check that both images show the same place, the search range, and --altitude of raw ones"
    ]


def _doubts_of_range(counts: Mapping[str, Any], search: Disparity, path: str, *, was_found: bool) -> list[str]:
    """Return a warning if disparities or intervals reach the ends of the search range too often."""
    if ends := _ends(counts, search):
        return [f"{path}: {ends}" + ("" if was_found else ", or leave it out")]
    width = counts["median_interval_width"] or 0
    ambiguous = counts["ambiguous"] > _AMBIGUOUS_SHARE * counts["valid"] and search.count > _NARROW_RANGE
    if ambiguous or (2 * width > search.count and search.count > _SHORT_RANGE):
        return [
            f"{path}: the interval of {counts['ambiguous']} of {counts['valid']} valid pixels is the whole search "
            f"range {search.minimum} to {search.maximum}, the median width is {width:g} px: check the search range, "
            "or the ground has no texture"
        ]
    return []


def _too_wide(counts: Mapping[str, Any], config: Config, paths: tuple[str, str]) -> list[str]:
    """Return a warning if intervals are far wider than usual: the images have little in common, or no texture."""
    width, usual = counts["median_interval_width"], _usual_width(config)
    if width is None or usual is None or width <= _TOO_WIDE * usual:
        return []
    return [
        f"{paths[0]} and {paths[1]}: the median interval is {width:.1f} px wide, {usual:.1f} px on the calibration's "
        "pairs: little texture, or little in common, as before and after a change: try satellite-mccnn or other dates"
    ]


def verdict_of(counts: Mapping[str, Any], config: Config, warnings: Sequence[str]) -> str:
    """Return one line on a run: valid pixels, and if intervals are as wide as usual for its settings."""
    valid = f"{100 * counts['valid'] / max(1, counts['pixels']):.0f} % valid"
    if warnings:
        return f"{valid}, but see the warning{'s, the first one first' if len(warnings) > 1 else ''}"
    if counts["valid"] < _FEW * counts["pixels"]:
        worst = max(counts["causes"], key=counts["causes"].__getitem__).replace("_", " ")
        return f"only {valid}, most of the others by {worst}"
    width, usual = counts["median_interval_width"], _usual_width(config)
    if width is None or usual is None:
        return f"{valid}, nothing unusual"
    if width > _WIDE * usual:
        return f"{valid}, intervals wider than usual: median {width:.2f} px, {usual:.2f} px on the calibration's pairs"
    return f"{valid}, intervals usual for this preset"


def _usual_width(config: Config) -> float | None:
    """Return the median width in pixels that the pairs of a calibration had at the coverage of a run."""
    levels = config.cuts
    if levels is None or levels.coverage is None:
        return None
    expected = calibration_of(config).provenance.get("expected", ())
    found = [row["median_width"] for row in expected if row.get("coverage") == levels.coverage]
    return float(found[0]) if found else None


def noise_line(survey: Survey | None, paths: tuple[str, str]) -> list[str]:
    """Return a warning of a pair that is too noisy for the penalties of clean images."""
    if survey is None or (survey.noise or 0) <= _NOISE:
        return []
    return [
        f"{paths[0]} and {paths[1]}: matching pixels differ {survey.noise:.2f} times as much as random pixels, the "
        "pair is noisy: try --preset satellite"
    ]


def rows_left(survey: Survey | None, rows: str, path: str) -> list[str]:
    """Return warnings of rows that differ in what is matched."""
    if survey is None or survey.rows is None:
        return []
    found = survey.rows
    if found.contradiction:
        return [f"{path}: {found.contradiction}"]
    if rows == "none" and survey.is_large and found.before[0] > _ROW_OFFSET:
        return [f"{path}: rows differ by {found.before[0]:.1f} px in the median: match with --rows auto"]
    if found.has_jitter:
        return [
            f"{path}: {found.kind} leaves {found.after[0]:.2f} px of row offset in the median, "
            f"{found.after[1]:.2f} px in 90 % of the places: jitter or joins of detectors, or too little texture"
        ]
    return []


def _ends(counts: Mapping[str, Any], search: Disparity) -> str:
    """Return a line that names a wider range if many disparities are at the ends of the range, else nothing."""
    low, high = (counts["range_ends"][end] / max(1, counts["valid"]) for end in ("minimum", "maximum"))
    if low + high <= _AT_ENDS:
        return ""
    more = max(_SHORT_RANGE, search.count // 2)
    wider = search.minimum - more * (low > _AT_END), search.maximum + more * (high > _AT_END)
    return (
        f"{100 * (low + high):.1f} % of the valid disparities are within 1 px of {search.minimum} or {search.maximum}, "
        f"the ends of the search range: try --disparity {wider[0]} {wider[1]}"
    )
