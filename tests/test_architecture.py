"""The house rules that a machine can hold: who may import whom, and where each library is at home."""

import ast
import importlib.util
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import sat_intervals

ROOT = Path(__file__).parents[1]

# A room imports only lower floors. Rooms of one floor do not know each other; inside a room anything goes.
FLOORS = [
    {"cli", "cars_plugin"},
    {"batch", "plan", "cars_method"},
    {"run", "in_memory", "ablation", "pictures", "report"},
    {"conclude", "flight"},
    {"tile"},
    {"job"},
    {"evaluation", "triangulation", "surface", "surface_evaluation", "export"},
    {"cloud", "fusion"},
    {"finish", "patch", "demo", "results"},
    {"similarity", "store", "raster", "cluster", "memory", "seams", "summary", "geometry"},
    {
        "arrays",
        "config",
        "features",
        "kernels",
        "normalization",
        "scene",
        "inputs",
        "figures",
        "kinds",
        "pairs",
        "tables",
    },
    {"folders"},
    {"tiling", "products", "errors", "configs", "machine"},
]
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}

# The only rooms that may import a library.
HOMES = {
    "cars": {"cars_method"},
    "click": {"cli"},
    "dask": {"cluster"},
    "dask_jobqueue": {"cluster"},
    "distributed": {"cluster", "flight", "run"},
    "fsspec": {"folders"},
    "llvmlite": {"kernels"},
    "matplotlib": {"pictures"},
    "numba": {"kernels"},
    "onnxruntime": {"features"},
    "pyproj": {"raster"},
    "rasterio": {"raster"},
    "rich": {"cli"},
    "shareloc": {"geometry"},
    "zarr": {"arrays"},
}

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGE_FOLDERS = {"sat_intervals": ROOT / "sat_intervals"} | {
    package: ROOT / folder for package, folder in PYPROJECT["tool"]["setuptools"]["package-dir"].items()
}


def module_name(file: Path) -> str:
    """Name under which a file is imported: ``cli/app.py`` is ``sat_intervals.cli.app``."""
    for package, folder in PACKAGE_FOLDERS.items():
        if file.is_relative_to(folder):
            return ".".join([package, *file.relative_to(folder).with_suffix("").parts])
    raise ValueError(f"{file} belongs to no package")


MODULES = {module_name(file): file for folder in PACKAGE_FOLDERS.values() for file in sorted(folder.rglob("*.py"))}
ROOMS = {name: name.split(".")[1] for name in MODULES if name != "sat_intervals.__init__"}


def imported(source: str, module: str) -> set[str]:
    """Full names that a module's source imports anywhere in it, relative imports resolved."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            relative = "." * node.level + (node.module or "")
            base = importlib.util.resolve_name(relative, module.rpartition(".")[0])
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def imported_rooms(source: str, module: str) -> set[str]:
    """Rooms that a module's source imports; a public name of the package counts as the room it comes from."""
    rooms = set()
    for name in imported(source, module):
        top, _, rest = name.partition(".")
        if top != "sat_intervals" or rest == "__version__":
            continue
        if rest:
            room = rest.partition(".")[0]
            rooms.add(sat_intervals._HOMES.get(room, room))
        else:  # `import sat_intervals` reaches every public name
            rooms |= set(sat_intervals._HOMES.values())
    return rooms


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import numpy", set()),
        ("import sat_intervals.kernels.cost", {"kernels"}),
        ("from sat_intervals.kernels import cost", {"kernels"}),
        ("from sat_intervals import raster, tiling", {"raster", "tiling"}),
        ("from sat_intervals import match_pair, __version__", {"run"}),
        ("from ..run import match_pair", {"run"}),
        ("from . import cost", {"kernels"}),
        ("def late():\n    from sat_intervals.store.tiles import Store", {"store"}),
        ("import sat_intervals", {"config", "errors", "in_memory", "raster", "run", "tiling"}),
    ],
)
def test_imported_rooms__sees_every_way_to_import(source: str, expected: set[str]) -> None:
    assert imported_rooms(source, "sat_intervals.kernels.sgm") == expected


@pytest.mark.parametrize("module", ROOMS)
def test_floors__a_module_imports_only_lower_floors(module: str) -> None:
    room = ROOMS[module]
    assert room in FLOOR_OF, f"{module} has no floor"
    for other in imported_rooms(MODULES[module].read_text(), module) - {room}:
        assert other in FLOOR_OF, f"{module} imports {other}, which has no floor"
        assert FLOOR_OF[other] > FLOOR_OF[room], f"{module} imports {other}, which is not below it"


@pytest.mark.parametrize("module", MODULES)
def test_homes__a_library_is_imported_in_its_home_only(module: str) -> None:
    for name in imported(MODULES[module].read_text(), module):
        library = name.partition(".")[0]
        assert library not in HOMES or ROOMS.get(module) in HOMES[library], (
            f"{module} imports {library}, at home in {HOMES[library]}"
        )


def test_package__is_imported_without_its_libraries() -> None:
    libraries = {*HOMES, "pydantic", "xarray", "yaml"}
    code = f"import sys, sat_intervals; print(*{libraries!r} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_package__public_names_exist() -> None:
    assert set(sat_intervals._HOMES) == set(sat_intervals.__all__) - {"__version__"}
    assert set(sat_intervals.__all__) <= set(dir(sat_intervals))
    assert sat_intervals.__version__ == PYPROJECT["project"]["version"]
    for name, room in sat_intervals._HOMES.items():
        assert room in FLOOR_OF
        if f"sat_intervals.{room}" in MODULES:
            assert getattr(sat_intervals, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'match_pairs'"):
        _ = sat_intervals.match_pairs


def test_packages__equal_the_folders() -> None:
    shipped = {
        ".".join([package, *file.parent.relative_to(folder).parts])
        for package, folder in PACKAGE_FOLDERS.items()
        for file in folder.rglob("*")
        if file.suffix in {".py", ".yaml"}
    }
    assert shipped == set(PYPROJECT["tool"]["setuptools"]["packages"])


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


def test_modules__importing_them_changes_nothing_of_others() -> None:
    """Other libraries may set at import what they like: theirs are imported before."""
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
    """What a script prints, in a process of its own."""
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
