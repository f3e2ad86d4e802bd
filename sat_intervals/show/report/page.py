"""Fill the template of the page with style, script and contents."""

import json
import re
import shlex
from collections.abc import Mapping
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from sat_intervals.evaluate.disparity import evaluate_run
from sat_intervals.raster.publishing import write_file
from sat_intervals.results import Results
from sat_intervals.show.legend import class_counts, classes_of
from sat_intervals.show.report.contents import Histograms, Pixels
from sat_intervals.show.report.surface import surface_of


def write_report(results: Results) -> Path:
    """Write ``report.html`` into the folder of a run and return its path; holds one strip of rows in memory."""
    path = results.out / "report.html"
    results.check_kept([path], [results.truth.image.path if results.truth else None])
    write_file(path, _page(_contents(results)).encode())
    return path


def _page(contents: Mapping[str, Any]) -> str:
    parts = {
        "title": f"{contents['quantity']['name'].capitalize()} intervals",
        "summary": _summary(contents),
        "style": _asset("report.css"),
        "script": "".join(map(_asset, ("draw.js", "explore.js", "tables.js"))),
        # A "<" in the contents could end the script element.
        "contents": json.dumps(contents, separators=(",", ":")).replace("<", "\\u003c"),
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
        "surface": surface_of(results),
        "evaluation": evaluate_run(results.out, truth) if truth and results.config.interval else None,
    }


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
    rows |= contents["surface"]["figures"] if contents["surface"] else {}
    return "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows.items())
