"""The page itself: a template of the package, with its style, its script and its contents put into it."""

import json
import shlex
from importlib import resources
from pathlib import Path
from typing import Any

from sat_intervals.errors import SatIntervalsError
from sat_intervals.evaluate.disparity import evaluate_run
from sat_intervals.raster import whole_file
from sat_intervals.results import Results
from sat_intervals.show.report.contents import Counts, Pixels


def write_report(results: Results) -> Path:
    """Write ``report.html`` into the folder of a run; memory follows a strip of rows, whatever the size of the images.

    Returns
    -------
    The file, of a few megabytes at most.

    Raises
    ------
    SatIntervalsError
        Rows that cannot be read, or a file that cannot be written.
    """
    path = results.out / "report.html"
    results.check_kept([path], [results.truth.image.path if results.truth else None])
    # Inside a script element a "<" of the contents could be taken for its end.
    contents = json.dumps(_contents(results), separators=(",", ":")).replace("<", "\\u003c")
    page = _asset("report.html")
    script = "".join(map(_asset, ("draw.js", "explore.js", "tables.js")))
    for name, text in (("style", _asset("report.css")), ("script", script), ("contents", contents)):
        page = page.replace(f"/* {name} */", text)
    try:
        with whole_file(path) as new:
            new.write_text(page, encoding="utf-8")
    except OSError as error:
        raise SatIntervalsError(f"{path} cannot be written: {error.strerror}: make room or check its rights") from error
    return path


def _asset(name: str) -> str:
    return (resources.files("sat_intervals.show.report") / name).read_text(encoding="utf-8")


def _contents(results: Results) -> dict[str, Any]:
    """All that the script of the page shows."""
    counts, pixels = Counts(results.config.disparity.count), Pixels(results)
    for row, bands in results.strips():
        low = results.low(bands)
        counts.add(bands, low)
        pixels.add(row, bands, low)
    truth = results.truth.image.path if results.truth else None
    return {
        "run": results.report,
        "name": Path(results.left.path).name,
        "folder": shlex.quote(str(results.out.resolve())),
        "histograms": counts.report(),
        "pixels": pixels.report(),
        "truth": truth,
        "evaluation": evaluate_run(results.out, truth) if truth and results.config.interval else None,
    }
