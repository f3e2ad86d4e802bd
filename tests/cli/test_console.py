"""What a command prints at its end."""

import os

from finished import random_bands, write_run

from sat_intervals.cli.console import Console
from sat_intervals.results import open_run

COUNTS = {"pixels": 200, "valid": 150, "median_interval_width": 2.5}


def test_batch_summary__shows_surfaces_of_the_pairs_that_have_one(capsys):
    surface = {"filled": 0.876, "median_half_width": 1.25}
    report = {
        "a": {"state": "done", "counts": COUNTS, "surface": surface, "warnings": ["rows"]},
        "b": {"state": "done", "counts": COUNTS, "surface": surface | {"median_half_width": None}},
        "c": {"state": "failed", "counts": COUNTS, "error": "no model"},
    }
    Console(quiet=False).batch_summary(report)
    head, *rows = (line.split() for line in capsys.readouterr().out.splitlines())
    assert head == ["pair", "state", "valid", "median", "width", "filled", "median", "half", "width", "warnings"]
    assert rows == [
        ["a", "done", "75.0", "%", "2.50", "px", "87.6", "%", "+-1.25", "m", "1"],
        ["b", "done", "75.0", "%", "2.50", "px", "87.6", "%", "0"],
        ["c", "failed", "75.0", "%", "2.50", "px", "0"],
    ]
    Console(quiet=False).batch_summary({"c": report["c"]})
    assert "filled" not in capsys.readouterr().out


def test_summary__names_the_files_of_an_earlier_run(tmp_path, capsys):
    out = write_run(tmp_path, *random_bands(20, 30)[:2])
    for name, seconds in (("points.tif", -5), ("dsm.tif", 5), ("notes.txt", -5)):
        (out / name).touch()
        os.utime(out / name, ns=2 * ((out / "run.json").stat().st_mtime_ns + seconds * 10**9,))
    Console(quiet=False).summary(open_run(out).report, out)
    assert capsys.readouterr().out.endswith("of an earlier run: points.tif: make them again\n")
