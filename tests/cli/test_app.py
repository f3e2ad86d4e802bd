"""The group of commands: pages of help, JSON, completion, the next command."""

import json
import os
import shlex
import subprocess

import pytest
from helpers import COMMAND, invoke, write_pair

from sat_intervals.cli.app import STEPS, main
from sat_intervals.demo import make_scene
from sat_intervals.results import open_run

# Commands that print figures.
WITH_JSON = (
    "batch", "calibrate", "change", "demo", "dsm", "evaluate", "match", "plan", "range", "rectify",
    "reference", "status", "surface", "triangulate",
)  # fmt: skip


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """The folder of a pair of 100 x 120 pixels."""
    folder = tmp_path_factory.mktemp("pair")
    write_pair(folder, make_scene(100, 120, seed=1))
    return folder


def test_main__alone_shows_commands_of_every_day_by_step():
    done = invoke()
    assert done.exit_code == 0
    lines = done.output.splitlines()
    steps = [line.rstrip(":") for line in lines if line.endswith(":")]
    assert steps == [*STEPS]
    shown = [line.split()[0] for line in lines if line.startswith("  ") and line[2] != " "]
    heights = ["surface", "change", "dsm"]
    assert shown == ["demo", *heights, "match", "status", "report", "project", "evaluate", "export"]
    assert "sat-intervals --help lists all" in " ".join(lines)


def test_help__lists_every_command_in_one_step():
    lines = invoke("--help").output.splitlines()
    shown = [
        line.split()[0] for line in lines[lines.index("Try and prepare:") :] if line[:2] == "  " and line[2] != " "
    ]
    assert sorted(shown) == sorted(main.commands)


def test_json__is_an_option_of_every_command_that_prints_figures():
    with_json = {name for name, command in main.commands.items() if any("--json" in one.opts for one in command.params)}
    assert with_json == set(WITH_JSON)


def test_match__prints_json_or_ends_with_the_next_command(pair, tmp_path):
    words = [pair / "left.tif", pair / "right.tif", "--config", pair / "settings.yaml"]
    out = tmp_path / "an out"
    done = invoke("match", *words[:2], out, *words[2:])
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[-1] == f"next: sat-intervals report '{out}'"
    assert invoke(*shlex.split(done.stdout.splitlines()[-1])[2:]).exit_code == 0
    done = invoke("match", *words[:2], tmp_path / "other", *words[2:], "--json")
    assert json.loads(done.stdout) == open_run(tmp_path / "other").report
    found = json.loads(invoke("status", out, "--json").stdout)
    assert found == {str(out): {"state": "complete"}}
    found = json.loads(invoke("plan", *words, "--json").stdout)
    assert found["tiles"] == 1
    assert found["seconds"] > 0


def test_batch__prints_the_state_of_each_pair_as_json(pair, tmp_path):
    left = pair / "left.tif"
    row = {"left": str(left), "right": str(pair / "right.tif"), "minimum": 0, "maximum": 8}
    rows = [{"name": "a"} | row, {"name": "b"} | row | {"right": "nowhere.tif"}]
    (tmp_path / "pairs.json").write_text(json.dumps(rows))
    done = invoke("batch", tmp_path / "pairs.json", tmp_path / "out", "--json")
    assert done.exit_code == 1
    assert {name: end["state"] for name, end in json.loads(done.stdout).items()} == {"a": "done", "b": "failed"}
    found = json.loads(invoke("status", tmp_path / "out", "--json").stdout)
    assert found[str(tmp_path / "out" / "a")] == {"state": "complete"}
    assert found[str(tmp_path / "out" / "b")]["state"] == "failed"
    assert "nowhere.tif" in found[str(tmp_path / "out" / "b")]["error"]


@pytest.mark.process
def test_completion__knows_commands_and_options():
    for words, expected in (
        ("sat-intervals pro", "plain,project\n"),
        ("sat-intervals match --cov", "plain,--coverage\n"),
    ):
        given = {"_SAT_INTERVALS_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
        done = subprocess.run([COMMAND], env=os.environ | given, capture_output=True, text=True, check=True)
        assert done.stdout == expected
