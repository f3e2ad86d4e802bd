"""Compilation of kernels beside a command."""

import os
import subprocess
import sys

import pytest

from sat_intervals.kernels import FINGERPRINT

BESIDE = """
from pathlib import Path
from helpers import wait_until
from sat_intervals import load_config
from sat_intervals.run.beside import compiled_beside

def kernels():
    return {path.name.split("-")[0].split(".")[-1] for path in Path(%r).rglob("*.nbi")} - {"elsewhere"}

config = load_config({"preset": "paper", "cross_check": None, "median": None, "regularization": None})
with compiled_beside(config):
    wait_until(kernels, "kernel", seconds=120)
assert kernels() == {"normalize"}, kernels()
with compiled_beside(load_config({"preset": "paper"})):
    assert len(kernels()) == 1
"""


@pytest.mark.process
def test_compiled_beside__compiles_what_follows_matching_once_for_each_folder_of_the_package(tmp_path):
    other = tmp_path / "sat-intervals" / FINGERPRINT / "kernels_of_another_folder" / "elsewhere-1.py311.nbi"
    other.parent.mkdir(parents=True)
    other.touch()
    places = {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": "tests"}
    subprocess.run([sys.executable, "-c", BESIDE % str(tmp_path)], env=os.environ | places, check=True)
