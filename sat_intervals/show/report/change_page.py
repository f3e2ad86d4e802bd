"""Write ``report.html`` of a change of height."""

import base64
from html import escape
from pathlib import Path
from typing import Any

from sat_intervals.raster.publishing import write_file

_HEAD = """<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>Change of height</title>
<style>body { font: 15px sans-serif; margin: 2em } img { max-width: 100% }</style><h1>Change of height</h1>"""


def write_change_page(out: Path, report: dict[str, Any], lines: list[str]) -> Path:
    """Write the page of a folder of `change`: files, lines, and the map if `plot` has drawn it; return its path."""
    picture = out / "change.png"
    shown = "sat-intervals plot draws the map: then make this page again."
    if picture.exists() and picture.stat().st_mtime >= (out / "change.json").stat().st_mtime:
        shown = f'<img alt="map" src="data:image/png;base64,{base64.b64encode(picture.read_bytes()).decode()}">'
    told = (escape(line) for line in (f"{report['before']} to {report['after']}", *lines, *report["warnings"]))
    write_file(page := out / "report.html", "\n<p>".join([_HEAD, *told, f"{shown}</html>\n"]).encode())
    return page
