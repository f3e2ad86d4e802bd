"""The kernels on other processors, and without compilation: in processes of their own, as numba decides at import."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import sat_intervals
from sat_intervals.kernels import FINGERPRINT, _fingerprint

TESTS = Path(__file__).parent


def run_tests(environment, *selection):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *selection]
    result = subprocess.run(
        command, cwd=TESTS.parent, env=os.environ | environment, capture_output=True, text=True, timeout=600
    )
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    assert " passed" in result.stdout


# generic: SSE2 alone; haswell: AVX2. Vectors of 512 bits are split by LLVM.
@pytest.mark.parametrize("processor", ["generic", "haswell"])
def test_kernels__equal_their_twins_on_processors_without_avx512(tmp_path, processor):
    environment = {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
    run_tests(
        environment,
        "tests/test_intervals.py::test_match_arrays__equals_reference",
        "tests/test_correlation.py::test_correlate__worked_example",
        "tests/test_sgm.py::test_cost_volume__equals_reference_with_penalties_that_follow_edges",
        "tests/test_sgm.py::test_cost_volume__equals_reference_at_every_count",
        "tests/test_intervals.py::test_match__interval_equals_reference_at_every_count",
        "tests/test_disparity.py::test_match__equals_reference_at_every_count",
    )


@pytest.mark.parametrize("changed", ["kernels/vector.py", "products.py"])
def test_fingerprint__follows_every_source_that_decides_what_kernels_do(tmp_path, changed):
    package = Path(sat_intervals.__file__).parent
    shutil.copytree(package / "kernels", tmp_path / "kernels")
    shutil.copy(package / "products.py", tmp_path)
    assert _fingerprint(tmp_path) == FINGERPRINT
    with (tmp_path / changed).open("a") as source:
        source.write("# changed\n")
    assert _fingerprint(tmp_path) != FINGERPRINT


def test_kernels__plain_ones_equal_their_twins_without_compilation(tmp_path):
    run_tests(
        {"NUMBA_DISABLE_JIT": "1"},
        "tests/test_disparity.py",
        "tests/test_confidence.py",
        "tests/test_intervals.py",
        "-k",
        "worked_example and not match__ and not alpha_cut",
    )


def test_kernels__where_none_can_be_kept_leave_nothing_behind(tmp_path):
    script = "from sat_intervals import kernels; from numba import config; print(config.CACHE_DIR)"
    environment = os.environ | {"NUMBA_CACHE_DIR": "/proc/no-folder", "TMPDIR": str(tmp_path)}
    run = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert Path(run.stdout.strip()).parent == tmp_path
    assert list(tmp_path.iterdir()) == []
