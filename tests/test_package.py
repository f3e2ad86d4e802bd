"""The package as it is installed and imported: public names, packages, and nothing changed for others."""

import subprocess
import sys

import pytest
from test_architecture import FOLDERS, HOMES, PYPROJECT, modules

import sat_intervals

MODULES = list(modules())


def test_package__is_imported_without_its_libraries() -> None:
    libraries = {*HOMES, "pydantic", "xarray", "yaml"}
    code = f"import sys, sat_intervals; print(*{libraries!r} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_package__public_names_exist() -> None:
    assert set(sat_intervals._HOMES) == set(sat_intervals.__all__) - {"__version__"}
    assert dir(sat_intervals) == sorted(sat_intervals.__all__)
    assert sat_intervals.__version__ == PYPROJECT["project"]["version"]
    for name in sat_intervals._HOMES:
        assert getattr(sat_intervals, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'match_pairs'"):
        _ = sat_intervals.match_pairs


@pytest.mark.process
def test_package__public_names_load_without_extras() -> None:
    script = """
import sys
sys.modules["shareloc"] = sys.modules["matplotlib"] = None
from sat_intervals import *
try:
    import sat_intervals.heights.sensors
except SatIntervalsError as error:
    print(error)
"""
    assert run_python(script) == "sensor models need shareloc: pip install 'sat-intervals[dsm]'\n"


def test_packages__equal_the_folders() -> None:
    shipped = {
        ".".join([package, *file.parent.relative_to(folder).parts])
        for package, folder in FOLDERS.items()
        for file in folder.rglob("*")
        if file.suffix in (".py", ".yaml")
    }
    assert shipped == set(PYPROJECT["tool"]["setuptools"]["packages"])
    patterns = PYPROJECT["tool"]["setuptools"]["package-data"]["sat_intervals.configs"]
    configs = FOLDERS["sat_intervals.configs"]
    assert set(configs.rglob("*.yaml")) == {file for pattern in patterns for file in configs.glob(pattern)}


def test_entry_point__is_not_hidden_by_a_module() -> None:
    package, command = PYPROJECT["project"]["scripts"]["sat-intervals"].split(":")
    assert f"{package}.{command}" not in MODULES


# What the interpreter and the libraries are set to.
STATE = """
import gc, importlib, logging, signal, sys, warnings
from numba import config

def state():
    loggers = [logging.root, *(x for x in logging.root.manager.loggerDict.values() if isinstance(x, logging.Logger))]
    return {
        **{f"numba's {name}": repr(getattr(config, name)) for name in dir(config) if not name.startswith("_")},
        **{f"signal {number}": signal.getsignal(number) for number in signal.valid_signals()},
        **{
            f"logger {one.name}": (one.level, one.propagate, one.disabled, one.handlers[:], one.filters[:])
            for one in loggers
            if one.name.partition(".")[0] != "sat_intervals"
        },
        "warnings": warnings.filters[:],
        "garbage": (gc.isenabled(), gc.get_threshold()),
        "hooks": (sys.excepthook, sys.unraisablehook),
    }
"""
IMPORT_ALL = f"""
import importlib
for name in {[name.removesuffix(".__init__") for name in MODULES]!r}:
    importlib.import_module(name)
"""


@pytest.mark.peer("cars", "matplotlib", "onnxruntime", "shareloc")
def test_modules__importing_them_changes_nothing_of_others() -> None:
    """Dependencies may change global settings at import, so they are imported first."""
    others = run_python(f"{IMPORT_ALL}import sys; print(*[name for name in sys.modules if name[:4] != 'sat_'])").split()
    script = f"""{STATE}
for name in {others!r}:
    try:
        importlib.import_module(name)
    except ImportError:
        pass
before = state()
{IMPORT_ALL}
after = state()
for name, value in before.items():
    if after[name] != value:
        print(name, "was", value, "and is", after[name])
"""
    assert run_python(script) == ""


def run_python(script: str) -> str:
    """Return what a script prints in a separate process."""
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
