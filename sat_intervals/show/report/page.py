"""Fill the template of the page with style, script and contents."""

import json
import re
import shlex
from collections.abc import Mapping
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from sat_intervals.evaluate.disparity import evaluate_run
from sat_intervals.raster import read_place, read_small_layers
from sat_intervals.raster.publishing import write_file
from sat_intervals.results import Results
from sat_intervals.show.legend import class_counts, classes_of
from sat_intervals.show.report.contents import Histograms, Pixels

_CELLS = 1000  # rows and columns of a surface that are read


def write_report(results: Results) -> Path:
    """Write ``report.html`` into the folder of a run and return its path; holds one strip of rows in memory."""
    path = results.out / "report.html"
    results.check_kept([path], [results.truth.image.path if results.truth else None])
    write_file(path, _page(_contents(results)).encode())
    return path


def _page(contents: Mapping[str, Any]) -> str:
    # A "<" in the contents could end the script element.
    data = json.dumps(contents, separators=(",", ":")).replace("<", "\\u003c")
    script = "".join(map(_asset, ("draw.js", "explore.js", "tables.js")))
    title = f"{contents['quantity']['name'].capitalize()} intervals"
    parts = {
        "title": title,
        "summary": _summary(contents),
        "style": _asset("report.css"),
        "script": script,
        "contents": data,
    }
    return re.sub(rf"/\* ({'|'.join(parts)}) \*/", lambda found: parts[found[1]], _asset("report.html"))


def _asset(name: str) -> str:
    return (resources.files("sat_intervals.show.report") / name).read_text(encoding="utf-8")


def _contents(results: Results) -> dict[str, Any]:
    """Return all data of the page."""
    histograms, pixels = Histograms(results), Pixels(results)
    for row, bands in results.strips():
        low = results.low(bands)
        histograms.add(bands, low)
        pixels.add(row, bands, low)
    truth = results.truth.image.path if results.truth else None
    run, name = results.report, Path(results.left.path).name
    if results.is_sweep:  # steps of height are no disparities
        settings = {section: values for section, values in run["settings"].items() if section != "disparity"}
        inputs = {key: one for key, one in run["inputs"].items() if key not in ("left", "right")}
        run, name = run | {"settings": settings, "inputs": inputs}, f"{len(results.images)} images"
    return {
        "run": run,
        "quantity": results.quantity._asdict(),
        "name": name,
        "folder": shlex.quote(str(results.out.resolve())),
        "histograms": histograms.report(),
        "classes": class_counts(results.report["counts"]),
        "pixels": pixels.report(),
        "truth": truth,
        "surface": _surface(results),
        "evaluation": evaluate_run(results.out, truth) if truth and results.config.interval else None,
    }


def _surface(results: Results) -> dict[str, Any] | None:
    """Return figures of the surface model of a run, None without one: metres and shares, from its overviews."""
    if not results.has_current("dsm.tif"):
        return None
    (rows, columns), place = read_place(results.out / "dsm.tif")
    small = -(-rows // max(1, rows // _CELLS)), -(-columns // max(1, columns // _CELLS))
    height, lower, upper = read_small_layers(results.out / "dsm.tif", small)[:3].astype(np.float64)
    known, halves = np.isfinite(height), (upper - lower)[np.isfinite(lower)] / 2
    low, middle, high = np.percentile(height[known], (2, 50, 98)) if known.any() else [float("nan")] * 3
    figures = {
        "surface model": f"{rows} x {columns} cells of {place.pixel_size[0]:g} m",
        "cells with a height": f"{100 * known.mean():.1f} %",
        "heights, 2 %, median, 98 %": f"{low:.2f}, {middle:.2f}, {high:.2f} m",
    }
    if halves.size:
        median, most = np.percentile(halves, (50, 90))
        figures["half widths of intervals, median and 90 %"] = f"{median:.2f} m, {most:.2f} m"
    return figures


def _rows(run: Mapping[str, Any]) -> dict[str, str]:
    """Return what the rows of the two images differ by, if they were compared."""
    found = (run.get("survey") or {}).get("rows")
    if not found:
        return {}
    left = f", {found['after'][0]:.2f} px after they were moved" if run.get("rows") else ""
    return {"rows of the two images differ by": f"{found['before'][0]:.2f} px in the median{left}"}


def _summary(contents: Mapping[str, Any]) -> str:
    """Return the main figures of a run as rows of an HTML table, for browsers without scripts."""
    run, counts = contents["run"], contents["run"]["counts"]
    region = run["tiles"]["region"]
    search = contents["quantity"]
    width = counts["median_interval_width"]
    swept, unit = "sweep" in run, search["unit"]
    form = ".2f" if swept else ".6g"
    images = ", ".join(one["path"] for one in run["sweep"]["images"]) if swept else run["inputs"]["left"]["path"]
    rows = {
        "images" if swept else "left image": images,
        "size": f"{region['height']} x {region['width']} pixels",
        "search range": f"{search['minimum']:{form}} to {search['maximum']:{form}} {unit}",
        "verdict": run["verdict"],
        **{f"warning {number}": line for number, line in enumerate(run["warnings"], start=1)},
        **_rows(run),
        "median interval width": "none" if width is None else f"{width * search['step']:{form}} {unit}",
    }
    for kind, count in zip(classes_of(run), contents["classes"], strict=True):
        if count:
            rows[kind.meaning] = f"{100 * count / counts['pixels']:.1f} % of the pixels"
    accuracy = contents["evaluation"] and contents["evaluation"]["all"]["accuracy"]
    if accuracy is not None:
        rows["intervals that contain the truth"] = f"{100 * accuracy:.1f} % of the valid pixels with a truth"
    rows |= contents["surface"] or {}
    return "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows.items())
