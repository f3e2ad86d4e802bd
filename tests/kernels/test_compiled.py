"""The kernels on other processors, and without compilation: in processes of their own, as numba decides at import."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import sat_intervals
from sat_intervals.kernels.compiled import FINGERPRINT, fingerprint

ROOT = Path(__file__).parents[2]


def run_tests(environment, *selection):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *selection]
    alone = {name: value for name, value in os.environ.items() if name != "PYTEST_XDIST_WORKER"}
    result = subprocess.run(command, cwd=ROOT, env=alone | environment, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    assert " passed" in result.stdout


@pytest.mark.ported
def test_kernels__equal_their_twins_on_processors_without_avx512(tmp_path):
    environment = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
    run_tests(
        environment,
        "tests/kernels/test_intervals.py::test_match_arrays__equals_reference",
        "tests/kernels/test_correlation.py::test_correlate__worked_example",
        "tests/kernels/test_sgm.py::test_cost_volume__equals_reference_with_penalties_that_follow_edges",
        "tests/kernels/test_sgm.py::test_cost_volume__equals_reference_at_every_count",
        "tests/kernels/test_intervals.py::test_match_costs__interval_equals_reference_at_every_count",
        "tests/kernels/test_disparity.py::test_match_costs__equals_reference_at_every_count",
    )


@pytest.mark.parametrize("changed", ["kernels/vector.py", "products.py"])
def test_fingerprint__follows_every_source_that_decides_what_kernels_do(tmp_path, changed):
    package = Path(sat_intervals.__file__).parent
    shutil.copytree(package / "kernels", tmp_path / "kernels")
    shutil.copy(package / "products.py", tmp_path)
    assert fingerprint(tmp_path) == FINGERPRINT
    with (tmp_path / changed).open("a") as source:
        source.write("# changed\n")
    assert fingerprint(tmp_path) != FINGERPRINT


@pytest.mark.ported
def test_kernels__plain_ones_equal_their_twins_without_compilation(tmp_path):
    run_tests(
        {"NUMBA_DISABLE_JIT": "1"},
        "tests/kernels/test_disparity.py",
        "tests/kernels/test_confidence.py",
        "tests/kernels/test_intervals.py",
        "-k",
        "worked_example and not match_costs__ and not alpha_cut",
    )


# Tells how often machine code was found, how often it was made, and where.
USE_A_KERNEL = """
import numpy as np
def use():
    from sat_intervals.kernels.lattice import interpolate
    interpolate(np.zeros((2, 2, 2, 1)), np.ones(3), np.zeros(3), np.zeros((2, 2), np.float32))
    stats = interpolate.stats
    return sum(stats.cache_hits.values()), sum(stats.cache_misses.values()), stats.cache_path
"""


def use_a_kernel(script, **environment):
    """What a script that has `use` prints, in a process of its own."""
    command = [sys.executable, "-c", USE_A_KERNEL + script]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.process
def test_cached__a_kernel_is_compiled_once_for_all_processes(tmp_path):
    on_a_worker = """
if __name__ == "__main__":
    from distributed import Client, LocalCluster
    with LocalCluster(1, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        print(*client.submit(use).result())
"""
    first, second, worker = (
        use_a_kernel(script, NUMBA_CACHE_DIR=str(tmp_path))
        for script in ("print(*use())", "print(*use())", on_a_worker)
    )
    assert first[:2] == ["0", "1"]
    assert second[:2] == worker[:2] == ["1", "0"]
    assert {Path(place).parent for *_, place in (first, second, worker)} == {tmp_path / "sat-intervals" / FINGERPRINT}


@pytest.mark.process
def test_kernels_of_others__give_the_same_bytes_when_compiled_and_when_read(tmp_path):
    pytest.importorskip("shareloc")
    script = "import sat_intervals.heights.sensors\nimport numpy as np\nfrom shareloc.geomodels import rpc\n"
    script += "places, factors = np.random.default_rng(0).uniform(-1, 1, (3, 1000)), np.linspace(-1, 1, 80)\n"
    script += "columns, rows = rpc.compute_rational_function_polynomial(*places, *factors.reshape(4, 20), 1, 0, 1, 0)\n"
    script += "print(rpc.polynomial_equation.stats.cache_hits.total(), (columns + rows).tobytes().hex())"
    (compiled, before), (read, after) = (use_a_kernel(script, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2))
    assert (compiled, read) == ("0", "1")
    assert after == before


@pytest.mark.process
def test_cached__functions_of_others_stay_out_of_its_folder(tmp_path):
    (tmp_path / "stranger.py").write_text(
        "from numba import njit\n@njit(cache=True)\ndef double(x):\n    return 2 * x\n"
    )
    script = "use()\nimport stranger\nprint(stranger.double.stats.cache_path)"
    cache = tmp_path / "cache"
    (path,) = use_a_kernel(script, NUMBA_CACHE_DIR=str(cache), PYTHONPATH=str(tmp_path))
    assert Path(path).parent == cache


@pytest.mark.process
def test_cached__where_none_can_be_kept_leaves_nothing_behind(tmp_path):
    used = use_a_kernel("print(*use())", NUMBA_CACHE_DIR="/proc/no-folder", TMPDIR=str(tmp_path))
    assert used == ["0", "1", "None"]
    assert list(tmp_path.iterdir()) == []
